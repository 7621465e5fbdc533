"""Shortest paths of a car that also reverses (Reeds and Shepp 1990), batched.

A path is at most five arcs and straight lines. Its candidates are a few words such as left, right,
left, each also driven backwards in time, mirrored, and read from the goal. A candidate may turn
and reverse as its formula says, whatever the signs: it leads to the goal, so the shortest of them
is the answer. Lengths are in units of the turning radius inside this file but for the public
functions. Poses are x, y [m] and heading [rad].
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.types import pytree

_QUARTER = np.pi / 2


@pytree
class Curve:
    """Arcs and lines, driven one after the other."""

    drive: jax.Array  # (..., 5) signed lengths in radii, negative in reverse
    turn: jax.Array  # (..., 5) 1 to the left, -1 to the right, 0 straight on


def length(a: jax.Array, b: jax.Array, radius: jax.Array | float) -> jax.Array:
    """Lengths (...) [m] of the shortest paths between poses (..., 3).

    Args:
        a: (..., 3) starts.
        b: (..., 3) goals.
        radius: smallest turning radius [m].
    """
    return _best(_goal_in_start(a, b, radius))[0] * radius


def shortest(a: jax.Array, b: jax.Array, radius: jax.Array | float) -> Curve:
    """The shortest paths (...) between poses (..., 3); see :func:`length`."""
    # The barrier keeps XLA's CPU fusions from finding the word anew for every number of the curve.
    _, numbers, choice = jax.lax.optimization_barrier(_best(_goal_in_start(a, b, radius)))
    word, mirror = choice // 4, choice % 4
    backwards, mirrored = 1 - 2 * (mirror % 2), 1 - 2 * (mirror // 2)
    numbers = jnp.stack([*numbers, jnp.full_like(numbers[0], _QUARTER)], axis=-1)
    drive = jnp.sum(jnp.asarray(_DRIVE)[word] * numbers[..., None, :], axis=-1)
    return Curve(
        drive=drive * backwards[..., None],
        turn=jnp.asarray(_TURN)[word] * mirrored[..., None],
    )


def curve_length(curve: Curve) -> jax.Array:
    """Lengths (...) in radii."""
    return jnp.sum(jnp.abs(curve.drive), axis=-1)


def cut(curve: Curve, fraction: jax.Array) -> Curve:
    """The first fraction (...) of curves."""
    size = jnp.abs(curve.drive)
    before = jnp.cumsum(size, axis=-1) - size
    left = (fraction * jnp.sum(size, axis=-1))[..., None] - before
    drive = jnp.sign(curve.drive) * jnp.clip(left, 0.0, size)
    return Curve(drive=drive, turn=jnp.broadcast_to(curve.turn, drive.shape))


def follow(a: jax.Array, curve: Curve, radius: jax.Array | float) -> jax.Array:
    """Poses (..., 3) at the ends of curves that begin at poses (..., 3)."""
    x, y, heading = a[..., 0], a[..., 1], a[..., 2]
    for k in range(5):
        drive, turn = curve.drive[..., k] * radius, curve.turn[..., k]
        after = heading + curve.drive[..., k] * turn
        # An arc is as long as its chord is long, in the middle heading: chord = 2 r sin(angle / 2)
        half = curve.drive[..., k] * turn / 2
        chord = drive * jnp.sinc(half / jnp.pi)
        x, y = x + chord * jnp.cos(heading + half), y + chord * jnp.sin(heading + half)
        heading = after
    return jnp.stack([x, y, heading], axis=-1)


def interpolate(
    a: jax.Array, b: jax.Array, fraction: jax.Array | float, radius: jax.Array | float
) -> jax.Array:
    """Poses (..., 3) at a fraction (...) of the shortest paths; headings in [-pi, pi)."""
    pose = follow(a, cut(shortest(a, b, radius), jnp.asarray(fraction)), radius)
    return pose.at[..., 2].set(_wrap(pose[..., 2]))


def _goal_in_start(a: jax.Array, b: jax.Array, radius: jax.Array | float) -> tuple:
    dx, dy = (b[..., 0] - a[..., 0]) / radius, (b[..., 1] - a[..., 1]) / radius
    c, s = jnp.cos(a[..., 2]), jnp.sin(a[..., 2])
    return c * dx + s * dy, c * dy - s * dx, b[..., 2] - a[..., 2]


def _wrap(angle: jax.Array) -> jax.Array:
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))


def _best(goal: tuple) -> tuple[jax.Array, tuple, jax.Array]:
    """Length (...), numbers t, u, v (...) and index (...) of the shortest candidate.

    The index is four times the word's, plus 1 if driven backwards and 2 if mirrored.
    """
    x, y, phi = goal
    c, s = jnp.cos(phi), jnp.sin(phi)
    seen_from_goal = (x * c + y * s, x * s - y * c)
    best = jnp.full(x.shape, jnp.inf, x.dtype)
    numbers, choice = (jnp.zeros_like(x),) * 3, jnp.zeros(x.shape, jnp.int32)
    for word, (formula, from_goal, *_) in enumerate(_WORDS):
        wx, wy = seen_from_goal if from_goal else (x, y)
        for mirror in range(4):
            back, flip = 1 - 2 * (mirror % 2), 1 - 2 * (mirror // 2)
            total, *found = formula(wx * back, wy * flip, phi * (back * flip), c, s * (back * flip))
            shorter = total < best
            best = jnp.where(shorter, total, best)
            numbers = tuple(jnp.where(shorter, n, m) for n, m in zip(found, numbers, strict=True))
            choice = jnp.where(shorter, 4 * word + mirror, choice)
    return best, numbers, choice


# The formulas, numbered as in the paper: from the goal's pose (x, y, phi) with the cosine and sine
# of phi to the length and the three free numbers of the word, or to infinity.


def _left_straight_left(x, y, phi, c, s):  # 8.1
    u, t = _polar(x - s, y - 1 + c)
    t, v = _wrap(t), _wrap(phi - t)
    return abs(t) + u + abs(v), t, u, v


def _left_straight_right(x, y, phi, c, s):  # 8.2
    square, angle = _polar_squared(x + s, y - 1 - c)
    u = _root(square - 4)
    t = _wrap(angle + jnp.arctan2(2.0, u))
    v = _wrap(t - phi)
    return jnp.where(square >= 4, abs(t) + u + abs(v), jnp.inf), t, u, v


def _left_right_left(x, y, phi, c, s):  # 8.3, 8.4
    far, angle = _polar(x - s, y - 1 + c)
    u = -2 * jnp.arcsin(jnp.minimum(far / 4, 1.0))
    t = _wrap(angle + u / 2 + jnp.pi)
    v = _wrap(phi - t + u)
    return jnp.where(far <= 4, abs(t) - u + abs(v), jnp.inf), t, u, v


def _left_right_left_right(x, y, phi, c, s):  # 8.7
    xi, eta = x + s, y - 1 - c
    rho = (2 + _root(xi**2 + eta**2)) / 4
    u = jnp.arccos(jnp.minimum(rho, 1.0))
    t, v = _outer_turns(u, -u, xi, eta, phi)
    return jnp.where(rho <= 1, abs(t) + 2 * u + abs(v), jnp.inf), t, u, v


def _left_right_left_right_cusps(x, y, phi, c, s):  # 8.8
    xi, eta = x + s, y - 1 - c
    rho = (20 - xi**2 - eta**2) / 16
    u = -jnp.arccos(jnp.clip(rho, 0.0, 1.0))
    t, v = _outer_turns(u, u, xi, eta, phi)
    exists = (rho >= 0) & (rho <= 1)
    return jnp.where(exists, abs(t) - 2 * u + abs(v), jnp.inf), t, u, v


def _left_right_straight_left(x, y, phi, c, s):  # 8.9
    square, angle = _polar_squared(x - s, y - 1 + c)
    far = _root(square - 4)
    u = 2 - far
    t = _wrap(angle + jnp.arctan2(far, -2.0))
    v = _wrap(phi - _QUARTER - t)
    return jnp.where(square >= 4, abs(t) + _QUARTER + abs(u) + abs(v), jnp.inf), t, u, v


def _left_right_straight_right(x, y, phi, c, s):  # 8.10
    rho, t = _polar(1 + c - y, x + s)
    u = 2 - rho
    v = _wrap(t + _QUARTER - phi)
    return jnp.where(rho >= 2, abs(t) + _QUARTER + abs(u) + abs(v), jnp.inf), t, u, v


def _left_right_straight_left_right(x, y, phi, c, s):  # 8.11
    xi, eta = x + s, y - 1 - c
    square = xi**2 + eta**2
    u = 4 - _root(square - 4)
    t = _wrap(jnp.arctan2((4 - u) * xi - 2 * eta, -2 * xi + (u - 4) * eta))
    v = _wrap(t - phi)
    exists = (square >= 4) & (u <= 0)
    return jnp.where(exists, abs(t) + 2 * _QUARTER + abs(u) + abs(v), jnp.inf), t, u, v


def _outer_turns(u, v, xi, eta, phi):
    """The first and the last turn around two inner ones."""
    delta = u - v
    a, b = jnp.sin(u) - jnp.sin(delta), jnp.cos(u) - jnp.cos(delta) - 1
    angle = jnp.arctan2(eta * a - xi * b, xi * a + eta * b)
    behind = 2 * (jnp.cos(delta) - jnp.cos(v) - jnp.cos(u)) + 3 < 0
    t = _wrap(angle + jnp.where(behind, jnp.pi, 0.0))
    return t, _wrap(t - u + v - phi)


def _root(square):
    return jnp.sqrt(jnp.maximum(square, 0.0))


def _polar_squared(x, y):
    return x**2 + y**2, jnp.arctan2(y, x)


def _polar(x, y):
    square, angle = _polar_squared(x, y)
    return _root(square), angle


# A word: its formula, whether it is read from the goal, its turns, and its drives as multiples of
# (t, u, v, a quarter turn).
_T, _U, _V, _Q = np.eye(4)
_WORDS: tuple[tuple[Callable, bool, str, tuple], ...] = (
    (_left_straight_left, False, "LSL", (_T, _U, _V)),
    (_left_straight_right, False, "LSR", (_T, _U, _V)),
    (_left_right_left, False, "LRL", (_T, _U, _V)),
    (_left_right_left, True, "LRL", (_V, _U, _T)),
    (_left_right_left_right, False, "LRLR", (_T, _U, -_U, _V)),
    (_left_right_left_right_cusps, False, "LRLR", (_T, _U, _U, _V)),
    (_left_right_straight_left, False, "LRSL", (_T, -_Q, _U, _V)),
    (_left_right_straight_right, False, "LRSR", (_T, -_Q, _U, _V)),
    (_left_right_straight_left, True, "LSRL", (_V, _U, -_Q, _T)),
    (_left_right_straight_right, True, "RSRL", (_V, _U, -_Q, _T)),
    (_left_right_straight_left_right, False, "LRSLR", (_T, -_Q, _U, -_Q, _V)),
)
_TURN = np.zeros((len(_WORDS), 5), np.float32)  # 1, -1 or 0 for each piece
_DRIVE = np.zeros((len(_WORDS), 5, 4), np.float32)
for _row, (_, _, _letters, _drives) in enumerate(_WORDS):
    _TURN[_row, : len(_letters)] = [{"L": 1, "R": -1, "S": 0}[letter] for letter in _letters]
    _DRIVE[_row, : len(_drives)] = _drives
