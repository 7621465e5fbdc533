"""How fast joints may move: velocity, acceleration and jerk."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vrrt_jax.robots.robot import Robot
from vrrt_jax.robots.urdf import urdf_root

_UNITS = {"velocity": "[rad/s] or [m/s]", "acceleration": "[rad/s^2]", "jerk": "[rad/s^3]"}
_RISE_S = 0.1  # in which the acceleration is reached, where nobody publishes a jerk

# Joint: velocity, acceleration and jerk.
# Panda: "Robot and interface specifications", Franka Emika, frankaemika.github.io/docs.
_PANDA = {
    "joint1": (2.175, 15.0, 7500.0),
    "joint2": (2.175, 7.5, 3750.0),
    "joint3": (2.175, 10.0, 5000.0),
    "joint4": (2.175, 12.5, 6250.0),
    "joint5": (2.61, 15.0, 7500.0),
    "joint6": (2.61, 20.0, 10000.0),
    "joint7": (2.61, 20.0, 10000.0),
}
# UR5e: 180 degrees/s, from its data sheet. Its maker publishes no acceleration for the robot, and
# 5 rad/s^2 in the MoveIt settings of Universal_Robots_ROS2_Driver; no jerk.
_UR5E = {
    name: (np.pi, 5.0, 5.0 / _RISE_S)
    for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
}
# Fetch: the MoveIt settings of its maker, in fetch_ros (fetch_moveit_config); no jerk.
_FETCH = {
    f"robot0:{name}_joint": (velocity, acceleration, acceleration / _RISE_S)
    for name, velocity, acceleration in (
        ("torso_lift", 0.1, 0.5),
        ("shoulder_pan", 1.256, 1.5),
        ("shoulder_lift", 1.0, 1.0),
        ("upperarm_roll", 1.57, 1.5),
        ("elbow_flex", 1.5, 1.5),
        ("forearm_roll", 1.57, 1.5),
        ("wrist_flex", 2.26, 2.5),
        ("wrist_roll", 2.26, 2.5),
    )
}
_PACKAGED = {"panda": _PANDA, "ur5e": _UR5E, "fetch": _FETCH}


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Largest velocity, acceleration and jerk of joints, the same in both directions.

    Each is a number for all joints or one number a joint; None for what the robot says.
    """

    velocity: Any = None  # () or (D,) [rad/s] or [m/s]
    acceleration: Any = None  # () or (D,) [rad/s^2] or [m/s^2]
    jerk: Any = None  # () or (D,) [rad/s^3] or [m/s^3]

    @classmethod
    def from_dict(cls, fields: Any) -> "MotionLimits":
        """Limits by name, such as ``{"acceleration": 2.0, "jerk": 20.0}``.

        Raises:
            ValueError: these are no such fields.
        """
        if not isinstance(fields, Mapping) or not set(fields) <= set(_UNITS):
            raise ValueError(f"the limits are {fields!r}; expected some of {', '.join(_UNITS)}")
        return cls(**fields)


def motion_limits(robot: Robot, given: MotionLimits | None = None) -> MotionLimits:
    """The limits of all joints: what is given, else what the robot says.

    Packaged robots have the published limits of their makers. A URDF says the ``velocity`` of a
    joint in its ``<limit>``, and some say its ``acceleration`` and ``jerk``; MJCF has no such
    limits.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        given: what takes the place of the robot's own.

    Returns:
        Limits with an array (D,) each.

    Raises:
        ValueError: a limit is missing or is no positive number; the message names the joints.
    """
    given = given or MotionLimits()
    own = _own_limits(robot)
    found = {}
    for index, (kind, unit) in enumerate(_UNITS.items()):
        value = getattr(given, kind)
        if value is None:
            value = [own.get(name, (np.nan,) * 3)[index] for name in robot.joint_names]
            missing = [n for n, v in zip(robot.joint_names, value, strict=True) if not v > 0]
            if missing:
                raise ValueError(
                    f"robot '{robot.name}' has no {kind} limit for {', '.join(missing)}; expected "
                    f"limits=MotionLimits({kind}=...), a number for all joints or one for each, "
                    f"{unit}"
                )
        found[kind] = _checked(robot, kind, value)
    return MotionLimits(**found)


def _checked(robot: Robot, kind: str, value: Any) -> np.ndarray:
    try:
        limits = np.broadcast_to(np.asarray(value, float), robot.num_joints).copy()
    except (TypeError, ValueError, OverflowError):
        limits = np.array([np.nan])
    if not (np.isfinite(limits).all() and (limits > 0).all()):
        raise ValueError(
            f"the {kind} limit is {value!r}; expected a positive number {_UNITS[kind]}, or one "
            f"for each of: {', '.join(robot.joint_names)}"
        )
    return limits


def _own_limits(robot: Robot) -> Mapping[str, tuple[float, ...]]:
    """What the maker or the robot's URDF says, by joint; NaN for what it does not say."""
    source = str(robot.mesh_source)
    if source in _PACKAGED:
        return _PACKAGED[source]
    root = urdf_root(Path(source)) if Path(source).is_file() else None
    if root is None:
        return {}
    return {
        joint.get("name", ""): tuple(_number(limit.get(kind)) for kind in _UNITS)
        for joint in root.findall("joint")
        for limit in joint.findall("limit")
    }


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return np.nan
