"""Restarts keep the shortest path that any of the searches has found."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.planners.nrp_connect import NRPConnect
from nrp_jax.planners.restarts import search_with_restarts
from vrrt_jax.core.search import StopReason, make_termination
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.core.types import pytree

pytestmark = pytest.mark.light_compilation
START = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)
GOAL = np.array([4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)


@pytree
class Unasked:
    """A sampler that is never asked: straight edges do."""

    def propose(self, world, q_from, q_goal, key):
        """See the samplers."""
        raise AssertionError


def test_the_shortest_path_is_kept_until_the_budget_ends():
    occupied = np.zeros((50, 40), bool)
    occupied[24:26] = True
    occupied[24:26, 20:38] = False
    world = nrp_jax.build_world(nrp_jax.load_robot("snake"), nrp_jax.Grid(occupied=occupied))
    goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(GOAL))
    policy = NRPConnect(sampler=Unasked(), straight_iterations=1000)
    found, path = search_with_restarts(
        world,
        goal,
        policy,
        policy.init(world, goal, START[None], 4096),
        key=jax.random.key(0),
        termination=make_termination(0.0, max_iterations=120),
        time_limit_s=60.0,
    )
    # All of the budget is used, in more than one search, and the history is one.
    assert int(found.tree.iteration) == 120 and found.history[-1, 0] == 120
    cost = found.history[:, 4]
    assert np.all(np.diff(found.history[:, [0, 1, 5]], axis=0) >= 0)
    assert np.all(np.diff(cost[np.isfinite(cost)]) <= 0)
    assert len(np.unique(cost[np.isfinite(cost)])) > 2
    # The path is the shortest of them, and as long as it is said to be.
    np.testing.assert_array_equal(path[[0, -1]], [START, GOAL])
    assert path_length(world, path) == pytest.approx(cost[-1], rel=1e-5)
    assert found.stopped in (StopReason.REACHED, StopReason.ITERATIONS)


def test_what_is_refused_is_no_path():
    world = nrp_jax.build_world(
        nrp_jax.load_robot("snake"), nrp_jax.Grid(occupied=np.zeros((50, 40), bool))
    )
    goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(GOAL))
    policy = NRPConnect(sampler=Unasked(), straight_iterations=1000)
    shared = {"termination": make_termination(0.0, max_iterations=24), "time_limit_s": 60.0}
    tree, asked = policy.init(world, goal, START[None], 4096), []

    def second(path):
        asked.append(path)
        return len(asked) == 2

    found, path = search_with_restarts(
        world, goal, policy, tree, accept=second, key=jax.random.key(0), **shared
    )
    np.testing.assert_array_equal(path, asked[1])
    cost = found.history[:, 4]
    np.testing.assert_allclose(cost[np.isfinite(cost)][-1], path_length(world, path), rtol=1e-5)
    found, path = search_with_restarts(
        world, goal, policy, tree, accept=lambda _: False, key=jax.random.key(0), **shared
    )
    assert path is None and not np.isfinite(found.history[:, 4]).any()
