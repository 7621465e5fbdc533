"""Limits of motion come from makers, files and users, and are refused by name where missing."""

import re

import numpy as np
import pytest

import vrrt_jax
from vrrt_jax import MotionLimits, motion_limits

URDF = """
<robot name="two">
  <link name="base"/>
  <link name="one"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="two"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <joint name="first" type="revolute">
    <parent link="base"/><child link="one"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="5" velocity="1.5"/>
  </joint>
  <joint name="second" type="continuous">
    <parent link="one"/><child link="two"/><origin xyz="1 0 0"/><axis xyz="0 0 1"/>
    <limit effort="5" velocity="2.5" acceleration="4"/>
  </joint>
</robot>
"""


@pytest.mark.parametrize("name", vrrt_jax.robot_names())
def test_packaged_robots_have_limits(name):
    robot = vrrt_jax.load_robot(name)
    limits = motion_limits(robot)
    for own in vars(limits).values():
        assert own.shape == (robot.num_joints,) and (own > 0).all()


def test_what_is_given_takes_the_place_of_the_makers(panda):
    limits = motion_limits(panda, MotionLimits(acceleration=1.0))
    np.testing.assert_array_equal(limits.acceleration, np.ones(7))
    np.testing.assert_array_equal(limits.velocity[[0, 6]], [2.175, 2.61])


def test_a_urdf_says_velocities_and_what_it_lacks_is_named(tmp_path):
    (tmp_path / "two.urdf").write_text(URDF)
    robot = vrrt_jax.load_robot(tmp_path / "two.urdf")
    given = motion_limits(robot, MotionLimits(acceleration=[1, 2], jerk=10))
    np.testing.assert_array_equal(given.velocity, [1.5, 2.5])
    with pytest.raises(ValueError, match=r"no acceleration limit for first; .*MotionLimits\("):
        motion_limits(robot, MotionLimits(jerk=10))


def test_mjcf_has_none(gantry):
    with pytest.raises(ValueError, match="no velocity limit for x, y"):
        motion_limits(gantry)


@pytest.mark.parametrize("velocity", [0, -1, np.nan, [1, 2, 3], "fast", [1.0, np.inf]])
def test_limits_that_make_no_sense_are_refused(gantry, velocity):
    with pytest.raises(ValueError, match=re.escape("expected a positive number [rad/s]")):
        motion_limits(gantry, MotionLimits(velocity=velocity, acceleration=1, jerk=1))


@pytest.mark.parametrize("fields", [{"speed": 1.0}, [1.0]])
def test_fields_that_do_not_exist_are_refused(fields):
    with pytest.raises(ValueError, match="expected some of velocity, acceleration, jerk"):
        MotionLimits.from_dict(fields)
