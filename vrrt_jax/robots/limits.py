"""Limits of joints: which are planned, and which are refused because a file is not clear."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from vrrt_jax.robots.urdf import bad_urdf_joints, urdf_root
from vrrt_jax.robots.xml_file import xml_root

_LARGEST = 1e3  # [rad] or [m] a larger limit stands for none, and angles would lose their digits
_MANY_TURNS = 8 * np.pi  # [rad] a larger limit of a hinge may be meant in degrees
_UNPLANNED = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
}


def bad_ranges(spec: mujoco.MjSpec, path: Path) -> dict[str, str]:
    """What is wrong with the limits of joints, which MuJoCo would take for none.

    Only a joint that says nothing of limits turns for ever: a hinge of MJCF without a range, and a
    ``continuous`` joint of a URDF.

    Args:
        spec: as read from the file.
        path: of the file.

    Returns:
        By the name of the joint, words that follow it.
    """
    root = urdf_root(path)
    if root is not None:
        return bad_urdf_joints(root)
    found = {}
    for joint in spec.joints:
        low, high = (float(limit) for limit in joint.range)
        if joint.limited == mujoco.mjtLimited.mjLIMITED_FALSE:
            if low != high:
                warnings.warn(
                    f"joint '{joint.name}' has the range [{low:g}, {high:g}], but "
                    'limited="false": it is planned without limits',
                    stacklevel=4,
                )
        elif (low, high) != (0.0, 0.0) and not low < high:
            found[joint.name] = _words(low, high)
    return found | {name: _words(0.0, 0.0) for name in _zero_ranges(path)}


def _words(low: float, high: float) -> str:
    return (
        f'has range="{low:g} {high:g}"; expected a lower limit that is less than the upper one: '
        "correct it, or leave the range out where a hinge turns for ever"
    )


def _zero_ranges(path: Path) -> list[str]:
    """Names of the joints of an MJCF file, and of those it includes, whose range is 0 0."""
    root = xml_root(path) if path.is_file() else None
    if root is None:
        return []
    found = []
    for joint in root.iter("joint"):
        limits = joint.get("range", "").split()
        try:
            is_zero = len(limits) == 2 and not any(map(float, limits))
        except ValueError:
            is_zero = False
        if is_zero and joint.get("limited") != "false":
            found.append(joint.get("name", ""))
    for include in root.iter("include"):
        found += _zero_ranges(path.parent / include.get("file", ""))
    return found


def check_joints(model: mujoco.MjModel, bad_ranges: Mapping[str, str]) -> None:
    """Refuse joints that cannot be planned.

    Args:
        model: with planned joints only.
        bad_ranges: what is wrong with limits in the file, see :func:`bad_ranges`.

    Raises:
        ValueError: a joint is free or ball, its limits are missing, empty, reversed or no finite
            numbers, or there is no joint at all.
    """
    if model.njnt == 0:
        raise ValueError(
            "the robot has no joint: nothing to plan; expected at least one hinge or slide joint"
        )
    for joint in range(model.njnt):
        name, kind = model.joint(joint).name, int(model.jnt_type[joint])
        if kind in _UNPLANNED:
            body = model.body(model.jnt_bodyid[joint]).name
            raise ValueError(
                f"joint '{name}' of body '{body}' is a {_UNPLANNED[kind]} joint; expected hinge "
                "and slide joints on a fixed base: delete it, or replace it by hinges and slides"
            )
        if name in bad_ranges:
            raise ValueError(
                f"joint '{name}' {bad_ranges[name]}, or fix the joint with freeze={{'{name}': 0.0}}"
            )
        if kind == mujoco.mjtJoint.mjJNT_SLIDE and not model.jnt_limited[joint]:
            raise ValueError(
                f"slide joint '{name}' has no range; expected range=\"lower upper\" [m]: add it, "
                f"or fix the joint with freeze={{'{name}': 0.0}}"
            )
        low, high = model.jnt_range[joint]
        if model.jnt_limited[joint] and not max(-low, high) <= _LARGEST:
            raise ValueError(
                f"joint '{name}' has the range [{low:g}, {high:g}]; expected numbers within "
                f"+-{_LARGEST:g} [rad] or [m]: correct it, leave it out where a hinge turns for "
                f'ever (in a URDF, type="continuous"), or fix the joint with '
                f"freeze={{'{name}': 0.0}}"
            )
        is_hinge = kind == mujoco.mjtJoint.mjJNT_HINGE
        if is_hinge and model.jnt_limited[joint] and max(-low, high) > _MANY_TURNS:
            warnings.warn(
                f"joint '{name}' has the range [{low:g}, {high:g}] rad, of many turns: it is "
                "planned so; if it is meant in degrees, write it in radians",
                stacklevel=4,
            )


def joint_ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits (D,) [rad] or [m]; -pi and pi for an unlimited hinge."""
    limited = model.jnt_limited.astype(bool)
    lower = np.where(limited, model.jnt_range[:, 0], -np.pi)
    return lower, np.where(limited, model.jnt_range[:, 1], np.pi)
