"""Shortest paths of a car that also reverses (Reeds and Shepp 1990), batched.

A path is at most five arcs and straight lines. Which arcs and lines follow each other is called a
word, such as left, right, left. Each word is also driven backwards in time, mirrored, and read from
the goal: these are the candidates. The paper's formulas give the lengths of a word's pieces, which
may be negative: then the car reverses there. Every candidate leads to the goal, so that the
shortest candidate is the answer. Lengths are in units of the turning radius inside this file,
except in the public functions. Poses are x, y [m] and heading [rad].
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

    drive: tuple[jax.Array, ...]  # 5 of (...) signed lengths in radii, negative in reverse
    turn: tuple[jax.Array, ...]  # 5 of (...) 1 to the left, -1 to the right, 0 straight on


def length(a: jax.Array, b: jax.Array, radius: jax.Array | float) -> jax.Array:
    """Lengths (...) [m] of the shortest paths between poses (..., 3).

    Args:
        a: (..., 3) starts.
        b: (..., 3) goals.
        radius: smallest turning radius [m].
    """
    return jnp.min(_candidates(_goal_in_start(a, b, radius))[0], axis=0) * radius


def shortest(a: jax.Array, b: jax.Array, radius: jax.Array | float) -> Curve:
    """The shortest paths (...) between poses (..., 3); see :func:`length`."""
    # The barrier keeps XLA's CPU fusions from finding the word anew for every number of the curve.
    candidates = jax.lax.optimization_barrier(_candidates(_goal_in_start(a, b, radius)))
    choice = jnp.argmin(candidates[0], axis=0)
    numbers = [jnp.take_along_axis(n, choice[None], axis=0)[0] for n in candidates[1:]]
    # The word of the best candidate, and how it was driven: the signs of its drives and turns.
    word, mirror = choice // 4, choice % 4
    backwards, mirrored = 1 - 2 * (mirror % 2), 1 - 2 * (mirror // 2)
    # Its five drives are sums of multiples of the numbers t, u, v and of a quarter turn.
    row = jnp.asarray(_TABLE)[word]  # (..., 25)
    numbers.append(jnp.full_like(numbers[0], _QUARTER))
    drive = [sum(row[..., 5 * k + i] * n for k, n in enumerate(numbers)) for i in range(5)]
    return Curve(
        drive=tuple(d * backwards for d in drive),
        turn=tuple(row[..., 20 + i] * mirrored for i in range(5)),
    )


def curve_length(curve: Curve) -> jax.Array:
    """Lengths (...) in radii."""
    return sum((jnp.abs(drive) for drive in curve.drive[1:]), jnp.abs(curve.drive[0]))


def extent(curve: Curve, radius: jax.Array | float) -> jax.Array:
    """How far curves go (...): the sum over pieces of the length [m] or, if larger, the turn [rad].

    On a tight arc a short drive is a large turn, and the turn sweeps the outstretched arm around.
    """
    pieces = piece_extents(curve, radius)
    return sum(pieces[1:], pieces[0])


def piece_extents(curve: Curve, radius: jax.Array | float) -> list[jax.Array]:
    """The extents of the pieces, 5 of (...); see :func:`extent`."""
    tight = jnp.maximum(radius, 1.0)
    return [
        jnp.abs(drive) * jnp.where(turn == 0, radius, tight)
        for drive, turn in zip(curve.drive, curve.turn, strict=True)
    ]


def truncate(curve: Curve, fraction: jax.Array, radius: jax.Array | float) -> Curve:
    """The first fraction (...) of curves, measured by their :func:`extent`."""
    # Piece by piece: drive it as far as what is left of the extent allows.
    left, drives = fraction * extent(curve, radius), []
    for drive, size in zip(curve.drive, piece_extents(curve, radius), strict=True):
        drives.append(drive * jnp.clip(left / jnp.maximum(size, 1e-12), 0.0, 1.0))
        left = left - size
    turns = tuple(jnp.broadcast_to(turn, left.shape) for turn in curve.turn)
    return Curve(drive=tuple(drives), turn=turns)


def follow(a: jax.Array, curve: Curve, radius: jax.Array | float) -> jax.Array:
    """Poses (..., 3) at the ends of curves that begin at poses (..., 3)."""
    x, y, heading = a[..., 0], a[..., 1], a[..., 2]
    for drive, turn in zip(curve.drive, curve.turn, strict=True):
        half = drive * turn / 2
        # An arc ends where its chord does, which points in the middle heading: 2 r sin(half angle).
        chord = radius * jnp.where(turn == 0, drive, 2 * jnp.sin(jnp.abs(half)) * jnp.sign(drive))
        x, y = x + chord * jnp.cos(heading + half), y + chord * jnp.sin(heading + half)
        heading = heading + 2 * half
    return jnp.stack([x, y, heading], axis=-1)


def _goal_in_start(a: jax.Array, b: jax.Array, radius: jax.Array | float) -> tuple:
    """The goals' x, y and heading (...) in the frames of the starts; lengths in radii."""
    dx, dy = (b[..., 0] - a[..., 0]) / radius, (b[..., 1] - a[..., 1]) / radius
    c, s = jnp.cos(a[..., 2]), jnp.sin(a[..., 2])
    return c * dx + s * dy, c * dy - s * dx, b[..., 2] - a[..., 2]


def _wrap(angle: jax.Array) -> jax.Array:
    """The same angles in [-pi, pi)."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))


def _candidates(goal: tuple) -> tuple[jax.Array, ...]:
    """Lengths and numbers t, u, v (W, ...) of all candidates.

    Index ``4 w + m`` is word w, driven backwards if m is odd and mirrored if m is 2 or 3.
    """
    back, flip = (
        np.reshape(s, (4,) + (1,) * goal[0].ndim).astype(np.float32)
        for s in ([1, -1, 1, -1], [1, 1, -1, -1])
    )
    x, y, phi = goal
    c, s = jnp.cos(phi), jnp.sin(phi)
    seen_from_goal = (x * c + y * s, x * s - y * c)
    # Each word in its four mirror images at once, along the first axis.
    found = []
    for formula, from_goal, *_ in _WORDS:
        wx, wy = seen_from_goal if from_goal else (x, y)
        mirrors = (wx * back, wy * flip, phi * (back * flip))
        found.append(formula(*mirrors, jnp.broadcast_to(c, mirrors[0].shape), s * (back * flip)))
    return tuple(jnp.concatenate(column) for column in zip(*found, strict=True))


# The formulas, numbered as in the paper. From the goal's pose (x, y, phi), with the cosine and sine
# of phi, they compute the length of the word and its three free numbers t, u and v. The length is
# infinite where the word cannot reach the goal.


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
    """The first and the last turn of a word whose two inner turns are given."""
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
# One row a word: for each of t, u, v and a quarter turn its five multiples, and the five turns.
_TABLE = np.zeros((len(_WORDS), 25), np.float32)
for _row, (_, _, _letters, _drives) in zip(_TABLE, _WORDS, strict=True):
    _row[:20].reshape(4, 5)[:, : len(_drives)] = np.transpose(_drives)
    _row[20 : 20 + len(_letters)] = [{"L": 1, "R": -1, "S": 0}[letter] for letter in _letters]
