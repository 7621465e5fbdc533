"""The kernel on a toy policy, against plain loops; then RRT, RRT* and RRT-Connect."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vrrt_jax
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import difference, free_prefix, normalize, steer
from vrrt_jax.core.expand import expand
from vrrt_jax.core.planners.rrt import RRT, tree_path
from vrrt_jax.core.planners.rrt_connect import RRTConnect, connection_path
from vrrt_jax.core.rewire import with_costs
from vrrt_jax.core.search import StopReason, make_termination, search
from vrrt_jax.core.shortcut import path_length, shortcut
from vrrt_jax.core.types import Proposals, Rejection, pytree

# Either side of the wall; the straight line between them goes through it.
START = np.array([-0.9, 0.5, 0.0, -1.6, 0.0, 2.0, 0.8], np.float32)
GOAL = np.array([0.9, 0.5, 0.0, -1.6, 0.0, 2.0, 0.8], np.float32)


@pytree
class Scripted:
    """Tries given targets from the root, whatever they are."""

    target: jax.Array
    ok: jax.Array
    edge_steps: int = dataclasses.field(default=8, metadata={"static": True})

    def propose(self, world, tree, key):
        lanes = self.ok.shape[0]
        return Proposals(
            parent=jnp.zeros(lanes, jnp.int32),
            target=self.target,
            valid=self.ok,
            partial=jnp.zeros(lanes, bool),
            aux=None,
        )

    def evaluate(self, world, q, proposals):
        score = jnp.where(q[:, 0] > 0.02, jnp.nan, q[:, 0])
        return score, {"twice": 2 * q}

    def after_insert(self, world, tree, proposals, expansion):
        return tree


def toy_tree(q, capacity):
    payload = {"twice": jnp.asarray(2 * q)[None]}
    return trees.create(jnp.asarray(q)[None], jnp.zeros(1), payload, capacity)


def test_each_rejection_is_counted_once_and_the_rest_is_inserted(wall_world):
    root = START
    lanes = 8
    target = np.tile(root, (lanes, 1))
    target[0, 0] -= 0.05  # fine
    target[1, 1] = np.nan
    target[2] = root  # no step
    target[3, 0] -= 0.05  # not ok
    target[4, 0] -= 0.1  # fine
    target[5, 0] = -9.0  # clipped to the edge's length, fine
    target[6, 0] += 0.1  # fine
    target[7, 0] += 0.02  # fine
    policy = Scripted(target=jnp.asarray(target), ok=jnp.arange(lanes) != 3)
    tree = jax.jit(expand)(wall_world, policy, toy_tree(root, 5), jax.random.key(0))
    rejected = dict(zip(Rejection, np.asarray(tree.rejected), strict=True))
    assert rejected == {
        Rejection.NO_PARENT: 1,
        Rejection.LIMITS: 1,
        Rejection.BLOCKED: 0,
        Rejection.NOT_FINITE: 1,
        Rejection.CAPACITY: 1,
    }
    assert int(tree.size) == 5 and int(tree.iteration) == 1
    inserted = [target[0], target[4], root - np.eye(7)[0] * 8 * 0.02, target[6]]
    np.testing.assert_allclose(tree.q[1:], inserted, atol=1e-6)
    np.testing.assert_allclose(tree.payload["twice"], 2 * np.asarray(tree.q), atol=1e-6)
    np.testing.assert_allclose(
        tree.cost, np.linalg.norm(np.asarray(tree.q) - root, axis=1), atol=1e-6
    )
    np.testing.assert_array_equal(tree.parent, [-1, 0, 0, 0, 0])


def test_nan_scores_and_blocked_edges_stay_out(wall_world):
    inside = GOAL.copy()
    inside[0] = 0.03  # beside the wall's middle: in collision
    target = np.stack([inside, START - 0.01])
    near = START.copy()
    near[0] = -0.12
    policy = Scripted(target=jnp.asarray(target), ok=jnp.ones(2, bool))
    free_here = jax.jit(vrrt_jax.is_free)
    assert not bool(free_here(wall_world, jnp.asarray(inside)))
    tree = toy_tree(START, 8)
    grown = jax.jit(expand)(wall_world, policy, tree, jax.random.key(0))
    assert int(grown.size) == 3  # both steps are clipped well before the wall
    q = START.copy()
    q[0] = -0.3
    while bool(free_here(wall_world, jnp.asarray(q))):
        q[0] += 0.01
    q[0] -= 0.01
    blocked = jax.jit(expand)(wall_world, policy, toy_tree(q, 8), jax.random.key(0))
    assert int(blocked.rejected[Rejection.BLOCKED]) >= 1


@settings(deadline=None, max_examples=25, derandomize=True)
@given(st.lists(st.booleans(), min_size=6, max_size=6), st.integers(1, 9))
def test_insertion_equals_a_loop(ok, capacity):
    tree = toy_tree(np.zeros(7, np.float32), capacity)
    q = np.arange(42, dtype=np.float32).reshape(6, 7)
    grown, slot = trees.insert(
        tree,
        q=jnp.asarray(q),
        parent=jnp.zeros(6, jnp.int32),
        cost=jnp.arange(6.0),
        score=jnp.arange(6.0),
        payload={"twice": jnp.asarray(2 * q)},
        ok=jnp.asarray(ok),
    )
    expected, slots = [np.zeros(7, np.float32)], []
    for row, wanted in zip(q, ok, strict=True):
        fits = wanted and len(expected) < capacity
        slots.append(len(expected) if fits else capacity)
        if fits:
            expected.append(row)
    np.testing.assert_array_equal(slot, slots)
    assert int(grown.size) == len(expected)
    np.testing.assert_array_equal(grown.q[: len(expected)], expected)
    assert np.all(np.isinf(grown.score[len(expected) :]))


def test_steering_respects_limits_length_and_wrapping(panda, wall_world):
    q, far = jnp.asarray(panda.home, jnp.float32), jnp.full(7, 10.0)
    step = steer(wall_world, q, far, jnp.float32(0.3))
    assert float(jnp.linalg.norm(step)) == pytest.approx(0.3, abs=1e-5)
    assert np.all(np.asarray(q + steer(wall_world, q, far, jnp.float32(1e3))) <= panda.upper + 1e-5)
    turning = dataclasses.replace(wall_world, is_continuous=jnp.ones(7, bool))
    across = difference(turning, jnp.full(7, 3.0), jnp.full(7, -3.0))
    np.testing.assert_allclose(across, 2 * np.pi - 6.0, atol=1e-5)
    np.testing.assert_allclose(normalize(turning, jnp.full(7, 3.3)), 3.3 - 2 * np.pi, atol=1e-5)
    np.testing.assert_allclose(normalize(wall_world, jnp.full(7, 3.3)), 3.3)


def test_free_steps_counts_the_leading_free_ones(wall_world, free):
    points = START + np.linspace(0, 1, 65)[1:, None] * (GOAL - START)
    is_free = np.asarray(free(wall_world, points.astype(np.float32)))
    assert not is_free.all() and is_free[0]
    start, goal = jnp.asarray(START)[None], jnp.asarray(GOAL)[None]
    edge = wall_world.edge(start, goal)
    count = jax.jit(free_prefix, static_argnums=3)(wall_world, start, edge, 64)
    assert int(count[0]) == int(np.argmin(is_free))


def connect(world, seed, **stop):
    policy = RRTConnect()
    tree = policy.forest(jnp.asarray(START), jnp.asarray(GOAL), 4096)
    return search(
        world,
        policy,
        tree,
        key=jax.random.key(seed),
        stop=make_termination(0.0, **{"max_iterations": 200, **stop}),
    )


@pytest.fixture(scope="module")
def connected(wall_world):
    return connect(wall_world, 0)


def assert_free(world, free, path):
    dense = np.concatenate(
        [
            a + np.linspace(0, 1, 200)[:, None] * (b - a)
            for a, b in zip(path[:-1], path[1:], strict=True)
        ]
    )
    assert np.mean(np.asarray(free(world, dense.astype(np.float32)))) > 0.995


def test_rrt_connect_goes_around_the_wall(wall_world, free, connected):
    assert connected.stopped is StopReason.REACHED
    path = connection_path(connected.tree)
    np.testing.assert_allclose(path[[0, -1]], [START, GOAL], atol=1e-5)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 32 * 0.02 + 1e-4
    assert_free(wall_world, free, path)


def test_tree_invariants(wall_world, connected):
    tree = connected.tree
    size, parent = int(tree.size), np.asarray(tree.parent)
    assert np.all(parent[2:size] < np.arange(2, size)), "a child comes after its parent"
    assert np.all(parent[size:] == -1) and np.all(np.isinf(tree.score[size:]))
    assert size == 2 + 32 * int(tree.iteration) - int(np.sum(tree.rejected))
    recomputed = with_costs(wall_world, tree).cost
    np.testing.assert_allclose(recomputed, tree.cost, atol=1e-4)
    side = np.asarray(tree.payload.side)
    assert np.all(side[parent[2:size]] == side[2:size]), "trees do not mix"


def test_same_seed_same_tree_whatever_the_chunks(wall_world, connected, monkeypatch):
    monkeypatch.setattr("vrrt_jax.core.search.CHUNK", 3)
    again = connect(wall_world, 0)
    np.testing.assert_array_equal(again.tree.q, connected.tree.q)
    assert not np.array_equal(connect(wall_world, 1).tree.q, connected.tree.q)


def test_interrupt_keeps_the_tree(wall_world, monkeypatch):
    import signal

    policy = RRT(goal=jnp.asarray(GOAL), goal_bias=jnp.float32(0), rewire_radius=jnp.float32(0.5))
    score, _ = policy.root(wall_world, jnp.asarray(START))
    tree = trees.create(jnp.asarray(START)[None], score[None], None, 4096)
    found = search(
        wall_world,
        policy,
        tree,
        key=jax.random.key(0),
        stop=make_termination(-1.0, max_iterations=10_000),
        on_progress=lambda state, seconds: signal.raise_signal(signal.SIGINT),
    )
    assert found.stopped is StopReason.INTERRUPTED and int(found.tree.size) > 1


def test_budget_capacity_and_time_are_reported(wall_world):
    policy = RRT(goal=jnp.asarray(GOAL), goal_bias=jnp.float32(0), rewire_radius=jnp.float32(0.5))
    score, _ = policy.root(wall_world, jnp.asarray(START))

    def run(capacity, limit=float("inf"), **stop):
        tree = trees.create(jnp.asarray(START)[None], score[None], None, capacity)
        rule = make_termination(-1.0, **{"max_iterations": 10_000, **stop})
        key = jax.random.key(0)
        return search(wall_world, policy, tree, key=key, stop=rule, time_limit_s=limit)

    full = run(100)
    assert full.stopped is StopReason.TREE_FULL and int(full.tree.size) == 100
    assert int(full.tree.rejected[Rejection.CAPACITY]) > 0
    few = run(4096, max_iterations=3)
    assert few.stopped is StopReason.ITERATIONS and int(few.tree.iteration) == 3
    assert run(4096, limit=0.0).stopped is StopReason.TIME_LIMIT
    assert run(4096, patience=5, min_improvement=1e9).stopped is StopReason.CONVERGED


def test_rrt_star_improves_on_rrt_with_right_costs(wall_world, free):
    def run(star):
        policy = RRT(
            goal=jnp.asarray(GOAL),
            goal_bias=jnp.float32(0.1),
            rewire_radius=jnp.float32(1.9),
            star=star,
        )
        score, _ = policy.root(wall_world, jnp.asarray(START))
        tree = trees.create(jnp.asarray(START)[None], score[None], None, 8192)
        stop = make_termination(-1.0, max_iterations=100)
        return search(wall_world, policy, tree, key=jax.random.key(3), stop=stop).tree

    plain, star = run(False), run(True)
    for tree in (plain, star):
        np.testing.assert_allclose(with_costs(wall_world, tree).cost, tree.cost, atol=2e-4)
    mean_plain = float(np.mean(plain.cost[: int(plain.size)]))
    mean_star = float(np.mean(star.cost[: int(star.size)]))
    assert mean_star < 0.85 * mean_plain
    path = tree_path(star)
    np.testing.assert_allclose(path[0], START, atol=1e-6)
    assert_free(wall_world, free, path)


def test_shortcut_shortens_and_stays_free(wall_world, free, connected):
    path = connection_path(connected.tree)
    short = shortcut(wall_world, path, key=jax.random.key(0))
    np.testing.assert_allclose(short[[0, -1]], path[[0, -1]], atol=1e-6)
    assert path_length(wall_world, short) < 0.9 * path_length(wall_world, path)
    assert_free(wall_world, free, short)
    np.testing.assert_array_equal(short, shortcut(wall_world, path, key=jax.random.key(0)))
    assert len(shortcut(wall_world, path[:2], key=jax.random.key(0))) == 2
