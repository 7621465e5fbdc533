"""A path whose corners are rounded, and the speed along it that limits allow.

A corner is what the path becomes when it is averaged along its length with the weight
``3/4 (1 - x^2)``, ``x`` from -1 to 1 over the blend. So a blend lies in the triangle of the corner
and of the two points where it leaves the straight lines, its curvature is continuous, and its
largest derivatives are known in closed form.
"""

import dataclasses

import numpy as np

from vrrt_jax.motion.limits import MotionLimits
from vrrt_jax.motion.profile import Phase, change_length, largest, straight

DEPTH = 3 / 16  # distance of a blend from its corner, in units of half width times turn
_CURVATURE, _CURVATURE_RATE = 3 / 4, 3 / 2  # largest, in units of turn / half width (squared)
_ROOM = 0.4  # of a segment that a blend may take, so that there is room to change speed


@dataclasses.dataclass(frozen=True, kw_only=True)
class BlendedPath:
    """Straight lines with blends at corners. Letters: ``P`` waypoints, ``n`` places."""

    waypoints: np.ndarray  # (P, D), no two in a row the same
    half_width: np.ndarray  # (P - 2,) length on each side that the blend of each corner takes

    @property
    def lengths(self) -> np.ndarray:
        """(P - 1,) of the segments."""
        return np.linalg.norm(np.diff(self.waypoints, axis=0), axis=1)

    @property
    def directions(self) -> np.ndarray:
        """(P - 1, D) of the segments, of length one."""
        return np.diff(self.waypoints, axis=0) / self.lengths[:, None]

    @property
    def turns(self) -> np.ndarray:
        """(P - 2, D) change of direction at each corner."""
        return np.diff(self.directions, axis=0)

    @property
    def corners(self) -> np.ndarray:
        """(P - 2,) length of the path up to each corner."""
        return np.cumsum(self.lengths)[:-1]

    @property
    def deviations(self) -> np.ndarray:
        """(P - 2,) how far each blend is from its corner, at most."""
        return DEPTH * self.half_width * np.linalg.norm(self.turns, axis=1)

    def derivatives(self, s: np.ndarray) -> np.ndarray:
        """The path and its first three derivatives (4, n, D) at lengths (n,) from the start."""
        starts = np.concatenate([[0.0], self.corners])
        segment = np.searchsorted(self.corners, s, side="right")
        out = np.zeros((4, len(s), self.waypoints.shape[1]))
        out[1] = self.directions[segment]
        out[0] = self.waypoints[segment] + (s - starts[segment])[:, None] * out[1]
        for k in np.flatnonzero(self.half_width):
            corner, width, turn = self.corners[k], self.half_width[k], self.turns[k]
            inside = np.flatnonzero(np.abs(s - corner) < width)
            x = ((s[inside] - corner) / width)[:, None]
            # The averaged corner less the sharp one, and its derivatives.
            out[0, inside] += turn * width * (3 / 16 + x / 2 + 3 / 8 * x**2 - x**4 / 16)
            out[0, inside] -= turn * width * np.maximum(x, 0)
            out[1, inside] += turn * (1 / 2 + 3 / 4 * x - x**3 / 4 - (x >= 0))
            out[2, inside] = turn / width * 3 / 4 * (1 - x**2)
            out[3, inside] = turn / width**2 * -3 / 2 * x
        return out


def widest_blends(waypoints: np.ndarray, tolerance: float) -> BlendedPath:
    """Blends that are no farther from their corners than a tolerance [rad].

    Args:
        waypoints: (P, D), no two in a row the same.
        tolerance: Euclidean over joints; with 0 the path keeps its corners.
    """
    path = BlendedPath(waypoints=waypoints, half_width=np.zeros(max(len(waypoints) - 2, 0)))
    return dataclasses.replace(
        path, half_width=half_widths(path.turns, path.lengths, max(tolerance, 0.0))
    )


def half_widths(turns: np.ndarray, lengths: np.ndarray, tolerance: float) -> np.ndarray:
    """Half widths (n,) of the widest blends of corners; arguments as of :class:`BlendedPath`."""
    room = _ROOM * np.minimum(lengths[:-1], lengths[1:])
    depth = DEPTH * np.linalg.norm(turns, axis=1)
    return np.minimum(tolerance / np.maximum(depth, 1e-12), room)


def speed_profile(path: BlendedPath, limits: MotionLimits) -> list[Phase]:
    """Phases of the motion along a path: each blend at a speed of its own, stops at sharp corners.

    Args:
        path: of two waypoints or more.
        limits: an array (D,) each.
    """
    along = limits_along(path.directions, limits)
    inner = np.minimum(along[:-1, 0], along[1:, 0])
    inner = np.minimum(inner, corner_speeds(path.turns, path.half_width, limits))
    speeds = np.concatenate([[0.0], inner, [0.0]])
    # Straight lines begin and end where blends do.
    widths = np.concatenate([[0.0], path.half_width, [0.0]])
    free = path.lengths - widths[:-1] - widths[1:]
    _leave_room_to_change(speeds, free, along)
    phases: list[Phase] = []
    for k, length in enumerate(free):
        phases += straight(length, speeds[k], speeds[k + 1], *along[k])
        if widths[k + 1] > 0:
            phases.append((2 * widths[k + 1] / speeds[k + 1], 0.0))
    return phases


def limits_along(directions: np.ndarray, limits: MotionLimits) -> np.ndarray:
    """Velocity, acceleration and jerk along segments (n, 3) that no joint's limit forbids."""
    share = np.maximum(np.abs(directions), 1e-12)
    return np.stack([(limit / share).min(1) for limit in dataclasses.astuple(limits)], axis=1)


def corner_speeds(turns: np.ndarray, half_width: np.ndarray, limits: MotionLimits) -> np.ndarray:
    """Speeds (n,) in the blends of corners that limits of acceleration and jerk allow."""
    turn, width = np.maximum(np.abs(turns), 1e-12), half_width[:, None]
    by_acceleration = np.sqrt(limits.acceleration * width / (_CURVATURE * turn)).min(1)
    by_jerk = np.cbrt(limits.jerk * width**2 / (_CURVATURE_RATE * turn)).min(1)
    return np.minimum(by_acceleration, by_jerk)


def _leave_room_to_change(speeds: np.ndarray, free: np.ndarray, along: np.ndarray) -> None:
    """Lower speeds (P,), in place, until each straight line has room for the change along it."""
    segments = range(len(free))
    passes = [(k, k, k + 1) for k in segments] + [(k, k + 1, k) for k in reversed(segments)]
    for k, slow, fast in passes:

        def fits(v: float, k: int = k, slow: int = slow) -> bool:
            return change_length(speeds[slow], v, *along[k, 1:]) <= free[k]

        if speeds[fast] > speeds[slow]:
            speeds[fast] = largest(fits, speeds[slow], speeds[fast])
