"""One tree goes on without the edges that the exact check refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import two_rooms

import nrp_jax
from nrp_jax.planner import Status
from nrp_jax.scene.exact import ExactScene
from vrrt_jax.core import tree as trees
from vrrt_jax.core.search import COST

pytestmark = pytest.mark.light_compilation
START = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)
GOAL = np.array([4.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)


@pytest.fixture(scope="module")
def solve():
    """Plans in two rooms that are checked so coarsely that edges jump through the wall."""
    snake, open_door = nrp_jax.load_robot("snake"), two_rooms()
    occupied = open_door.occupied.copy()
    occupied[24:26] = True
    closed_door = dataclasses.replace(open_door, occupied=occupied)

    def run(method, is_open=True, resolution=0.7, **budget):
        grid = open_door if is_open else closed_door
        coarse = nrp_jax.build_world(snake, grid, resolution=resolution)
        scene = ExactScene(snake, grid)
        options = {"key": jax.random.key(0), "method": method, "world": coarse, "scene": scene}
        return nrp_jax.plan(snake, grid, START, GOAL, goal_bias=0.2, **options, **budget)

    return run


def test_paths_that_jump_through_a_wall_are_cut_until_one_goes_around(solve):
    result = solve("rrt", max_expansions=32_000)
    assert result.ok and result.verification.ok
    assert result.refused > 0
    # Through the door at y = 3 m.
    assert result.path[:, 1].max() > 2.2
    # All of it is one search: iterations and seconds go on, and no refused path counts.
    assert np.all(np.diff(result.history[:, [0, 1]], axis=0) >= 0)
    assert result.history[-1, 1] <= result.timing["search_s"]
    cost = result.history[:, COST]
    assert np.isfinite(cost[-1]) and np.sum(np.isfinite(cost)) < len(cost)
    assert result.expansions == 32 * result.history[-1, 0]


def test_a_budget_that_ends_among_refused_paths_says_so(solve):
    result = solve("rrt", is_open=False, max_expansions=960)
    assert not result.ok and result.refused > 1 and result.expansions == 960
    assert result.status in (Status.NOT_VERIFIED, Status.MAX_ITERATIONS)
    assert np.all(np.isinf(result.history[-1:, COST]))


def test_a_star_whose_last_path_is_refused_keeps_the_first_that_was_not(solve):
    result = solve("irrt-star", resolution=0.35, max_expansions=8000)
    assert result.ok and result.verification.ok
    assert result.expansions == 8000 and result.refused > 0
    assert result.cost <= result.history[:, COST].min() + 1e-3


def test_without_drops_what_hangs_on_a_node():
    """Also where rewiring has made a later node the parent of an earlier one."""
    q = np.arange(7, dtype=np.float32)[:, None]
    tree = trees.create(q, q[:, 0], {"own": jnp.arange(7)}, 9)
    parent = jnp.array([-1, 0, 5, 1, 0, 1, 4, -1, -1])
    tree = dataclasses.replace(tree, parent=parent, cost=tree.q[:, 0])
    left = trees.without(tree, [5])
    assert int(left.size) == 5 and left.capacity == 9
    np.testing.assert_array_equal(left.q[:5, 0], [0, 1, 3, 4, 6])
    np.testing.assert_array_equal(left.parent, [-1, 0, 1, 0, 3, -1, -1, -1, -1])
    np.testing.assert_array_equal(left.payload["own"][:5], [0, 1, 3, 4, 6])
    np.testing.assert_array_equal(left.cost[:5], [0, 1, 3, 4, 6])
    assert np.all(np.isinf(left.score[5:])) and np.all(left.score[:5] == left.q[:5, 0])
