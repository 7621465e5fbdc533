"""Restarts keep the shortest path that any of the searches has found."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.planners.nrp_connect import NRPConnect
from nrp_jax.planners.restarts import search_with_restarts
from nrp_jax.planners.shorten import shorten, shorten_parts
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


@pytest.fixture(scope="module")
def world():
    """The snake in an open room."""
    grid = nrp_jax.Grid(occupied=np.zeros((50, 40), bool))
    return nrp_jax.build_world(nrp_jax.load_robot("snake"), grid)


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


def test_what_compiles_at_first_takes_none_of_the_budget(world):
    goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(GOAL))
    policy = NRPConnect(sampler=Unasked(), straight_iterations=1000)
    asked = []

    def accept(path):
        if not asked:
            time.sleep(1.0)
        asked.append(len(path))
        return True

    found, path = search_with_restarts(
        world,
        goal,
        policy,
        policy.init(world, goal, START[None], 4096),
        accept=accept,
        key=jax.random.key(0),
        termination=make_termination(0.0, max_iterations=48),
        time_limit_s=60.0,
    )
    assert path is not None and asked[0] == 2
    assert found.compile_s > 1.0 > found.history[np.isfinite(found.history[:, 4])][0, 1]


def test_what_is_refused_is_no_path(world):
    goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(GOAL))
    policy = NRPConnect(sampler=Unasked(), straight_iterations=1000)
    shared = {"termination": make_termination(0.0, max_iterations=24), "time_limit_s": 60.0}
    tree = policy.init(world, goal, START[None], 4096)

    def accept(path):  # all but the straight way
        return len(path) > 2 or not np.array_equal(path[[0, -1]], [START, GOAL])

    found, path = search_with_restarts(
        world, goal, policy, tree, accept=accept, key=jax.random.key(0), **shared
    )
    assert accept(path) and path_length(world, path) < 1.5 * path_length(
        world, np.stack([START, GOAL])
    )
    cost = found.history[:, 4]
    np.testing.assert_allclose(cost[np.isfinite(cost)][-1], path_length(world, path), rtol=1e-5)
    found, path = search_with_restarts(
        world, goal, policy, tree, accept=lambda _: False, key=jax.random.key(0), **shared
    )
    assert path is None and not np.isfinite(found.history[:, 4]).any()


def test_what_is_refused_is_shortened_in_parts(world):
    # A detour, and a place in it that a path may not leave out.
    kept = (START + GOAL) / 2 + np.array([0, 1, *np.zeros(6)], np.float32)
    path = np.linspace(START, kept, 9), np.linspace(kept, GOAL, 9)[1:]
    path = np.concatenate(path).astype(np.float32)
    path[[3, 12], 1] += 0.5

    def accept(part):
        return not np.array_equal(part[[0, -1]], [START, GOAL])

    assert not accept(shorten(world, path, key=jax.random.key(0)))
    found = shorten_parts(world, path, accept, key=jax.random.key(0))
    np.testing.assert_array_equal(found, [START, kept, GOAL])
    assert shorten_parts(world, path, lambda _: False, key=jax.random.key(0)) is None
