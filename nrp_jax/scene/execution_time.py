"""How long the Fetch takes to execute a path, within its limits of velocity and acceleration."""

import dataclasses
import functools

import numpy as np

from nrp_jax.scene.grid_world import GridWorld
from nrp_jax.scene.odometry import odometry
from nrp_jax.scene.robots import load_robot as load_mobile_robot
from vrrt_jax.motion.blended import (
    corner_speeds,
    half_widths,
    limits_along,
    speed_profile,
    widest_blends,
)
from vrrt_jax.motion.limits import MotionLimits, motion_limits
from vrrt_jax.motion.trajectory import simplified
from vrrt_jax.robots.robot import load_robot

# Distance [m] and heading [rad] of the base: velocity and acceleration, of the Fetch's settings
# for move_base by its maker, in fetch_ros (fetch_navigation). No jerk is published.
BASE_LIMITS = ((1.0, 0.35), (1.5, 0.8))
RISE_S = 0.1  # in which the base's acceleration is reached, as the arm's
TOLERANCE = 0.01  # how far a rounded corner is from the path [m] and [rad], Euclidean


def execution_time(world: GridWorld, path: np.ndarray, tolerance: float = TOLERANCE) -> float:
    """Time from rest to rest along a path [s].

    The base's two wheels and each joint keep their limits. Corners are where a piece of a
    Reeds-Shepp curve ends, too: there the heading begins or ceases to turn. They are rounded, but
    for those sharper than a right angle. What is rounded is not checked for collisions.

    Args:
        world: the Fetch in a home.
        path: (P, D) waypoints of a plan.
        tolerance: how far a rounded corner may be from the path; with 0 the robot stops at every
            corner and never leaves the path.
    """
    return time_along(odometry(world, path), tolerance)


def time_along(corners: np.ndarray, tolerance: float = TOLERANCE) -> float:
    """Time from rest to rest along the corners (n, D - 1) of :func:`odometry` [s]."""
    corners = simplified(corners)
    if len(corners) == 1:
        return 0.0
    blends = widest_blends(corners, tolerance)
    # Where the base reverses or a joint turns back, a stop is quicker than what rounds it.
    directions = blends.directions
    turns_back = np.sum(directions[:-1] * directions[1:], axis=1) < 0
    widths = np.where(turns_back, 0.0, blends.half_width)
    phases = speed_profile(dataclasses.replace(blends, half_width=widths), _limits())
    return float(sum(duration for duration, _ in phases))


def rough_time(steps: np.ndarray) -> float:
    """About :func:`time_along` steps (n, D - 1) without those of no length [s], far sooner.

    Speeds change within the limits of acceleration; that jerk is limited only adds to the time that
    a change takes.
    """
    bounds = _limits()
    length = np.linalg.norm(steps, axis=1)
    direction = steps / length[:, None]
    turn = np.diff(direction, axis=0)
    turns_back = np.sum(direction[:-1] * direction[1:], axis=1) < 0
    width = np.where(turns_back, 0.0, half_widths(turn, length, TOLERANCE))
    most, faster, rise = limits_along(direction, bounds).T
    inner = np.minimum(corner_speeds(turn, width, bounds), np.minimum(most[:-1], most[1:]))
    speeds, widths = ([0.0, *numbers.tolist(), 0.0] for numbers in (inner, width))
    free = length - np.array(widths[:-1]) - widths[1:]
    # Each straight line has to have room for the change of speed along it.
    gains = (2 * faster * free).tolist()
    for k, gain in enumerate(gains):
        speeds[k + 1] = min(speeds[k + 1], (speeds[k] ** 2 + gain) ** 0.5)
    for k in range(len(gains) - 1, -1, -1):
        speeds[k] = min(speeds[k], (speeds[k + 1] ** 2 + gains[k]) ** 0.5)
    v = np.array(speeds)
    before, after = v[:-1], v[1:]
    peak = np.minimum(most, np.sqrt((before**2 + after**2) / 2 + faster * free))
    change = 2 * peak - before - after
    left = free - (2 * peak**2 - before**2 - after**2) / (2 * faster)
    seconds = change / faster + np.maximum(left, 0.0) / peak
    for part in (peak - before, peak - after):
        seconds += np.minimum(faster / rise, np.sqrt(np.maximum(part, 0.0) / rise))
    blended = width > 0
    return float(seconds.sum() + (2 * width[blended] / v[1:-1][blended]).sum())


@functools.cache
def _limits() -> MotionLimits:
    """Of the distance driven, the heading, and the Fetch's joints."""
    arm, published = load_robot("fetch"), {}
    limits = motion_limits(arm)
    for index, name in enumerate(arm.joint_names):
        short = name.removeprefix("robot0:").removesuffix("_joint")
        numbers = (limits.velocity, limits.acceleration, limits.jerk)
        published[short] = [values[index] for values in numbers]
    base = [(velocity, faster, faster / RISE_S) for velocity, faster in BASE_LIMITS]
    joints = load_mobile_robot("fetch").joint_names[3:]
    rows = np.array([*base, *(published[name] for name in joints)])
    return MotionLimits(velocity=rows[:, 0], acceleration=rows[:, 1], jerk=rows[:, 2])
