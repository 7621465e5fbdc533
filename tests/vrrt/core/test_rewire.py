"""Rewiring against a plain recomputation, and the informed set."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from core_cases import START, assert_free

from vrrt_jax.core import tree as trees
from vrrt_jax.core.informed import sample_informed
from vrrt_jax.core.planners import RRT, RRTConnect
from vrrt_jax.core.rewire import rewire, shortcut_branch, winners
from vrrt_jax.core.types import Expansion


def plain_costs(tree):
    """Lengths of the ways up to the root, edge by edge; a cycle would not end."""
    q, parent, size = np.asarray(tree.q), np.asarray(tree.parent), int(tree.size)
    costs = np.zeros(size)
    for node in range(size):
        here, steps = node, 0
        while parent[here] >= 0:
            costs[node] += np.linalg.norm(q[here] - q[parent[here]])
            here, steps = parent[here], steps + 1
            assert steps <= size, "a cycle"
    return costs


def test_a_rewired_tree_has_no_cycles_and_right_costs(wall_world, rng):
    """Detours of a crowd of nodes get straight, by near nodes and by ancestors."""
    size, new = 60, 8
    q = (START + rng.uniform(-0.15, 0.15, (size, 7))).astype(np.float32)
    parent = np.r_[-1, np.arange(size - 1)].astype(np.int32)  # one long chain
    tree = trees.create(q[:1], jnp.zeros(1), None, 64)
    tree = dataclasses.replace(
        tree,
        q=tree.q.at[:size].set(q),
        parent=tree.parent.at[:size].set(parent),
        size=jnp.int32(size),
        score=tree.score.at[:size].set(1.0),
    )
    tree = dataclasses.replace(tree, cost=tree.cost.at[:size].set(plain_costs(tree)))
    expansion = Expansion(
        q=jnp.asarray(q[-new:]),
        node_index=jnp.arange(size - new, size),
        accepted=jnp.ones(new, bool).at[2].set(False),
        blocked=jnp.zeros(new, bool),
    )
    how = {"radius": jnp.float32(1.0), "edge_steps": 32, "checks": 32}
    how |= {"neighbors": 8, "tries": 4, "ancestors": 3}
    done = jax.jit(lambda world, tree, expansion: rewire(world, tree, expansion, **how))(
        wall_world, tree, expansion
    )
    before, after = np.asarray(tree.cost[:size]), np.asarray(done.cost[:size])
    np.testing.assert_allclose(after, plain_costs(done), atol=1e-4)
    assert np.all(after <= before + 1e-4) and np.sum(after < before - 0.1) > new
    assert int(done.parent[0]) == -1 and int(done.checked) > 0


def test_shortcuts_of_the_best_path_stay_in_the_tree(wall_world, free, connected):
    """One after the other: the goal's cost falls, costs stay right, and other branches stay."""
    path = RRTConnect().extract_path(connected.tree)
    size, aside = len(path) + 1, path[1] + np.float32(0.01)
    tree = trees.create(path[:1], jnp.zeros(1), None, 64)
    tree = dataclasses.replace(
        tree,
        q=tree.q.at[:size].set(np.concatenate([path, aside[None]])),
        parent=tree.parent.at[:size].set(np.r_[-1, np.arange(size - 2), 1]),
        score=tree.score.at[:size].set(1.0).at[size - 2].set(0.0),
        size=jnp.int32(size),
    )
    tree = dataclasses.replace(tree, cost=tree.cost.at[:size].set(plain_costs(tree)))
    turn = jax.jit(lambda world, tree, key: shortcut_branch(world, tree, 0.1, key))
    costs = [float(tree.cost[size - 2])]
    for number in range(16):
        tree = turn(wall_world, tree, jax.random.key(number))
        costs.append(float(tree.cost[size - 2]))
    assert np.all(np.diff(costs) <= 1e-5) and costs[-1] < 0.9 * costs[0]
    np.testing.assert_allclose(tree.cost[: int(tree.size)], plain_costs(tree), atol=1e-4)
    short = RRT().extract_path(tree)
    np.testing.assert_array_equal(short[[0, -1]], path[[0, -1]])
    assert_free(wall_world, free, short)
    assert int(tree.parent[size - 1]) == 1 and int(tree.checked) > 0
    # Without a path, and without room, nothing is done.
    none = dataclasses.replace(tree, score=jnp.ones(64))
    assert int(turn(wall_world, none, jax.random.key(0)).checked) == int(tree.checked)


def test_the_best_of_several_offers_is_taken():
    node, gain = jnp.array([3, 5, 3, 5, 1]), jnp.array([1.0, 2.0, 4.0, 2.0, 0.0])
    np.testing.assert_array_equal(winners(node, gain, 8), [False, True, True, False, False])


def test_informed_samples_are_those_of_the_set(wall_world):
    """None is outside, and none of what uniform samples find inside lies beyond the box."""
    start, goal = jnp.asarray(START), jnp.asarray(START).at[0].add(0.8)
    cost = jnp.float32(4.0)

    def total(q):
        return np.linalg.norm(q - start, axis=1) + np.linalg.norm(q - goal, axis=1)

    sample = jax.jit(sample_informed, static_argnums=4)
    q, found = sample(wall_world, (start, goal), cost, jax.random.key(0), 64)
    assert np.all(total(q[found]) < cost) and np.sum(found) > 20
    lower, upper = wall_world.informed_box(start, goal, cost)
    shape = (200_000, 7)
    uniform = np.asarray(
        jax.random.uniform(jax.random.key(1), shape, minval=start - 2.5, maxval=start + 2.5)
    )
    inside = (total(uniform) < cost) & np.all(uniform >= wall_world.lower, axis=1)
    inside &= np.all(uniform <= wall_world.upper, axis=1)
    assert np.sum(inside) > 50
    assert np.all((uniform[inside] >= lower) & (uniform[inside] <= upper))
    q, found = sample(wall_world, (start, goal), jnp.float32(jnp.inf), jax.random.key(0), 64)
    assert np.all(found) and np.ptp(q[:, 0]) > 4.0
