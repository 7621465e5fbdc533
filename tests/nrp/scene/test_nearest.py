"""What a refused configuration touches, and which free one is nearest; maps that lie far away."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.planner import plan
from nrp_jax.scene.configurations import check_configuration
from nrp_jax.scene.exact import ExactScene
from vrrt_jax.core.types import pytree

pytestmark = pytest.mark.light_compilation

TUCK = np.array([3, 3, 0, 0.05, 1.32, 1.40, -0.2, 1.72, 0.0, 1.66, 0.0])
ORIGINS = [(0.0, 0.0), (-13.37, 250.01), (66000.3, 48000.7), (500000.13, 4600000.1)]


@pytest.fixture(scope="module")
def fetch():
    return nrp_jax.load_robot("fetch")


@pytest.fixture(scope="module")
def room(fetch):
    """A room with a shelf, as (grid, world)."""
    occupied = np.zeros((60, 60, 20), bool)
    occupied[40:44, 10:50, 8:10] = True
    grid = nrp_jax.Grid(occupied=occupied)
    return grid, nrp_jax.build_world(fetch, grid)


@pytest.mark.parametrize("torso", [0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.386])
def test_the_pose_that_a_fetch_drives_in_is_free(fetch, room, torso):
    grid, world = room
    q = TUCK.copy()
    q[3] = torso
    assert not ExactScene(fetch, grid).touching(q)
    np.testing.assert_allclose(check_configuration(fetch, world, q, "start"), q, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({3: 0.39}, r"torso_lift is 0.39; its limits are \[0.000, 0.386\]; the nearest free"),
        ({4: 0.0, 5: 1.45, 7: 2.2}, "touches"),
        ({0: 3.62, 4: 0, 5: -0.3, 7: 0, 9: 0}, r"touches the map at \(4.\d\d, .*, 0.[89]\d\)"),
        ({0: 0.27}, r"base touches the map at \(-?0.0\d, .*; the nearest free"),
    ],
)
def test_a_refusal_names_what_touches_and_the_nearest_free(fetch, room, change, message):
    _, world = room
    q = TUCK.copy()
    for joint, value in change.items():
        q[joint] = value
    with pytest.raises(ValueError, match=message) as refused:
        check_configuration(fetch, world, q, "start")
    # What is named is accepted as it is printed.
    if "nearest free" in str(refused.value):
        named = np.array([float(v) for v in str(refused.value).split("found is ")[1].split(",")])
        check_configuration(fetch, world, named, "start")
        np.testing.assert_array_equal(named, nrp_jax.nearest_free(fetch, world, q))
        step = np.abs(named - q)
        assert np.all(step[~np.array(fetch.angular)] <= 0.05 + 1e-5) and step.max() <= 0.1 + 1e-5


def test_the_nearest_free_configuration_is_near(fetch, room):
    _, world = room
    q = TUCK.copy()
    found = nrp_jax.nearest_free(fetch, world, q)
    assert found is not None
    np.testing.assert_allclose(found, q, atol=1e-5)
    q[0] = 0.27  # the base has a radius of 0.28 m
    found = nrp_jax.nearest_free(fetch, world, q)
    assert found is not None and np.linalg.norm(found - q) < 0.03
    q[0] = 0.2
    assert nrp_jax.nearest_free(fetch, world, q) is None
    with pytest.raises(ValueError, match=r"expected \(11,\) finite numbers: x, y"):
        nrp_jax.nearest_free(fetch, world, q[:8])


def test_no_collision_is_missed_wherever_the_map_lies(rng):
    robot = nrp_jax.load_robot("snake")
    occupied = rng.random((60, 60)) < 0.02
    places = rng.uniform(0.5, 5.5, (1024, 2))
    for origin in ORIGINS:
        grid = nrp_jax.Grid(occupied=occupied, origin=origin)
        world, scene = nrp_jax.build_world(robot, grid), ExactScene(robot, grid)
        q = rng.uniform(-3.1, 3.1, (1024, 8))
        q[:, :2] = places + origin
        q = q.astype(np.float32)
        free = np.asarray(nrp_jax.batch_is_free(world, jnp.asarray(q)))
        exact = np.array([not scene.touching(row.astype(float)) for row in q])
        assert not np.any(free & ~exact)
        assert np.mean(~free & exact) < 0.02 * exact.mean() + 0.01


def test_plans_are_the_same_up_to_the_shift(tmp_path):
    from nrp_jax.viz import save_plan

    robot, paths = nrp_jax.load_robot("snake"), []
    occupied = np.zeros((50, 40), bool)
    occupied[24:26, :25] = occupied[24:26, 35:] = True
    start = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9])
    goal = np.array([4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5])
    for origin in ORIGINS:
        grid = nrp_jax.Grid(occupied=occupied, origin=origin)
        shift = np.append(origin, np.zeros(6))
        world = nrp_jax.build_world(robot, grid)
        result = plan(robot, grid, start + shift, goal + shift, key=jax.random.key(0), world=world)
        assert result.ok
        for path in (result.path, result.trajectory, result.raw_path):
            np.testing.assert_array_equal(path[0], start + shift)
        np.testing.assert_allclose(result.path[-1], goal + shift, rtol=0, atol=1e-6)
        paths.append(result.path - shift)
        tree = np.asarray(result.tree.q)[: int(result.tree.size), :2] - origin
        assert tree.min() > -0.01 and (tree < np.array([5.01, 4.01])).all()
    for path in paths[1:]:
        np.testing.assert_allclose(path, paths[0], atol=1e-4)
    save_plan(tmp_path / "plan.png", robot, grid, world, result, goal + shift)
    assert (tmp_path / "plan.png").stat().st_size > 10_000


class West(nrp_jax.GridWorld):
    """A home whose eastern part is closed."""

    def is_free(self, q):
        return super().is_free(q) & (q[0] < 102.0)


def test_a_constraint_of_ones_own_sees_the_places_of_the_map():
    robot = nrp_jax.load_robot("snake")
    q = np.array([101.0, 52.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9])
    grid = nrp_jax.Grid(occupied=np.zeros((40, 40), bool), origin=(100.0, 50.0))
    world = West(**vars(nrp_jax.build_world(robot, grid)))
    check_configuration(robot, world, q, "start")
    q[0] = 103.0
    with pytest.raises(ValueError, match="the start is refused by West.is_free"):
        check_configuration(robot, world, q, "start")
    far = nrp_jax.with_grid(world, dataclasses.replace(grid, origin=(500000.0, 4600000.0)))
    with pytest.raises(ValueError, match="too far away for the places that West may know"):
        check_configuration(robot, far, q + np.append([499900.0, 4599950.0], np.zeros(6)), "start")


@pytree
class Beyond(nrp_jax.ConfigurationGoal):
    """Any place east of a line on the map."""

    def loss(self, world, q):
        return jnp.maximum(102.0 - q[0], 0.0)


def test_a_goal_of_ones_own_sees_the_places_of_the_map():
    robot = nrp_jax.load_robot("snake")
    q = np.array([101.0, 52.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9])
    grid = nrp_jax.Grid(occupied=np.zeros((40, 40), bool), origin=(100.0, 50.0))
    goal = Beyond(q=q + np.append([2.0, 0.5], np.zeros(6)))
    result = plan(robot, grid, q, goal, key=jax.random.key(0), planner="rrt", capacity=2048)
    assert result.ok and result.path[-1, 0] >= 102.0 - 1e-4
    np.testing.assert_array_equal(result.path[0], q)
    far = dataclasses.replace(grid, origin=(500000.0, 4600000.0))
    shift = np.append([499900.0, 4599950.0], np.zeros(6))
    with pytest.raises(ValueError, match="too far away for the places that Beyond may know"):
        plan(robot, far, q + shift, Beyond(q=goal.q + shift), key=jax.random.key(0))


def test_a_picture_of_a_long_map_is_small(tmp_path):
    from PIL import Image

    from nrp_jax.viz import save_plan

    robot = nrp_jax.load_robot("snake")
    grid = nrp_jax.Grid(occupied=np.zeros((12, 300), bool))
    q = np.array([0.6, 1.0, 0, 1.0, -0.8, 1.0, -0.8, 0.9])
    world = nrp_jax.build_world(robot, grid)
    result = plan(robot, grid, q, q, key=jax.random.key(0), world=world, max_expansions=32)
    for shape in ((12, 100_000), (100_000, 12), (1, 100_000)):
        large = dataclasses.replace(grid, occupied=np.zeros(shape, bool))
        save_plan(tmp_path / "plan.png", robot, large, world, result, q)
        width, height = Image.open(tmp_path / "plan.png").size
        assert max(width, height) < 1500 and min(width, height) > 150
