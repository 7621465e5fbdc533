"""Small problems of the Panda: a post between start and goal, a can somewhere."""

import mujoco
import numpy as np

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
AWAY = (-0.6, -0.6, 0.1)  # where nothing is in the way
START = np.array([0.0, 0.0, 0.0, -1.57079, 0.0, 1.57079, -0.7853])
GOAL = START + np.array([1.2, 0, 0, 0, 0, 0, 0])
POST = (0.46, 0.31, 0.3)  # between the two
BASE = (0.3, -0.2, 0.9, 1.57)


def place(robot, q, body):
    """Where a body of the robot is, (3,)."""
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return data.body(body).xpos.copy()


def fingertips(robot, q):
    """Between the fingers, which point down at ``START`` and ``GOAL``."""
    fingers = [place(robot, q, f"{side}_finger") for side in ("left", "right")]
    return np.mean(fingers, axis=0) - np.array([0.0, 0.0, 0.045])


def arrays_of(robot, boxes, cans, goals=None, starts=None, **changes):
    """A file of problems with one box and one cylinder each, at these places (3,)."""
    count = len(boxes)
    pose = np.tile([0.0, 0.0, 0.0, *UPRIGHT], (count, 1, 1))
    box_pose, can_pose = pose.copy(), pose.copy()
    box_pose[:, 0, :3], can_pose[:, 0, :3] = boxes, cans
    arrays = {
        "joints": np.array([f"panda_joint{k}" for k in range(1, 8)]),
        "start": np.tile(START, (count, 1)) if starts is None else np.array(starts),
        "goal": np.tile(GOAL, (count, 1)) if goals is None else np.array(goals),
        "joint_lower": robot.lower,
        "joint_upper": robot.upper,
        "fixed_joints": np.array(["panda_finger_joint1", "panda_finger_joint2"]),
        "fixed_values": np.full((count, 2), 0.04),
        "box_pose": box_pose,
        "box_half": np.tile([0.03, 0.03, 0.3], (count, 1, 1)),
        "cyl_pose": can_pose,
        "cyl_radius": np.full((count, 1), 0.03),
        "cyl_half": np.full((count, 1), 0.05),
        "sphere_pos": np.zeros((count, 0, 3)),
        "sphere_radius": np.zeros((count, 0)),
        "vamp_valid": np.ones(count, bool),
    }
    return arrays | changes
