"""Simulated robots track trajectories, and say what they touched and what they asked for."""

import dataclasses

import numpy as np
import pytest

from vrrt_jax import MotionLimits, Obstacle, execute_in_sim, load_robot, time_parameterize
from vrrt_jax.robots import mesh_sources

LINE = np.array([[0.0, 0.0], [2.0, 0.0]])
FAR = Obstacle(name="far", kind="sphere", position=(-0.5, 5, 0), size=(0.1, 0, 0))


@pytest.fixture(scope="module")
def timed(gantry, slow):
    return time_parameterize(gantry, LINE, limits=slow)


def test_a_trajectory_within_the_limits_is_tracked(gantry, timed):
    tracking = execute_in_sim(gantry, [FAR], timed)
    assert tracking.ok and tracking.max_error < 0.002
    # 3 kg at 2 m/s^2, of 30 N.
    assert tracking.torque_share == pytest.approx(0.2, rel=0.02)
    np.testing.assert_allclose(tracking.positions[-1], LINE[-1], atol=0.002)


def test_motors_that_are_too_weak_are_told(gantry):
    limits = MotionLimits(velocity=5.0, acceleration=50.0, jerk=1000.0)
    tracking = execute_in_sim(gantry, [FAR], time_parameterize(gantry, LINE, limits=limits))
    assert tracking.torque_share > 4 and tracking.max_error > 0.1


def test_masses_that_are_not_known_cost_accuracy(gantry, timed):
    known, unknown = (execute_in_sim(gantry, [], timed, mass_error=e) for e in (0.0, 0.5))
    assert unknown.mean_error > 3 * known.mean_error


def test_contacts_are_told_by_name(gantry, timed):
    wall = dataclasses.replace(FAR, name="wall", position=(1, 0.05, 0))
    contact = execute_in_sim(gantry, [wall], timed).contact
    assert contact is not None and contact.startswith("ball touches wall at 4")


def test_the_panda_tracks_with_its_true_masses(panda):
    if mesh_sources.mesh_file(panda.mesh_source) is None:
        pytest.skip("the Panda's masses are not installed (mujoco-menagerie or genesis-world)")
    model = mesh_sources.inertial_spec(panda).compile()
    assert 15 < model.body_mass.sum() < 20 and model.nu == 0
    np.testing.assert_array_equal(model.jnt_actfrcrange[:, 1], [87] * 4 + [12] * 3)
    path = np.stack([panda.home, panda.home + [0.5, 0.2, 0.3, 0.4, -0.5, 0.5, 0.5]])
    tracking = execute_in_sim(panda, [FAR], time_parameterize(panda, path))
    assert tracking.ok and tracking.mean_error < 0.02 and tracking.torque_share < 1


@pytest.mark.parametrize("name", ["ur5e", "fetch"])
def test_packaged_robots_have_masses_and_track(name):
    """The Fetch too, whose joints are damped so much that instants say little of steps."""
    robot = load_robot(name)
    spec = mesh_sources.inertial_spec(robot)
    if spec is None:
        pytest.skip(f"the masses of the {name} are not installed")
    model = spec.compile()
    assert tuple(model.joint(j).name for j in range(model.njnt)) == robot.joint_names
    assert np.ptp(model.body_mass[1:]) > 1  # not all the same
    path = np.stack([robot.home, robot.home + 0.05])
    assert execute_in_sim(robot, [], time_parameterize(robot, path)).max_error < 0.002


def test_other_robots_and_masses_are_refused(panda, gantry, timed):
    with pytest.raises(ValueError, match="joints x, y; expected those of 'panda': joint1"):
        execute_in_sim(panda, [], timed)
    with pytest.raises(ValueError, match="mass_error is -1; expected a share above -1"):
        execute_in_sim(gantry, [], timed, mass_error=-1)
