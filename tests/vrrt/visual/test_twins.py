"""Kinematic twins: other joint angles, nearly the same picture."""

import numpy as np
import pytest

from vrrt_jax.robots import load_robot
from vrrt_jax.robots.kinematics import batch_link_poses
from vrrt_jax.scene.world import build_world
from vrrt_jax.visual.twins import find_flips, twins

# Joints whose axes meet in one point: of the Panda those of the shoulder, of the Fetch those around
# the elbow and around the wrist. The UR5e has no three in a row.
FLIPS = {"panda": [0], "ur5e": [], "fetch": [3, 5]}


@pytest.mark.parametrize("name", FLIPS)
def test_flips_of_packaged_robots(name):
    assert [flip.first for flip in find_flips(load_robot(name).chain)] == FLIPS[name]


def test_only_two_links_of_a_twin_stand_elsewhere(rng):
    robot = load_robot("fetch")
    world = build_world(robot, [], engine="closed_form")
    q = rng.uniform(robot.lower, robot.upper, (16, robot.num_joints)).astype(np.float32)
    # The first are within half a turn of their joints, so that all twins are inside the limits.
    others = twins(world, q[:1])
    assert len(others) == 3
    poses = np.asarray(batch_link_poses(robot.chain, np.resize([*q[:1], *others], q.shape)))[:4]
    for twin, moved in zip(poses[1:], ([4, 5], [6, 7], [4, 5, 6, 7]), strict=True):
        elsewhere = np.flatnonzero(np.abs(twin - poses[0]).max(axis=(1, 2)) > 1e-3)
        assert elsewhere.tolist() == moved
    found = twins(world, q)
    inside = (found >= robot.lower) & (found <= robot.upper) | robot.is_continuous
    assert len(found) <= 3 * len(q) and inside.all()


def test_twins_outside_the_limits_are_left_out(panda):
    world = build_world(panda, [], engine="closed_form")
    q = np.zeros((2, 7), np.float32)
    q[:, 3] = -1.0
    q[1, :3] = [0.1, 0.5, 0.1]  # half a turn away from 0.1 is outside of 2.9 either way
    assert len(twins(world, q[1:])) == 0
    q[1, :3] = [1.0, 0.5, -1.0]
    (twin,) = twins(world, q[1:])
    np.testing.assert_allclose(twin[:3], [1.0 - np.pi, -0.5, np.pi - 1.0], atol=1e-6)
    np.testing.assert_array_equal(twin[3:], q[1, 3:])
