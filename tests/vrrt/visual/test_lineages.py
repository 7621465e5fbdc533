"""Lineages on the kernel: edges scatter, lineages jump, their tips follow the gradient by Adam."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from pictures import Q_GOAL, Q_START

import vrrt_jax
from vrrt_jax.core.expand import expand
from vrrt_jax.core.tree import UNREACHED, lineage
from vrrt_jax.visual.lineages import LineageRRT

CONFIG = vrrt_jax.PlannerConfig().changed(
    {"lineages.steps": 60, "lineages.young": 25, "lineages.jumps": 4}
)


@vrrt_jax.pytree
class Bowl:
    """A loss that any configuration's gradient leads down to the goal."""

    q: jax.Array
    threshold: float = 1e-4

    def loss(self, world, q):
        return jnp.mean((q - self.q) ** 2)


def grown(world, iterations, roots=None, **numbers):
    """The policy, and its trees after each of some iterations."""
    policy = LineageRRT.from_config(CONFIG, world)
    changes = {name: jnp.asarray(number) for name, number in numbers.items()}
    policy = dataclasses.replace(policy, **changes)
    goal = Bowl(q=jnp.asarray(Q_GOAL))
    tree = policy.init(world, goal, Q_START[None] if roots is None else roots, 1024)
    trees, step = [tree], jax.jit(expand)
    for _ in range(iterations):
        trees.append(step(world, goal, policy, trees[-1], jax.random.key(0)))
    return policy, trees


@pytest.fixture(scope="module")
def run(wall_world):
    policy, trees = grown(wall_world, 20)
    assert np.asarray(policy.stages).tolist() == [4, 12, 12 + 52 + 35]
    return trees


def test_edges_scatter_from_the_start(run, wall_world, free):
    tree = run[4]
    size = int(tree.size)
    assert size > 64 and np.all(tree.parent[1:size] == 0)
    q = np.asarray(tree.q[:size])
    assert np.all(free(wall_world, q))
    away = np.linalg.norm(q - Q_START, axis=1)
    assert away.max() < 2.8 + 1e-4 and np.median(away) < 1.6
    # Some of them end where something was in the way.
    np.testing.assert_allclose(tree.cost[1:size], away[1:], atol=1e-5)


def test_edges_found_all_lineages_in_turn(run):
    tree = run[4]
    size = int(tree.size)
    owner = np.asarray(tree.payload.lineage[:size])
    assert owner[0] == 0 and set(owner[1:]) == set(range(64))
    assert np.bincount(owner[1:]).max() == 128 // 64


def test_lineages_are_inherited_and_compete_with_no_other(run):
    before, tree = run[4], run[12]
    first, size = int(before.size), int(tree.size)
    assert size > first + 64
    owner, parent = np.asarray(tree.payload.lineage), np.asarray(tree.parent)
    np.testing.assert_array_equal(owner[first:size], owner[parent[first:size]])  # of the jumps
    # A jump leaves from what is the best node of its lineage when it is its turn.
    for k in range(4, 12):
        old, new = run[k], run[k + 1]
        score = np.asarray(old.score[: int(old.size)])
        own = np.asarray(old.payload.lineage[: int(old.size)])
        for child in range(int(old.size), int(new.size)):
            own_nodes = np.flatnonzero(own == int(new.payload.lineage[child]))
            assert int(new.parent[child]) == own_nodes[np.argmin(score[own_nodes])]


def test_tips_descend_by_adam_and_their_children_inherit_the_moments(open_world):
    policy, trees = grown(open_world, 20)
    tree = trees[-1]
    size = int(tree.size)
    count, has_grad = (
        np.asarray(leaf)[:size] for leaf in (tree.payload.adam.count, tree.payload.has_grad)
    )
    # Eight iterations, of which half serve a lineage: first a child with a gradient, then steps.
    assert np.bincount(count[has_grad]).tolist() == [64] * 4
    slopes = jax.vmap(jax.grad(Bowl(q=jnp.asarray(Q_GOAL)).loss, argnums=1), (None, 0))(
        None, tree.q
    )
    np.testing.assert_allclose(
        tree.payload.grad[:size][has_grad], slopes[:size][has_grad], atol=1e-6
    )
    adam = optax.scale_by_adam(b1=0.9, b2=0.9)
    for tip in np.flatnonzero(count == 3)[:5]:
        parent, *nodes = lineage(tree, int(tip))[-5:]
        q = jnp.asarray(tree.q[nodes[0]])
        assert np.linalg.norm(q - tree.q[parent]) < 0.01
        state = adam.init(q)
        for k, node in enumerate(nodes[1:]):
            slope = jax.grad(Bowl(q=jnp.asarray(Q_GOAL)).loss, argnums=1)(None, q)
            direction, state = adam.update(slope, state)
            q = q - 0.06 * (1 - k / 60) * direction
            np.testing.assert_allclose(tree.q[node], q, atol=1e-4)
            np.testing.assert_allclose(tree.payload.adam.mu[node], state.mu, atol=1e-5)
    exploited = np.asarray(tree.payload.exploited[:size])
    assert not np.any(exploited[count == 3]) and np.all(exploited[has_grad & (count < 3)])


def test_when_the_young_have_had_their_steps_the_best_go_on(open_world):
    policy, trees = grown(open_world, 20, young=2, steps=10)
    old, tree = trees[-2], trees[-1]
    size = int(old.size)
    score, owner = np.asarray(old.score[:size]), np.asarray(old.payload.lineage[:size])
    best = np.array([score[owner == k].min() for k in range(64)])
    served = np.asarray(tree.payload.lineage[size : int(tree.size)])
    assert len(served) == 32
    assert sorted(served) == sorted(np.argsort(best, kind="stable")[:32])


def test_all_that_grows_hangs_on_the_start_or_on_a_root_that_was_given(open_world):
    guess = Q_GOAL + np.float32(0.05)
    _, trees = grown(open_world, 14, roots=np.stack([Q_START, guess]))
    tree = trees[-1]
    roots = [lineage(tree, node)[0] for node in range(int(tree.size))]
    assert set(roots[2:]) == {0, 1}  # the guess heads the second lineage
    reached = np.asarray(tree.cost[: int(tree.size)]) < UNREACHED
    np.testing.assert_array_equal(reached, np.array(roots) == 0)
