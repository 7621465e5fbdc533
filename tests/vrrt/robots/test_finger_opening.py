"""The fingers of packaged robots are fixed where ``freeze`` says."""

import mujoco
import numpy as np
import pytest

from vrrt_jax.checks import check_start
from vrrt_jax.robots import load_robot
from vrrt_jax.robots.mesh_sources import mesh_file
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import contacts
from vrrt_jax.scene.world import build_world

FINGERS = {
    "panda": ("finger_joint1", "finger_joint2", "left_finger", "right_finger"),
    "fetch": (
        "robot0:r_gripper_finger_joint",
        "robot0:l_gripper_finger_joint",
        "robot0:r_gripper_finger_link",
        "robot0:l_gripper_finger_link",
    ),
}


@pytest.mark.parametrize("name", FINGERS)
@pytest.mark.parametrize("opening", [(0.0, 0.0), (0.02, 0.01), (0.04, 0.04)])
def test_the_opening_is_that_of_the_true_model(name, opening):
    """The model of the meshes, with its finger joints free, says where the fingers are."""
    path = mesh_file(name)
    if path is None:
        pytest.skip("the meshes are not on this machine")
    joints, bodies = FINGERS[name][:2], FINGERS[name][2:]
    robot = load_robot(name, freeze=dict(zip(joints, opening, strict=True)))
    usual = load_robot(name)
    true = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(true)
    for joint, position in zip(joints, opening, strict=True):
        data.joint(joint).qpos = position
    mujoco.mj_kinematics(true, data)
    width = np.linalg.norm(data.body(bodies[0]).xpos - data.body(bodies[1]).xpos)
    for geometry in ("spheres", "meshes"):
        scene = exact_scene(robot, [], geometry=geometry)
        scene.near(robot.home)
        found = scene.data.body(bodies[0]).xpos - scene.data.body(bodies[1]).xpos
        np.testing.assert_allclose(np.linalg.norm(found), width, atol=1e-6)
    # The planner's spheres move as well, and no other sphere does.
    moved = np.asarray(robot.collision_spheres.center - usual.collision_spheres.center)
    is_finger = np.isin(robot.collision_sphere_bodies, bodies)
    np.testing.assert_array_equal(moved[~is_finger], 0.0)
    closed = [0.04 - opening[bodies.index(b)] for b in robot.collision_sphere_bodies if b in bodies]
    np.testing.assert_allclose(np.linalg.norm(moved[is_finger], axis=1), closed, atol=1e-6)
    assert robot.joint_names == usual.joint_names
    assert {joint: robot.frozen[joint] for joint in joints} == dict(
        zip(joints, opening, strict=True)
    )


def test_a_thin_post_fits_between_open_fingers_only():
    """The exact check sees the opening."""
    if mesh_file("panda") is None:
        pytest.skip("the meshes are not on this machine")
    post = Obstacle(name="post", kind="cylinder", position=(0.554, 0, 0.3), size=(0.02, 0.24, 0))
    q = np.array([0.0, 0.0, 0.0, -1.57079, 0.0, 1.57079, -0.7853])
    found = [
        contacts(load_robot("panda", freeze=freeze), [post], q, geometry="meshes")
        for freeze in (None, {"finger_joint1": 0.01, "finger_joint2": 0.01})
    ]
    assert found[0] == []
    assert {"left_finger touches post", "right_finger touches post"} <= {*found[1]}


def test_a_world_of_another_opening_is_refused():
    robot = load_robot("panda", freeze={"finger_joint1": 0.01})
    world = build_world(load_robot("panda"), engine="closed_form")
    with pytest.raises(ValueError, match="fixed at {'finger_joint1': 0.04, .*: 0.01, .*build the"):
        check_start(robot, world, robot.home)


def test_openings_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match=r"'finger_joint1' got 0.065; .* its range, \[0, 0.04\]"):
        load_robot("panda", freeze={"finger_joint1": 0.065})
    with pytest.raises(ValueError, match="'finger' not in robot; have: joint1, .*finger_joint2"):
        load_robot("panda", freeze={"finger": 0.02})
