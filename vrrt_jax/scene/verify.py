"""The independent check of a path: C MuJoCo, the true meshes, fine steps.

Nothing here shares code with MJX or with the distances that the planner computes, so that an error
there cannot hide itself.
"""

from collections.abc import Sequence

import numpy as np

from vrrt_jax.core.edges import unwrapped
from vrrt_jax.core.postprocess import CheckedPath
from vrrt_jax.core.result import Verification
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.world import World, obstacle_list

_LIMIT_TOLERANCE = 1e-5  # [rad] or [m], paths come in float32
_HALF_TURN_TOLERANCE = 1e-4  # [rad]


def verify_path(
    robot: Robot,
    obstacles: Sequence[Obstacle],
    path: np.ndarray,
    *,
    step: float = 0.005,
    geometry: str = "auto",
) -> Verification:
    """Check a path for limits, collision and self-collision.

    The fixed base may touch anything. Every other link may touch its neighbors only. Pairs of links
    that never touch in thousands of random configurations, or nearly always, are not checked.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        obstacles: K primitives.
        path: (P, D) configurations joined by straight lines [rad] or [m]. Joints that wrap take the
            shorter direction. A turn by exactly pi follows the sign of the difference.
        step: largest distance between checked configurations [rad] (Euclidean over joints).
        geometry: "meshes" for the true collision geometry, "spheres" for the robot's covering
            spheres, "auto" for meshes where this machine has them.

    Raises:
        ValueError: the path has the wrong shape or is not finite, ``step`` is not positive,
            ``geometry`` is unknown or missing, or an obstacle is malformed.
    """
    path = _checked_path(robot, path)
    if not step > 0:
        raise ValueError(f"step is {step}; expected a positive number [rad], such as 0.005")
    exact = exact_scene(robot, obstacles, geometry=geometry)
    configurations, fractions = interpolate(robot, path, step)
    # Contacts are asked for up to the first configuration outside the limits.
    outside = _outside_limits(robot, configurations)
    first_outside = int(outside.any(1).argmax()) if outside.any() else len(configurations)
    clearance, contact, checked = np.inf, None, 0
    for q, fraction in zip(configurations[:first_outside], fractions, strict=False):
        checked += 1
        if pairs := exact.touching(q):
            contact = f"{exact.describe(pairs[0])} at {100 * fraction:.0f} % of the path"
        clearance = exact.clearance(clearance)
        if contact:
            break
    if contact is None and outside.any():
        joint = int(outside[first_outside].argmax())
        contact = (
            f"{robot.joint_names[joint]} = {configurations[first_outside, joint]:.4f} is outside "
            f"[{robot.lower[joint]:.4f}, {robot.upper[joint]:.4f}] "
            f"at {100 * fractions[first_outside]:.0f} % of the path"
        )
    return Verification(
        ok=contact is None,
        clearance=float(clearance) if obstacles and checked else float("nan"),
        geometry=exact.geometry,
        checked=checked,
        contact=contact,
    )


def check_path(robot: Robot, world: World, path: np.ndarray, *, step: float) -> CheckedPath:
    """The exact check of a path among a world's obstacles; see :func:`verify_path`.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        world: the obstacles.
        path: (P, D) waypoints; joints that wrap go on, so that waypoints can be interpolated.
        step: largest distance between checked configurations [rad].
    """
    path = unwrapped(world, path)
    return CheckedPath(
        path=path,
        trajectory=interpolate(robot, path, step)[0].astype(np.float32),
        verification=verify_path(robot, obstacle_list(world), path, step=step),
    )


def contacts(
    robot: Robot, obstacles: Sequence[Obstacle], q: np.ndarray, *, geometry: str = "auto"
) -> list[str]:
    """What touches what at one configuration.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        obstacles: K primitives.
        q: (D,) joint positions [rad] or [m].
        geometry: as in :func:`verify_path`.

    Returns:
        Sentences such as "link4 touches shelf"; empty if the configuration is free.

    Raises:
        ValueError: as :func:`verify_path`.
    """
    q = _checked_path(robot, np.asarray(q)[None])[0]
    exact = exact_scene(robot, obstacles, geometry=geometry)
    return [exact.describe(pair) for pair in exact.touching(q)]


def _checked_path(robot: Robot, path: np.ndarray) -> np.ndarray:
    path = np.asarray(path, np.float64)
    if path.ndim != 2 or path.shape[1] != robot.num_joints or len(path) == 0:
        raise ValueError(
            f"the path has shape {path.shape}; expected (waypoints, {robot.num_joints}), one "
            f"column for each of: {', '.join(robot.joint_names)}"
        )
    if not np.isfinite(path).all():
        row = int(np.flatnonzero(~np.isfinite(path).all(1))[0])
        raise ValueError(f"waypoint {row} of the path is not finite: {path[row]}")
    return path


def interpolate(robot: Robot, path: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Configurations (n, D) along the path, ends included, and their share (n,) of its length."""
    turns = np.diff(path, axis=0)
    # Turns by more than pi take the shorter direction. A turn by pi, up to rounding, does not.
    around = robot.is_continuous & (np.abs(turns) > np.pi + _HALF_TURN_TOLERANCE)
    turns -= 2 * np.pi * np.round(turns / (2 * np.pi)) * around
    # Each segment is divided into equal steps; the first configuration is the path's first.
    lengths = np.linalg.norm(turns, axis=1)
    rows, traveled = [path[:1]], [np.zeros(1)]
    for start, turn, before, length in zip(
        path, turns, np.cumsum(lengths) - lengths, lengths, strict=False
    ):
        count = max(int(np.ceil(length / step)), 1)
        part = np.arange(1, count + 1) / count
        rows.append(start + part[:, None] * turn)
        traveled.append(before + part * length)
    total = max(lengths.sum(), 1e-12)
    return np.concatenate(rows), np.concatenate(traveled) / total


def _outside_limits(robot: Robot, configurations: np.ndarray) -> np.ndarray:
    """Where (n, D) a joint that does not wrap leaves its limits."""
    outside = (configurations < robot.lower - _LIMIT_TOLERANCE) | (
        configurations > robot.upper + _LIMIT_TOLERANCE
    )
    return outside & ~robot.is_continuous
