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

    def run(capacity, limit=float("inf"), **changes):
        return search(
            wall_world,
            goal,
            policy,
            policy.init(wall_world, goal, START[None], capacity),
            key=jax.random.key(0),
            termination=make_termination(-1.0, **{"max_iterations": 10_000, **changes}),
            time_limit_s=limit,
        )

    full = run(100)
    assert full.stopped is StopReason.TREE_FULL and int(full.tree.size) == 100
    assert int(full.tree.rejected[Rejection.CAPACITY]) > 0
    few = run(4096, max_iterations=3)
    assert few.stopped is StopReason.ITERATIONS and int(few.tree.iteration) == 3
    assert run(4096, limit=0.0).stopped is StopReason.TIME_LIMIT
    assert run(4096, patience=5, min_improvement=1e9).stopped is StopReason.CONVERGED
