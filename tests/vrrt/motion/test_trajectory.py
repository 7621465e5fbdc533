"""A path becomes a trajectory that stays free, and inputs that make none are refused."""

import dataclasses
import re

import numpy as np
import pytest

import vrrt_jax
from vrrt_jax import Obstacle, time_parameterize
from vrrt_jax.motion.trajectory import simplified

CORNER = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])
FAR = Obstacle(name="far", kind="sphere", position=(-0.5, 5, 0), size=(0.1, 0, 0))


def inner(gap):
    """A box inside of the corner, at a distance from the ball on both straight lines."""
    edge, half = 4 - 0.01 - gap, 1.0
    return Obstacle(
        name="in", kind="box", position=(edge - half, 4 - edge + half, 0), size=[half] * 3
    )


def test_without_a_world_it_stops_at_the_corner(gantry, slow):
    timed = time_parameterize(gantry, CORNER, limits=slow)
    assert timed.stops == 1 and timed.deviation == 0 and timed.verification.ok
    # Two motions from rest to rest of 4 m each: s / v + v / a + a / j.
    assert timed.duration == pytest.approx(2 * (4.0 + 0.5 + 0.2))
    on_lines = np.minimum(np.abs(timed.positions[:, 1]), np.abs(timed.positions[:, 0] - 4))
    assert on_lines.max() < 1e-9
    assert np.abs(timed.velocities[[0, -1]]).max() < 1e-6


def test_in_a_world_it_rounds_the_corner_and_is_quicker(gantry, slow):
    sharp = time_parameterize(gantry, CORNER, [FAR], limits=slow, tolerance=0)
    timed = time_parameterize(gantry, CORNER, [FAR], limits=slow, tolerance=0.1)
    assert timed.stops == 0 and timed.deviation == pytest.approx(0.1)
    assert timed.duration < 0.95 * sharp.duration
    np.testing.assert_allclose(timed.positions[[0, -1]], CORNER[[0, -1]], atol=1e-9)
    at_rest = np.linalg.norm(timed.velocities, axis=1) < 0.05
    assert not at_rest[20:-20].any()


def test_a_blend_that_touches_something_is_halved_or_left_out(gantry, slow):
    free = time_parameterize(gantry, CORNER, [inner(0.1)], limits=slow, tolerance=0.4)
    assert free.stops == 0 and 0 < free.deviation < 0.4 and free.verification.ok
    tight = time_parameterize(gantry, CORNER, [inner(0.0002)], limits=slow, tolerance=0.4)
    assert tight.stops == 1 and tight.deviation == 0 and tight.verification.ok


def test_half_the_speed_takes_twice_the_time(gantry, slow):
    full = time_parameterize(gantry, CORNER, [FAR], limits=slow)
    half = time_parameterize(gantry, CORNER, [FAR], limits=slow, speed=0.5)
    assert half.duration == pytest.approx(2 * full.duration)
    assert np.abs(half.velocities).max() == pytest.approx(0.5, abs=1e-3)


def test_a_dense_path_is_driven_as_its_waypoints_are(panda):
    waypoints = np.stack([panda.home, panda.home + 0.2])
    dense = np.linspace(*waypoints, 300).astype(np.float32)
    few, many = (time_parameterize(panda, path) for path in (waypoints, dense))
    assert many.stops == 0 and many.duration == pytest.approx(few.duration, rel=1e-4)


def test_joints_that_wrap_take_the_shorter_direction(tmp_path, slow):
    file = tmp_path / "wheel.xml"
    body = '<body><joint name="w"/><geom size=".1" pos="1 0 0"/></body>'
    file.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    wheel = vrrt_jax.load_robot(file)
    timed = time_parameterize(wheel, np.array([[3.0], [-3.0]]), limits=slow)
    assert timed.positions[-1, 0] == pytest.approx(2 * np.pi - 3.0)


def test_a_goal_that_is_the_start_is_one_point(gantry, slow):
    timed = time_parameterize(gantry, CORNER[:1], limits=slow)
    assert timed.duration == 0 and timed.positions.tolist() == [[0.0, 0.0]]


def test_paths_that_are_not_free_are_refused(gantry, slow):
    wall = dataclasses.replace(FAR, name="wall", position=(2, 0, 0))
    with pytest.raises(ValueError, match="ball touches wall at 2.* expected a path that passes"):
        time_parameterize(gantry, CORNER, [wall], limits=slow)
    with pytest.raises(ValueError, match="x = 9.* is outside"):
        time_parameterize(gantry, 3 * CORNER, limits=slow)


@pytest.mark.parametrize("change", [{"speed": 0}, {"speed": 1.5}, {"tolerance": -1}, {"period": 0}])
def test_numbers_out_of_range_are_refused(gantry, slow, change):
    (name,) = change
    with pytest.raises(ValueError, match=re.escape(f"{name} is {change[name]}; expected a")):
        time_parameterize(gantry, CORNER, limits=slow, **change)


def test_simplified_paths_keep_their_corners():
    line = np.linspace([0.0, 0.0], [1.0, 1.0], 50)
    path = np.concatenate([line, np.linspace([1.0, 1.0], [2.0, 0.0], 50)])
    np.testing.assert_allclose(simplified(path), [[0, 0], [1, 1], [2, 0]])
