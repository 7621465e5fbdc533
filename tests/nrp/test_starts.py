"""In homes: paths start where they are told, in their turn; the exact check misses nothing thin."""

from concurrent.futures import ThreadPoolExecutor

import jax
import mujoco
import numpy as np
import pytest

import nrp_jax
from nrp_jax.planners.by_name import planners_of
from nrp_jax.scene.exact import ExactScene, verify

KEY = jax.random.key(0)
SNAKE = [3.0, 3.0, 0.3, 0.2, 0.0, 0.1, 0.0, 0.0]


@pytest.fixture(scope="module")
def snake():
    return nrp_jax.load_robot("snake")


@pytest.fixture(scope="module")
def floor():
    return nrp_jax.Grid(occupied=np.zeros((60, 60), bool))


@pytest.mark.light_compilation
@pytest.mark.parametrize("method", planners_of("snake"))
def test_a_plan_that_starts_at_its_goal_searches_for_nothing(snake, floor, method):
    for turns in (0.0, 2 * np.pi):
        start = np.array(SNAKE)
        start[2] += turns
        result = nrp_jax.plan(snake, floor, start, SNAKE, key=KEY, method=method)
        assert result.ok and result.expansions == 0 and result.refused == 0
        np.testing.assert_array_equal(result.path, start[None])


@pytest.mark.light_compilation
def test_a_heading_stays_in_its_turn(snake, floor):
    start, goal = np.array(SNAKE), np.array([4.5, 2.0, -2.8, 0, 0, 0, 0, 0])
    start[2] = 9.0
    world = nrp_jax.build_world(snake, floor)
    for method in ("rrt-connect", "rrt"):
        result = nrp_jax.plan(
            snake, floor, start, goal, key=KEY, method=method, world=world, capacity=2048
        )
        assert result.ok
        for path in (result.path, result.trajectory, result.raw_path):
            np.testing.assert_array_equal(path[0], start)
        assert np.abs(np.diff(result.trajectory, axis=0)).max() < 0.021
        assert np.abs(np.diff(result.path, axis=0)).max(axis=1).min() > 1e-5
        np.testing.assert_allclose(result.path[-1], result.trajectory[-1], atol=1e-5)
        np.testing.assert_allclose(result.path[-1, 2], goal[2] + 4 * np.pi, atol=1e-4)


@pytest.mark.parametrize("heading", [1e4, np.nan, np.inf, 1e300])
def test_headings_that_make_no_sense_are_refused(snake, floor, heading):
    start = np.array(SNAKE)
    start[2] = heading
    with pytest.raises(ValueError, match="the start's"):
        nrp_jax.plan(snake, floor, start, SNAKE, key=KEY)


def test_thin_posts_in_reach_of_the_tail_are_met(snake, rng):
    """The snake uncurls: in a step of 0.02 rad of all joints its tail goes farther than it is wide.

    Posts of 2 mm stand where the tail comes by.
    """
    trajectory = np.tile(np.array([1.0, 1.0, 0, 0, 0, 0, 0, 0]), (26, 1))
    trajectory[:, 2:] = 0.02 * np.arange(-13, 13)[:, None]
    limits = {"lower": np.full(8, -1e9), "upper": np.full(8, 1e9)}
    model = mujoco.MjModel.from_xml_string(snake.xml)
    data = mujoco.MjData(model)
    missed = 0
    for share in rng.uniform(5.0, 20.0, 30):
        whole = int(share)
        data.qpos[:] = trajectory[whole] + (share - whole) * 0.02 * (np.arange(8) > 1)
        mujoco.mj_kinematics(model, data)
        tail = data.geom_xpos[-1] + data.geom_xmat[-1].reshape(3, 3) @ [0.0, 0.055, 0.0]
        occupied = np.zeros((1000, 1000), bool)
        occupied[tuple((tail[:2] / 0.002).astype(int))] = True
        scene = ExactScene(snake, nrp_jax.Grid(occupied=occupied, resolution=0.002))
        assert "touches the map" in str(verify(scene, trajectory, **limits).contact)
        missed += not any(scene.touching(q) for q in trajectory)
    assert missed >= 3  # by the configurations of the trajectory alone


def test_threads_may_share_a_scene(snake):
    occupied = np.zeros((60, 60), bool)
    occupied[37, 20:40] = True
    scene = ExactScene(snake, nrp_jax.Grid(occupied=occupied))
    rng = np.random.default_rng(0)
    limits = {"lower": np.full(8, -1e9), "upper": np.full(8, 1e9)}
    step = rng.uniform(-0.02, 0.02, (24, 1, 8))
    trajectories = [*(np.array(SNAKE) + step * np.arange(60)[:, None])]

    def check(trajectory):
        return repr(verify(scene, trajectory, **limits))

    expected = [check(trajectory) for trajectory in trajectories]
    assert len(set(expected)) > 3
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(check, trajectories * 2)) == expected * 2
