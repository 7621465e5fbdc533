"""Bodies of a robot by their names: on which link they are, and where they are in the world."""

import functools

import mujoco
import numpy as np

from vrrt_jax.robots.kinematics import chain_from_model
from vrrt_jax.robots.robot import Robot


def moving_body(robot: Robot, name: str) -> tuple[int, np.ndarray]:
    """The link that carries a body, and the body's pose (4, 4) in that link's frame.

    Raises:
        ValueError: the robot has no such body, or it does not move.
    """
    bodies = _bodies(robot)
    moving = [body for body, (link, _) in bodies.items() if link]
    if name not in moving:
        what = "does not move" if name in bodies else "is no link of the robot"
        raise ValueError(f"'{name}' {what}; have: {', '.join(moving)}")
    return bodies[name]


def body_pose(robot: Robot, name: str, q: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a body in the world at ``q`` (D,)."""
    data = _placed(robot, q)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.body(name).xmat.reshape(3, 3), data.body(name).xpos
    return pose


def body_places(robot: Robot, q: np.ndarray) -> dict[str, np.ndarray]:
    """Origins (3,) in the world of all bodies by name, at a configuration (D,) [m]."""
    model, data = _model(robot), _placed(robot, q)
    return {model.body(index).name: data.xpos[index].copy() for index in range(1, model.nbody)}


def _placed(robot: Robot, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(_model(robot))
    data.qpos[:] = q
    mujoco.mj_kinematics(_model(robot), data)
    return data


@functools.lru_cache(maxsize=8)
def _model(robot: Robot) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(robot.xml)


@functools.lru_cache(maxsize=8)
def _bodies(robot: Robot) -> dict[str, tuple[int, np.ndarray]]:
    """The link of each body, and the body's pose (4, 4) in it, by name."""
    model = _model(robot)
    _, link, pose = chain_from_model(model)
    return {model.body(k).name: (int(link[k]), pose[k]) for k in range(1, model.nbody)}
