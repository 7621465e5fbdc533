"""The independent check of a path: C MuJoCo, the true meshes, steps as fine as distances ask.

Nothing here shares code with MJX or with the distances that the planner computes, so that an error
there cannot hide itself.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from vrrt_jax.core.edges import unwrapped
from vrrt_jax.core.fields import check_loaded
from vrrt_jax.core.postprocess import CheckedPath
from vrrt_jax.core.result import Verification
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.advance import first_touch
from vrrt_jax.scene.exact import ExactScene, exact_scene
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.world import World

_LIMIT_TOLERANCE = 1e-5  # [rad] or [m], paths come in float32
_HALF_TURN_TOLERANCE = 1e-4  # [rad]
_MOST_STEPS = 10_000_000  # of a path; a robot's own are far shorter


def verify_path(
    robot: Robot,
    obstacles: Sequence[Obstacle] | World,
    path: np.ndarray,
    *,
    step: float = 0.005,
    geometry: str = "auto",
    measure_clearance: bool = False,
) -> Verification:
    """Check a path for limits, collision and self-collision.

    The fixed base may touch anything. Every other link may touch its neighbors only. Pairs of links
    that never touch in thousands of random configurations, or nearly always, are not checked.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        obstacles: K primitives, or a world with its obstacles and what the robot holds there.
        path: (P, D) configurations joined by straight lines [rad] or [m]. Joints that wrap take the
            shorter direction. A turn by exactly pi follows the sign of the difference.
        step: largest distance between checked configurations that distances do not vouch for [rad]
            (Euclidean over joints). Whatever it is, two bodies approach each other between two
            checks by no more than their distance, or by 0.5 mm if they are nearer. So no contact
            deeper than 0.25 mm is missed, however long the arm, however thin the obstacle.
        geometry: "meshes" for the true collision geometry; "polytopes" for those that contain it,
            or spheres for a robot that has none; "spheres" for the robot's covering spheres;
            "auto" for meshes where this machine has them, else polytopes.
        measure_clearance: also measure the smallest distance to obstacles, which takes many times
            as long.

    Raises:
        ValueError: the path has the wrong shape, is not finite or too long, ``step`` is not
            positive, ``geometry`` is unknown or missing, or an obstacle is malformed.
    """
    path = _checked_path(robot, path)
    if not step > 0:
        raise ValueError(f"step is {step}; expected a positive number [rad], such as 0.005")
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    if length / step > _MOST_STEPS:
        raise ValueError(
            f"the path is {length:.3g} rad long, which is {length / step:.3g} steps of {step} rad; "
            f"expected at most {_MOST_STEPS}: check its units, or raise step"
        )
    exact = exact_scene(robot, obstacles, geometry=geometry)
    walk = interpolate(robot, path, step)
    # Contacts are asked for up to the first configuration outside the limits.
    outside = _outside_limits(robot, walk.q)
    first_outside = int(outside.any(1).argmax()) if outside.any() else len(walk.q)
    contact, checked = _first_contact(exact, path, walk, first_outside, step)
    clearance = float("nan")
    if measure_clearance and exact.obstacles and first_outside:
        clearance = _smallest_clearance(exact, walk.q[:first_outside])
    if contact is None and outside.any():
        joint = int(outside[first_outside].argmax())
        contact = (
            f"{robot.joint_names[joint]} = {walk.q[first_outside, joint]:.4f} is outside "
            f"[{robot.lower[joint]:.4f}, {robot.upper[joint]:.4f}] "
            f"at {100 * walk.fraction[first_outside]:.0f} % of the path"
        )
    return Verification(
        ok=contact is None,
        clearance=clearance,
        geometry=exact.geometry,
        checked=checked,
        contact=contact,
    )


def _first_contact(
    exact: ExactScene, path: np.ndarray, walk: "Walk", end: int, step: float
) -> tuple[str | None, int]:
    """What touches first before the configuration ``end`` of a walk, and how many were looked at.

    Those that the robot cannot have reached a contact at, for the distances before, are left out.
    """
    checked, near = 0, exact.near_in_a_row()
    for segment, q_from in enumerate(path):
        # Up to the next waypoint, or to where the walk ends in this segment.
        inside = (end - walk.first[segment]) / walk.steps[segment]
        if inside <= 0:
            break
        length = float(np.linalg.norm(walk.turn[segment]))
        at, looked = first_touch(
            near,
            exact.lever_arms,
            q_from,
            walk.turn[segment],
            step=step / max(length, 1e-12),
            end=min(inside, 1.0),
        )
        checked += looked
        if at is not None:
            pair = exact.touching(q_from + at * walk.turn[segment])[0]
            share = 100 * walk.fraction_at(segment, at)
            return f"{exact.describe(pair)} at {share:.0f} % of the path", checked
    return None, checked


def _smallest_clearance(exact: ExactScene, configurations: np.ndarray) -> float:
    clearance = np.inf
    for q in configurations:
        exact.near(q)
        clearance = exact.clearance(clearance)
    return float(clearance)


def check_path(robot: Robot, world: World, path: np.ndarray, *, step: float) -> CheckedPath:
    """The exact check of a path among a world's obstacles; see :func:`verify_path`.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        world: the obstacles, and what the robot holds.
        path: (P, D) waypoints; joints that wrap go on, so that waypoints can be interpolated.
        step: largest distance between checked configurations [rad].
    """
    path = unwrapped(world, path)
    return CheckedPath(
        path=path,
        trajectory=interpolate(robot, path, step).q.astype(np.float32),
        verification=verify_path(robot, world, path, step=step),
    )


def contacts(
    robot: Robot, obstacles: Sequence[Obstacle] | World, q: np.ndarray, *, geometry: str = "auto"
) -> list[str]:
    """What touches what at one configuration.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        obstacles: K primitives, or a world, as in :func:`verify_path`.
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
    check_loaded(robot, "the robot", "vrrt_jax.load_robot")
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Walk:
    """A path in small steps. Letters: ``n`` configurations, ``P`` waypoints."""

    q: np.ndarray  # (n, D), ends included
    fraction: np.ndarray  # (n,) of the path's length so far
    segment: np.ndarray  # (n,) int segment that begins or goes on there
    turn: np.ndarray  # (P, D) of each segment; zero after the last waypoint
    steps: np.ndarray  # (P,) int into which each segment is divided
    first: np.ndarray  # (P + 1,) int configuration at which each segment begins; then n

    def fraction_at(self, segment: int, part: float) -> float:
        """The fraction of the path's length at a part of a segment."""
        ends = self.fraction[self.first[segment : segment + 2].clip(max=len(self.q) - 1)]
        return float(ends[0] + part * (ends[1] - ends[0]))


def interpolate(robot: Robot, path: np.ndarray, step: float) -> Walk:
    """A path (P, D) in equal steps on each segment, none longer than ``step`` [rad]."""
    turns = np.diff(path, axis=0)
    # Turns by more than pi take the shorter direction. A turn by pi, up to rounding, does not.
    around = robot.is_continuous & (np.abs(turns) > np.pi + _HALF_TURN_TOLERANCE)
    turns = turns - 2 * np.pi * np.round(turns / (2 * np.pi)) * around
    lengths = np.linalg.norm(turns, axis=1)
    steps = np.maximum(np.ceil(lengths / step), 1).astype(int)
    # A segment's configurations are its beginning and the steps after it, but not its end.
    segment = np.repeat(np.arange(len(turns)), steps)
    first = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    part = (np.arange(len(segment)) - first[segment]) / steps[segment]
    q = path[segment] + part[:, None] * turns[segment]
    traveled = np.cumsum(lengths)[segment] - lengths[segment] * (1 - part)
    end = path[-1] if not len(turns) else path[-2] + turns[-1]
    return Walk(
        q=np.concatenate([q, end[None]]),
        fraction=np.append(traveled / max(lengths.sum(), 1e-12), 1.0 if len(turns) else 0.0),
        segment=np.append(segment, len(turns)),
        turn=np.concatenate([turns, np.zeros((1, path.shape[1]))]),
        steps=np.append(steps, 1),
        first=np.append(first, first[-1] + 1),
    )


def _outside_limits(robot: Robot, configurations: np.ndarray) -> np.ndarray:
    """Where (n, D) a joint that does not wrap leaves its limits."""
    outside = (configurations < robot.lower - _LIMIT_TOLERANCE) | (
        configurations > robot.upper + _LIMIT_TOLERANCE
    )
    return outside & ~robot.is_continuous
