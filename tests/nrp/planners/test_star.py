"""RRT*, Informed RRT*, BIT* and NRP* in a home: paths get shorter, and costs stay right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.planner import Status, plan
from nrp_jax.scene.exact import ExactScene
from vrrt_jax.core.rewire import with_costs
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.core.types import pytree

START = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)
GOAL = np.array([4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)
STARS = ("rrt-star", "irrt-star", "bit-star", "nrp-star-d")


@pytree
class Halfway:
    """A sampler that proposes the middle of the way to the aim."""

    def propose(self, world, q_from, q_goal, key):
        """See the samplers."""
        return world.interpolate(q_from, q_goal, 0.5)


@pytest.fixture(scope="module")
def snake():
    return nrp_jax.load_robot("snake")


@pytest.fixture(scope="module")
def solve(snake):
    """Plans in two rooms, with a door of one meter or without."""
    homes = []
    for door in (slice(25, 35), slice(0)):
        occupied = np.zeros((50, 40), bool)
        occupied[24:26] = True
        occupied[24:26, door] = False
        grid = nrp_jax.Grid(occupied=occupied)
        homes.append((grid, nrp_jax.build_world(snake, grid), ExactScene(snake, grid)))

    def run(method, goal=GOAL, home=0, **options):
        grid, world, scene = homes[home]
        sampler = Halfway() if method == "nrp-star-d" else None
        budget = {"capacity": 2048, "max_expansions": 3200, "goal_bias": 0.2, **options}
        shared = {"world": world, "scene": scene, "sampler": sampler, "key": jax.random.key(0)}
        return plan(snake, grid, START, goal, method=method, **shared, **budget)

    return run


@pytest.fixture(scope="module")
def world(snake):
    occupied = np.zeros((50, 40), bool)
    return nrp_jax.build_world(snake, nrp_jax.Grid(occupied=occupied))


def check_tree(world, tree):
    """No cycles, and costs that are the lengths of the ways up."""
    size, parent = int(tree.size), np.asarray(tree.parent)
    assert np.all(parent[size:] == -1) and np.all(np.isinf(tree.score[size:]))
    root = np.arange(size)
    for _ in range(size):
        up = np.where(parent[root] >= 0, parent[root], root)
        if np.array_equal(up, root):
            break
        root = up
    assert np.all(parent[root] == -1), "a cycle"
    np.testing.assert_allclose(
        jax.jit(with_costs)(world, tree).cost[:size], tree.cost[:size], atol=1e-3
    )


@pytest.mark.light_compilation
@pytest.mark.parametrize("method", STARS)
def test_the_budget_is_used_and_paths_never_get_longer(solve, world, method):
    # An iteration of BIT* costs a fraction of the others'.
    budget = 9600 if method == "bit-star" else 3200
    result = solve(method, max_expansions=budget)
    assert result.ok and result.expansions == budget
    cost = result.history[:, 4]
    first = cost[np.isfinite(cost)][0]
    assert np.all(cost[1:] <= cost[:-1] + 1e-4), "never worse than before"
    assert cost[-1] < first
    np.testing.assert_allclose(path_length(world, result.raw_path), cost[-1], rtol=1e-4)
    np.testing.assert_array_equal(result.path[0], START)
    check_tree(world, result.tree)


@pytest.mark.light_compilation
@pytest.mark.parametrize("method", ["irrt-star", "bit-star"])
def test_a_closed_door_and_one_lane(solve, method):
    """Both are one program: without a path the budget ends, and the status says so."""
    closed = solve(method, home=1, lanes=1, max_expansions=24)
    assert closed.status is Status.MAX_ITERATIONS and closed.advice == "raise max_expansions"
    assert np.all(np.isinf(closed.history[:, 4]))
    near = START + np.array([0.4, 0.3, 0, 0, 0, 0, 0, 0], np.float32)
    found = solve(method, goal=near, lanes=1, max_expansions=24)
    assert found.ok and found.expansions == 24


def test_the_informed_set_of_a_drive_lies_in_its_box():
    """Also of headings and arms that wrap."""
    fetch = nrp_jax.load_robot("fetch")
    grid = nrp_jax.Grid(occupied=np.zeros((40, 40, 20), bool))
    world = nrp_jax.build_world(fetch, grid)
    q = jax.random.uniform(jax.random.key(0), (4000, 11), minval=world.lower, maxval=world.upper)
    start, goal = q[:2]
    totals = world.distance(jnp.broadcast_to(start, q.shape), q) + world.distance(q, goal)
    for share in (1.05, 1.3, 2.0):
        cost = share * world.distance(start, goal)
        lower, upper = world.informed_box(start, goal, cost)
        inside = np.asarray(totals < cost)
        assert np.all((q[inside] >= lower) & (q[inside] <= upper))
    assert inside.sum() > 100
