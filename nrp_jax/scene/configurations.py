"""Checks of the starts and goals that users give, with errors that say what to do."""

from typing import Any

import numpy as np

from nrp_jax.scene.nearest import advice, refusal, shifted, working_world
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, batch_is_free

MOST_TURNS = 100  # beyond so many turns float32 is too coarse for angles


def check_shape(robot: MobileRobot, q: Any, what: str) -> np.ndarray:
    """Numbers as float64 (D,), which places far from a map's origin need.

    Raises:
        ValueError: they are none, or not one for each joint.
    """
    try:
        q = np.asarray(q, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"the {what} is {q!r}; expected numbers, one for each joint") from None
    if q.shape != (robot.num_joints,):
        names = ", ".join(robot.joint_names)
        raise ValueError(f"the {what} has shape {q.shape}; expected ({robot.num_joints},): {names}")
    return q


def check_configuration(
    robot: MobileRobot, world: GridWorld, q: np.ndarray, what: str
) -> np.ndarray:
    """A configuration (D,) that is inside the limits and free, in float64.

    Raises:
        ValueError: wrong shape, not finite, outside the limits or not free; the message names the
            nearest free configuration.
    """
    q = check_shape(robot, q, what)
    if world.lower.shape != (robot.num_joints,):
        raise ValueError(
            f"the world is of a robot with {len(world.lower)} joints, and '{robot.name}' has "
            f"{robot.num_joints}: build the world for it"
        )
    # Places are compared in float64, wherever the map lies.
    inner, corner = working_world(world)
    lower, upper = (shifted(np.asarray(a), corner) for a in (inner.lower, inner.upper))
    is_continuous = np.asarray(inner.is_continuous)
    outside = (q < lower - 1e-4) | (q > upper + 1e-4)
    bad = ~np.isfinite(q) | (outside & ~is_continuous)
    if bad.any():
        joint = int(np.flatnonzero(bad)[0])
        place = "the map spans" if joint < 2 else "its limits are"
        instead = f"; {advice(robot, world, q)}" if np.isfinite(q).all() and joint > 1 else ""
        raise ValueError(
            f"the {what}'s {robot.joint_names[joint]} is {q[joint]}; {place} "
            f"[{lower[joint]:.3f}, {upper[joint]:.3f}]{instead}"
        )
    if turned := [*np.flatnonzero(is_continuous & (np.abs(q) > 2 * np.pi * MOST_TURNS))]:
        raise ValueError(
            f"the {what}'s {robot.joint_names[turned[0]]} is {q[turned[0]]:.4g} rad, more than "
            f"{MOST_TURNS} turns from zero; expected less: take whole turns of 2 pi off"
        )
    # Only what rounding has put beyond a limit is put onto it: joints stay in their turn.
    inside = np.where(is_continuous, q, np.clip(q, lower, upper))
    if not batch_is_free(inner, shifted(inside, -corner).astype(np.float32)[None])[0]:
        raise ValueError(refusal(robot, world, q, what))
    return inside
