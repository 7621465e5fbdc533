"""NRP-Connect: straight edges first, then learned waypoints in both trees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.planners.nrp_connect import NRPConnect, default_planner, search_connect
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.search import StopReason, make_termination
from vrrt_jax.core.types import pytree

pytestmark = pytest.mark.light_compilation
START = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)
GOAL = np.array([4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)
DOOR = np.array([2.5, 3.0, 0.0, 0.8, -0.8, 0.8, -0.8, 0.8], np.float32)


class Asked(Exception):
    """A network was asked."""


@pytree
class Tells:
    """A sampler that tells that it was asked."""

    def propose(self, world, q_from, q_goal, key):
        """See the samplers."""
        raise Asked


@pytree
class Doorman:
    """A sampler that always proposes to stand in the door."""

    door: jax.Array  # (D,)

    def propose(self, world, q_from, q_goal, key):
        """See the samplers."""
        return jnp.broadcast_to(self.door, q_from.shape)


@pytest.fixture(scope="module")
def world():
    """The snake in two rooms with a door of one meter."""
    occupied = np.zeros((50, 40), bool)
    occupied[24:26] = True
    occupied[24:26, 25:35] = False
    return nrp_jax.build_world(nrp_jax.load_robot("snake"), nrp_jax.Grid(occupied=occupied))


@pytest.fixture(scope="module")
def solve(world):
    def run(policy, q_goal, iterations=64):
        goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(q_goal))
        return search_connect(
            world,
            goal,
            policy,
            policy.init(world, goal, START[None], 512),
            key=jax.random.key(0),
            termination=make_termination(policy.goal_score(goal), max_iterations=iterations),
            time_limit_s=60.0,
        )

    return run


def test_no_network_is_asked_where_straight_edges_do(solve):
    near = START.copy()
    near[1] += 1.0
    found = solve(NRPConnect(sampler=Tells()), near)
    assert found.stopped is StopReason.REACHED


def test_no_network_is_asked_within_a_budget_of_straight_iterations(solve):
    found = solve(NRPConnect(sampler=Tells(), straight_iterations=2), GOAL, iterations=1)
    assert found.stopped is StopReason.ITERATIONS and int(found.tree.iteration) == 1


def test_networks_are_asked_where_straight_edges_fail(solve):
    with pytest.raises(Asked):
        solve(NRPConnect(sampler=Tells(), straight_iterations=1), GOAL)


def test_both_trees_go_by_waypoints_and_the_search_goes_on(solve, world):
    policy = NRPConnect(sampler=Doorman(door=jnp.asarray(DOOR)), straight_iterations=1)
    found = solve(policy, GOAL)
    assert found.stopped is StopReason.REACHED
    path = policy.extract_path(found.tree)
    np.testing.assert_array_equal(path[[0, -1]], [START, GOAL])
    assert np.any(np.all(np.abs(path - DOOR) < 1e-4, axis=1))
    # One history of both searches: iterations, seconds and checks never fall.
    assert found.history[0, 0] == 0 and found.history[-1, 0] == int(found.tree.iteration)
    assert np.all(np.diff(found.history[:, [0, 1, 3, 5]], axis=0) >= 0)
    assert found.history[-1, 1] <= found.search_s


def test_only_lanes_that_extend_go_to_waypoints(world):
    policy = NRPConnect(sampler=Doorman(door=jnp.asarray(DOOR)), lanes=8)
    goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(GOAL))
    tree = policy.init(world, goal, START[None], 64)
    key = jax.random.key(1)
    learned = policy.propose(world, goal, tree, key)
    straight = RRTConnect.propose(policy.straight(), world, goal, tree, jax.random.split(key)[0])
    np.testing.assert_array_equal(learned.parent, straight.parent)
    np.testing.assert_array_equal(learned.target[:4], np.broadcast_to(DOOR, (4, 8)))
    np.testing.assert_array_equal(learned.target[4:], straight.target[4:])
    assert np.asarray(straight.aux.connects)[4:].sum() == 2  # the two roots


def test_the_default_is_what_the_packaged_networks_fit(world):
    snake = nrp_jax.load_robot("snake")
    fine = nrp_jax.Grid(occupied=np.zeros((50, 40), bool), resolution=0.05)
    assert default_planner(snake, world) == "nrp-connect"
    assert default_planner(snake, nrp_jax.build_world(snake, fine)) == "rrt-connect"
