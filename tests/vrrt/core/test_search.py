"""The loop around the kernel: chunks, interrupts, budgets."""

import jax
import jax.numpy as jnp
import numpy as np
from core_cases import GOAL, START, connect

from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners import RRT
from vrrt_jax.core.search import StopReason, make_termination, search
from vrrt_jax.core.types import Rejection


def test_same_seed_same_tree_whatever_the_chunks(wall_world, connected, monkeypatch):
    monkeypatch.setattr("vrrt_jax.core.search.CHUNK", 3)
    again = connect(wall_world, 0)
    np.testing.assert_array_equal(again.tree.q, connected.tree.q)
    assert not np.array_equal(connect(wall_world, 1).tree.q, connected.tree.q)


def test_interrupt_keeps_the_tree(wall_world, monkeypatch):
    import signal

    goal, policy = ConfigurationGoal(q=jnp.asarray(GOAL)), RRT(goal_bias=0.0)
    found = search(
        wall_world,
        goal,
        policy,
        policy.init(wall_world, goal, START[None], 4096),
        key=jax.random.key(0),
        termination=make_termination(-1.0, max_iterations=10_000),
        on_progress=lambda state, seconds: signal.raise_signal(signal.SIGINT),
    )
    assert found.stopped is StopReason.INTERRUPTED and int(found.tree.size) > 1


def test_budget_capacity_and_time_are_reported(wall_world):
    goal, policy = ConfigurationGoal(q=jnp.asarray(GOAL)), RRT(goal_bias=0.0)

    def run(capacity, limit=float("inf"), max_capacity=4096, **changes):
        return search(
            wall_world,
            goal,
            policy,
            policy.init(wall_world, goal, START[None], capacity),
            key=jax.random.key(0),
            termination=make_termination(-1.0, **{"max_iterations": 10_000, **changes}),
            time_limit_s=limit,
            max_capacity=max_capacity,
        )

    full = [run(room, max_capacity=room) for room in (97, 98, 100)]
    assert all(found.stopped is StopReason.TREE_FULL for found in full)
    assert [int(found.tree.size) for found in full] == [97, 98, 100]
    assert sum(int(found.tree.rejected[Rejection.CAPACITY]) for found in full) > 0
    few = run(4096, max_iterations=3)
    assert few.stopped is StopReason.ITERATIONS and int(few.tree.iteration) == 3
    assert run(4096, limit=0.0).stopped is StopReason.TIME_LIMIT
    assert run(4096, patience=5, min_improvement=1e9).stopped is StopReason.CONVERGED


def test_a_full_tree_gets_more_room(wall_world, free):
    goal, policy = ConfigurationGoal(q=jnp.asarray(GOAL)), RRT(goal_bias=0.0)
    found = search(
        wall_world,
        goal,
        policy,
        policy.init(wall_world, goal, START[None], 40),
        key=jax.random.key(0),
        termination=make_termination(-1.0, max_iterations=20),
        max_capacity=4096,
    )
    size, tree = int(found.tree.size), found.tree
    assert found.stopped is StopReason.ITERATIONS and size > 160 and tree.capacity == 640
    parent = np.asarray(tree.parent)
    assert parent[0] == -1 and np.all((parent[1:size] >= 0) & (parent[1:size] < size))
    assert np.all(parent[size:] == -1) and np.all(np.isinf(np.asarray(tree.score)[size:]))
    # Costs of nodes from before and after are lengths of their edges, and all nodes are free.
    q, cost = np.asarray(tree.q), np.asarray(tree.cost)
    length = np.linalg.norm(q[1:size] - q[parent[1:size]], axis=1)
    np.testing.assert_allclose(cost[1:size], cost[parent[1:size]] + length, rtol=1e-4)
    assert np.all(np.asarray(free(wall_world, q[:size])))


def test_trees_of_a_batch_grow_together(wall_world):
    goal, policy = ConfigurationGoal(q=jnp.asarray(GOAL)), RRT(goal_bias=0.0)
    tree = policy.init(wall_world, goal, START[None], 40)

    def twice(leaf):
        return jnp.stack([jnp.asarray(leaf)] * 2)

    found = search(
        wall_world,
        jax.tree.map(twice, goal),
        policy,
        jax.tree.map(twice, tree),
        key=jax.random.split(jax.random.key(0)),
        termination=jax.tree.map(twice, make_termination(-1.0, max_iterations=6)),
        max_capacity=4096,
        batched=True,
    )
    assert found.stopped_each == (StopReason.ITERATIONS,) * 2
    assert found.tree.q.shape == (2, 160, 7) and np.all(np.asarray(found.tree.size) > 40)
    iteration, _, _, size, cost, checked = found.history[-1]
    assert iteration == 6 and size == np.max(found.tree.size) and np.isinf(cost)
    assert checked == np.max(found.tree.checked) > 6 * 32


def test_copies_of_a_tree_grow_on_threads_into_one(wall_world):
    goal, policy = ConfigurationGoal(q=jnp.asarray(GOAL)), RRT(goal_bias=0.0)

    def run(copies, score=-1.0, iterations=5):
        return search(
            wall_world,
            goal,
            policy,
            policy.init(wall_world, goal, START[None], 4096),
            key=jax.random.key(0),
            termination=make_termination(score, max_iterations=iterations),
            copies=copies,
        )

    found, alone = run(2), run(1)
    tree = found.tree
    assert found.stopped is StopReason.ITERATIONS and int(tree.iteration) == 10
    assert int(found.history[-1, 0]) == 10 and int(found.history[-1, 3]) == int(tree.size) + 1
    assert int(alone.tree.size) < int(tree.size) < tree.capacity == 2 * 4096
    assert int(tree.rejected.sum()) + int(tree.size) - 1 == 10 * policy.lanes
    # One root; every other node is an edge farther from it than its parent.
    size = int(tree.size)
    q, parent, cost = (np.asarray(leaf)[:size] for leaf in (tree.q, tree.parent, tree.cost))
    assert parent[0] == -1 and np.all(parent[1:] >= 0) and np.all(parent[1:] < np.arange(1, size))
    edge = np.linalg.norm(q[1:] - q[parent[1:]], axis=1)
    np.testing.assert_allclose(cost[1:], cost[parent[1:]] + edge, rtol=1e-4, atol=1e-5)
    assert np.all(np.isinf(np.asarray(tree.score)[size:]))
    np.testing.assert_array_equal(run(2).tree.q, tree.q)
    # All end when one has arrived.
    together = run(2, score=1e9, iterations=100)
    assert together.stopped is StopReason.REACHED
