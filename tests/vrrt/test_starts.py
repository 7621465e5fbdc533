"""Paths start exactly where they are told, go on from there, and repeat no waypoint."""

from pathlib import Path

import jax
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax import ConfigurationGoal, PlannerConfig
from vrrt_jax.core.shortcut import without_repeats

KEY = jax.random.key(0)
URDF = Path(__file__).parents[1] / "cases/arms/19_path_starts_a_turn_away/cont.urdf"
METHODS = ("rrt-connect", "rrt", "rrt-star", "visual-rrt")


@pytest.fixture(scope="module")
def turner():
    return vrrt_jax.load_robot(URDF)


@pytest.fixture(scope="module")
def room(turner):
    return vrrt_jax.build_world(turner, engine="closed_form")


def assert_continuous(result, start):
    assert result.ok
    np.testing.assert_array_equal(result.path[0], np.float32(start))
    np.testing.assert_array_equal(result.trajectory[0], np.float32(start))
    assert np.abs(np.diff(result.trajectory, axis=0)).max() < 0.01
    assert np.abs(np.diff(result.path, axis=0)).max(axis=1).min(initial=1.0) > 1e-5
    np.testing.assert_allclose(result.path[-1], result.trajectory[-1], atol=1e-5)


@pytest.mark.light_compilation
@pytest.mark.parametrize("start", [9.0, -9.0, 3.2, np.pi, -np.pi, 100.0, -600.0])
def test_a_joint_stays_in_its_turn(turner, room, start):
    for away in (-1.0, 2.5, 1.0 + 2 * np.pi):
        q_start, q_goal = [start, 0.3], [start + away, -0.2]
        result = vrrt_jax.plan_to_configuration(turner, room, q_start, q_goal, key=KEY)
        assert_continuous(result, q_start)
        short = (away + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(result.path[-1], [start + short, -0.2], atol=2e-4)
        np.testing.assert_allclose(result.target, result.path[-1], atol=2e-4)


@pytest.mark.light_compilation
def test_batches_and_trees_stay_in_their_turn(turner, room):
    starts = np.array([[9.0, 0.3], [-20.0, 0.1]])
    goals = [ConfigurationGoal(q=np.array([8.0, 0.3])), ConfigurationGoal(q=np.array([0.1, 0.0]))]
    for result, start in zip(
        vrrt_jax.plan_batch(turner, room, goals, starts, key=KEY), starts, strict=True
    ):
        assert_continuous(result, start)
    for method in ("rrt", "rrt-star"):
        config = PlannerConfig().changed({"budget.max_iterations": 40, "tree.capacity": 2048})
        result = vrrt_jax.plan_to_configuration(
            turner, room, starts[0], [4.0, 0.2], key=KEY, planner=method, config=config
        )
        assert_continuous(result, starts[0])


@pytest.mark.light_compilation
@pytest.mark.parametrize("method", METHODS)
def test_a_plan_that_starts_at_its_goal_searches_for_nothing(turner, room, method):
    for q_goal in ([9.0, 0.3], [9.0 - 4 * np.pi, 0.3], [9.00001, 0.3]):
        goal = ConfigurationGoal(q=np.array(q_goal))
        result = vrrt_jax.plan(turner, room, goal, [9.0, 0.3], key=KEY, planner=method)
        assert result.ok and result.expansions == 0 and result.refused == 0
        np.testing.assert_array_equal(result.path, np.float32([[9.0, 0.3]]))
        np.testing.assert_array_equal(result.trajectory, result.path)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ([700.0, 0.0], "more than 100 turns"),
        ([np.nan, 0.0], "outside the limits"),
        ([1e300, 0.0], "outside the limits"),
        (["a", 0.0], "expected numbers"),
        ([0.0], "shape"),
        ([[0.0], [0.0, 1.0]], "expected numbers"),
    ],
)
def test_starts_that_make_no_sense_are_refused(turner, room, start, words):
    with pytest.raises(ValueError, match=words):
        vrrt_jax.plan_to_configuration(turner, room, start, [0.0, 0.0], key=KEY)


def test_repeated_waypoints_are_dropped(room):
    points = {
        "none": ([[0, 0], [1, 0], [1, 1]], [0, 1, 2]),
        "start": ([[0, 0], [0, 0], [1e-6, 0], [1, 1]], [0, 3]),
        "end": ([[0, 0], [1, 1], [1, 1.00001]], [0, 2]),
        "a turn away": ([[9, 0], [9 - 2 * np.pi, 0], [1, 1]], [0, 2]),
        "all": ([[1, 1]] * 4, [0]),
        "slowly": ([[0, 0], [8e-5, 0], [16e-5, 0], [1, 0]], [0, 2, 3]),
    }
    for name, (path, kept) in points.items():
        path = np.array(path, np.float32)
        np.testing.assert_array_equal(without_repeats(room, path), path[kept], err_msg=name)
