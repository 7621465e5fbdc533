"""Joints that are not planned: where they are fixed, and how a model is fixed there."""

import warnings
from collections.abc import Mapping

import mujoco
import numpy as np

from vrrt_jax.robots.couplings import follow

_ROUNDING = 1e-4  # [rad] or [m] that files with few decimals may be beyond a limit


def home_positions(model: mujoco.MjModel) -> dict[str, float]:
    """Joint positions [rad] or [m] of the keyframe 'home', else of the first, else of the zero.

    All are put inside the limits; where a keyframe is outside of them, a warning says so.
    """
    names = [model.key(k).name for k in range(model.nkey)]
    qpos = model.qpos0
    if names:
        qpos = model.key_qpos[names.index("home") if "home" in names else 0]
    home, moved = {}, []
    for j in range(model.njnt):
        name, stated = model.joint(j).name, qpos[model.jnt_qposadr[j]]
        position = np.clip(stated, *model.jnt_range[j]) if model.jnt_limited[j] else stated
        if names and abs(position - stated) > _ROUNDING:
            moved.append(f"{name} is at {stated:g}, and its range ends at {position:g}")
        home[name] = float(position)
    if moved:
        warnings.warn(
            f"the keyframe for home is outside of the limits: {'; '.join(moved)}; it is moved "
            "there: correct the keyframe",
            stacklevel=3,
        )
    return home


def frozen_positions(
    model: mujoco.MjModel, home: Mapping[str, float], freeze: Mapping[str, float] | None
) -> dict[str, float]:
    """Which joints to fix, and where.

    Args:
        model: with all joints and equalities of the file.
        home: position of each joint where the caller says nothing.
        freeze: the caller's choice.

    Returns:
        Positions [rad] or [m] by joint: those of ``freeze``, and joints that an equality couples,
        see :func:`vrrt_jax.robots.couplings.follow`.

    Raises:
        ValueError: a joint of ``freeze`` does not exist, or its value is no finite number or
            outside of its range, or coupled joints cannot be where it puts one.
    """
    names = [model.joint(j).name for j in range(model.njnt)]
    frozen = dict(freeze or {})
    for name, value in (freeze or {}).items():
        if name not in names:
            raise ValueError(f"freeze: joint '{name}' not in robot; have: {', '.join(names)}")
        try:
            frozen[name] = float(value)
        except (TypeError, ValueError, OverflowError):
            frozen[name] = np.nan
        if not np.isfinite(frozen[name]):
            raise ValueError(
                f"freeze: joint '{name}' got {value!r}; expected a finite position [rad] or [m]"
            )
        joint = model.joint(name)
        low, high = joint.range
        if model.jnt_limited[joint.id] and not low <= frozen[name] <= high:
            raise ValueError(
                f"freeze: joint '{name}' got {frozen[name]:g}; expected a position in its range, "
                f"[{low:g}, {high:g}]"
            )
    coupled = follow(model, home, frozen)
    if coupled:
        warnings.warn(
            "joints coupled by an equality cannot be planned one by one and are fixed: "
            + ", ".join(f"{name} = {value:g}" for name, value in coupled.items())
            + "; pass freeze={joint: position} to choose other positions",
            stacklevel=3,
        )
    return frozen | coupled


def freeze_joints(spec: mujoco.MjSpec, positions: Mapping[str, float]) -> None:
    """Delete equalities, keyframes and the given joints in place; their bodies move accordingly."""
    for name in ("equalities", "keys"):  # they refer to joints
        for element in list(getattr(spec, name)):
            spec.delete(element)
    for joint in [joint for joint in spec.joints if joint.name in positions]:
        position, body = positions[joint.name], joint.parent
        if body.joints[0].name != joint.name:
            raise ValueError(
                f"cannot fix joint '{joint.name}': joint '{body.joints[0].name}' of the same body "
                "comes before it and moves; give each joint a body of its own, or fix both"
            )
        if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
            offset = (position - joint.ref) * joint.axis / np.linalg.norm(joint.axis)
            rotation = np.array([1.0, 0.0, 0.0, 0.0])
        else:
            degree = np.pi / 180 if spec.compiler.degree else 1.0
            rotation = np.zeros(4)
            axis = joint.axis / np.linalg.norm(joint.axis)
            mujoco.mju_axisAngle2Quat(rotation, axis, position - joint.ref * degree)
            turned = np.zeros(3)
            mujoco.mju_rotVecQuat(turned, joint.pos, rotation)
            offset = joint.pos - turned
        _move_body(spec, body, offset, rotation)
        spec.delete(joint)


def _move_body(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, offset: np.ndarray, rotation: np.ndarray
) -> None:
    """Append a motion, given in the body's own frame, to the body's pose."""
    quaternion = np.array(body.quat)
    if body.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        compiler = spec.compiler
        quaternion = np.array(
            spec.resolve_orientation(compiler.degree, compiler.eulerseq, body.alt)
        )
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    shift, product = np.zeros(3), np.zeros(4)
    mujoco.mju_rotVecQuat(shift, offset, quaternion)
    mujoco.mju_mulQuat(product, quaternion, rotation)
    body.pos = body.pos + shift
    body.quat = product
