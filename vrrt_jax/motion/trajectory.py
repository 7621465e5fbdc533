"""From a path to a trajectory: when the robot is where, within its limits of motion."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from vrrt_jax.core.result import PlanResult, Verification
from vrrt_jax.motion.blended import BlendedPath, speed_profile, widest_blends
from vrrt_jax.motion.limits import MotionLimits, motion_limits
from vrrt_jax.motion.profile import positions_at
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import interpolate, verify_path
from vrrt_jax.scene.world import World

_STEP = 0.005  # between configurations checked, see ``verify_path`` [rad]
_STRAIGHT = 1e-5  # waypoints this near to the line between others are left out [rad]
_CHORDS = 32  # a blend is checked as so many straight lines, within 0.2 % of its depth
_HALVINGS = 5  # of a blend that touches something, before the motion stops at its corner

_Obstacles = Sequence[Obstacle] | World


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Where joints are at which time, from rest to rest. Letters: ``T`` times, ``D`` joints."""

    joint_names: tuple[str, ...]  # (D,)
    time: np.ndarray  # (T,) from 0, in equal steps [s]
    positions: np.ndarray  # (T, D) [rad] or [m]
    velocities: np.ndarray  # (T, D) [rad/s] or [m/s]
    accelerations: np.ndarray  # (T, D) [rad/s^2] or [m/s^2]
    stops: int  # corners of the path at which the robot stops
    deviation: float  # from the path, at most [rad], Euclidean over joints
    verification: Verification  # of the motion, blends included

    @property
    def duration(self) -> float:
        """Time from the start to the goal [s]."""
        return float(self.time[-1])


def time_parameterize(
    robot: Robot,
    path: np.ndarray | PlanResult,
    world: Sequence[Obstacle] | World | None = None,
    *,
    limits: MotionLimits | None = None,
    tolerance: float = 0.01,
    speed: float = 1.0,
    period: float = 0.01,
) -> Trajectory:
    """Give a path its times: as fast as velocity, acceleration and jerk limits allow.

    The robot moves on the straight lines of the path, and rounds its corners in a world. Each
    blend is checked with C MuJoCo there; one that touches something is halved, up to five times,
    and then the robot stops at the corner. Without a world it stops at every corner, so that it
    never leaves the path. The time along each straight line is optimal for its speeds at both
    ends; a blend has one speed.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        path: a solved plan, or (P, D) waypoints as for :func:`vrrt_jax.verify_path`.
        world: the obstacles, and what the robot holds; or K primitives.
        limits: see :class:`MotionLimits`; the robot's own where they are None.
        tolerance: how far a blend may be from its corner [rad], Euclidean over joints; 0 to stop at
            all corners.
        speed: share of the velocity limits, more than 0 and at most 1; the motion is as much
            slower, accelerations and jerks as its square and its cube.
        period: time between two points, at most [s].

    Raises:
        ValueError: the plan is not solved, a limit is missing, the path leaves the limits of joints
            or touches something, or a number is out of range.
    """
    _check_numbers(tolerance, speed, period)
    if isinstance(path, PlanResult):
        if not path.ok:
            raise ValueError(
                f"the plan ended as {path.status.name}; expected a solved plan: {path.advice}, or "
                "pass result.path to have that timed nevertheless"
            )
        path = path.path
    bounds = motion_limits(robot, limits)
    obstacles = [] if world is None else world
    waypoints = simplified(_going_on(robot, _verified(robot, obstacles, path)))
    if len(waypoints) == 1:
        return _standing(robot, waypoints, verify_path(robot, obstacles, waypoints))
    blends = widest_blends(waypoints, 0.0 if world is None else tolerance)
    blends = _free_blends(robot, obstacles, blends)
    phases = speed_profile(blends, bounds)
    # The same motion, slower: duration [s] and jerk of each phase.
    phases = [(duration / speed, jerk * speed**3) for duration, jerk in phases]
    duration = sum(duration for duration, _ in phases)
    time = np.linspace(0.0, duration, int(np.ceil(duration / period)) + 1)
    s, rate, rate_change, _ = positions_at(phases, time)
    q, tangent, curvature, _ = blends.derivatives(s)
    return Trajectory(
        joint_names=robot.joint_names,
        time=time,
        positions=q,
        velocities=tangent * rate[:, None],
        accelerations=curvature * rate[:, None] ** 2 + tangent * rate_change[:, None],
        stops=int((blends.half_width == 0).sum()),
        deviation=float(blends.deviations.max(initial=0.0)),
        verification=verify_path(robot, obstacles, _chords(blends), step=_STEP),
    )


def simplified(path: np.ndarray) -> np.ndarray:
    """A path (P, D) without the waypoints that lie on the straight line between others."""
    first, last = path[0], path[-1]
    line = last - first
    part = np.clip((path - first) @ line / max(line @ line, 1e-24), 0.0, 1.0)
    away = np.linalg.norm(path - first - part[:, None] * line, axis=1)
    farthest = int(away.argmax())
    if away[farthest] > _STRAIGHT:
        halves = simplified(path[: farthest + 1]), simplified(path[farthest:])
        return np.concatenate([halves[0], halves[1][1:]])
    return path[:1] if np.linalg.norm(line) <= _STRAIGHT else np.stack([first, last])


def _going_on(robot: Robot, path: np.ndarray) -> np.ndarray:
    """The path (P, D) with joints that wrap going on, so that it can be interpolated."""
    turns = interpolate(robot, path, np.inf).turn[:-1]
    return np.concatenate([path[:1], path[0] + np.cumsum(turns, axis=0)])


def _verified(robot: Robot, obstacles: _Obstacles, path: np.ndarray) -> np.ndarray:
    """The path itself, as float64.

    Raises:
        ValueError: it has the wrong shape, leaves the limits or touches something.
    """
    check = verify_path(robot, obstacles, path, step=_STEP)
    if not check.ok:
        raise ValueError(
            f"the path is not free: {check.contact}; expected a path that passes verify_path: plan "
            "it again in this world"
        )
    return np.asarray(path, np.float64)


def _free_blends(robot: Robot, obstacles: _Obstacles, blends: BlendedPath) -> BlendedPath:
    """The same, with blends that touch something halved until they do not, or left out."""
    widths = blends.half_width.copy()
    for corner in range(len(widths)):
        for halving in range(_HALVINGS + 1):
            trial = dataclasses.replace(blends, half_width=widths)
            if verify_path(robot, obstacles, _blend(trial, corner), step=_STEP).ok:
                break
            widths[corner] = widths[corner] / 2 if halving < _HALVINGS else 0.0
    return dataclasses.replace(blends, half_width=widths)


def _blend(blends: BlendedPath, corner: int) -> np.ndarray:
    """Configurations (n, D) on one blend, ends included; the corner alone if it has none."""
    width = blends.half_width[corner]
    if width == 0:
        return blends.waypoints[corner + 1][None]
    # Not beyond its ends, where rounding might ask for the next segment.
    inside = np.linspace(-width, width, _CHORDS + 1)
    return blends.derivatives(blends.corners[corner] + inside)[0]


def _chords(blends: BlendedPath) -> np.ndarray:
    """The whole path (n, D), with each blend as short straight lines."""
    inner = [_blend(blends, corner) for corner in range(len(blends.half_width))]
    return np.concatenate([blends.waypoints[:1], *inner, blends.waypoints[-1:]])


def _standing(robot: Robot, waypoint: np.ndarray, verification: Verification) -> Trajectory:
    """A trajectory of one point (1, D): the goal is the start."""
    return Trajectory(
        joint_names=robot.joint_names,
        time=np.zeros(1),
        positions=waypoint,
        velocities=np.zeros_like(waypoint),
        accelerations=np.zeros_like(waypoint),
        stops=0,
        deviation=0.0,
        verification=verification,
    )


def _check_numbers(tolerance: float, speed: float, period: float) -> None:
    for name, value, holds, expected in (
        ("tolerance", tolerance, 0 <= tolerance < np.inf, "a number of 0 or more [rad]"),
        ("speed", speed, 0 < speed <= 1, "a share of the velocity limits in (0, 1]"),
        ("period", period, 1e-4 <= period <= 1, "a time from 0.0001 to 1 [s]"),
    ):
        if not holds:
            raise ValueError(f"{name} is {value}; expected {expected}")
