"""Shortcutting: replace detours by straight edges, a batch of candidates at a time."""

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edge_checks import first_free_edge
from vrrt_jax.core.edges import (
    Edge,
    Space,
    StraightLineEdges,
    distance,
    steps_between,
)
from vrrt_jax.core.types import pytree

LANES = 16  # candidates in a round
PATIENCE = 6  # idle rounds after which it stops
CHECKED = 8  # of those, the ones that save most are checked
EDGE_STEPS = 128  # sub-steps of a candidate, so the longest is 128 times the resolution
SAME = 1e-4  # [rad] or [m] waypoints nearer than this are one
GAIN = 1e-3  # [rad] smallest saving worth a new corner
PAYS = 2e-3  # share of the length; rounds that save less count as idle


@pytree
class _Path:
    q: jax.Array  # (P, D), the last waypoint repeated beyond ``size``
    size: jax.Array  # () i32
    idle: jax.Array  # () i32 rounds since one that paid
    round: jax.Array  # () i32


def shortcut(
    world: Space, path: np.ndarray, *, key: jax.Array, rounds: int = 150, patience: int = PATIENCE
) -> np.ndarray:
    """Shorten a collision-free path; the ends stay.

    In every round 16 pairs of places on the path are drawn, and of the straight edges between them
    the free one that saves most is taken.

    Args:
        world: robot and obstacles.
        path: (P, D) waypoints.
        key: random key.
        rounds: at most so many.
        patience: stop after so many rounds in a row that hardly pay.

    Returns:
        (P', D) waypoints.
    """
    path = np.asarray(path, np.float32)
    if len(path) < 3:
        return path
    done = _shortcut(world, padded(path), np.int32(len(path)), key, rounds, patience)
    return np.asarray(done.q)[: int(done.size)]


@host_jit
def _shortcut(world: Space, q, size, key, rounds, patience) -> _Path:
    state = _Path(q=q, size=size, idle=jnp.int32(0), round=jnp.int32(0))
    return jax.lax.while_loop(
        lambda s: (s.round < rounds) & (s.idle < patience) & (s.size > 2),
        lambda s: _round(world, s, jax.random.fold_in(key, s.round)),
        state,
    )


@pytree
class Splice:
    """A straight edge between two places on a path, and where it belongs."""

    found: jax.Array  # () bool, there is one that is free and saves something
    first: jax.Array  # () i32 the waypoint before its beginning
    last: jax.Array  # () i32 the waypoint before its end
    q_from: jax.Array  # (D,)
    q_to: jax.Array  # (D,)
    saving: jax.Array  # () how much shorter the path gets
    length: jax.Array  # () of the path before
    checked: jax.Array  # () i32 configurations checked


def best_splice(world: Space, q: jax.Array, size: jax.Array, key: jax.Array) -> Splice:
    """Of the straight edges between 16 pairs of places on a path the free one that saves most.

    Args:
        world: robot and obstacles.
        q: (P, D) waypoints, the last one repeated beyond ``size``.
        size: () i32 how many there are.
        key: random key.
    """
    # Lengths along the path; zero beyond its end.
    edges = world.edge(q[:-1], q[1:])
    length = world.length(edges)
    along = jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])

    # Draw pairs of places on the path, the first pair its two ends: on which edge they are, how far
    # along it, and the configurations there.
    ends = along[-1] * jax.random.uniform(key, (LANES, 2))
    ends = jnp.sort(ends.at[0].set(jnp.stack([0.0 * along[-1], along[-1]])), axis=1)
    index = jnp.clip(jnp.searchsorted(along, ends, side="right") - 1, 0, size - 2)
    share = jnp.clip((ends - along[index]) / jnp.maximum(length[index], 1e-9), 0.0, 1.0)
    parts = world.truncate(_rows(edges, index), share)
    q_ends, at = world.end(q[index], parts), along[index] + world.length(parts)
    q_a, q_b = q_ends[:, 0], q_ends[:, 1]

    # Straight edges between them, those that save most first. The first free one is taken.
    direct = world.edge(q_a, q_b)
    saving = at[:, 1] - at[:, 0] - world.length(direct)
    room = index[:, 0] + 3 + size - (index[:, 1] + 1) <= q.shape[0]
    tried = (saving > GAIN) & world.is_resolved(direct, EDGE_STEPS) & room
    saving, lane = jax.lax.top_k(jnp.where(tried, saving, 0.0), CHECKED)
    asked = q_a[lane], _rows(direct, lane), EDGE_STEPS, saving > 0
    row, checked = first_free_edge(world, *asked)
    row, found = jnp.minimum(row, CHECKED - 1), row < CHECKED
    best = lane[row]
    return Splice(
        found=found,
        first=index[best, 0],
        last=index[best, 1],
        q_from=world.normalize(q_a[best]),
        q_to=world.normalize(q_b[best]),
        saving=saving[row],
        length=along[-1],
        checked=checked,
    )


def _round(world: Space, path: _Path, key: jax.Array) -> _Path:
    """Try 16 candidates, splice in the free one that saves most."""
    splice = best_splice(world, path.q, path.size, key)
    # Its two ends become waypoints between the edges that they lie on.
    first, last = splice.first, splice.last
    place = jnp.arange(path.q.shape[0])
    source = jnp.where(place <= first, place, place - (first + 3) + last + 1)
    spliced = path.q[jnp.clip(source, 0, path.q.shape[0] - 1)]
    spliced = jnp.where((place == first + 1)[:, None], splice.q_from, spliced)
    spliced = jnp.where((place == first + 2)[:, None], splice.q_to, spliced)
    pays = splice.found & (splice.saving > PAYS * splice.length)
    return _Path(
        q=jnp.where(splice.found, spliced, path.q),
        size=jnp.where(splice.found, first + 3 + path.size - (last + 1), path.size),
        idle=jnp.where(pays, 0, path.idle + 1),
        round=path.round + 1,
    )


def prune(world: Space, path: np.ndarray) -> np.ndarray:
    """Leave out waypoints of a path: from each, on to the last that a free edge leads to.

    Every corner costs a robot time, and random shortcuts leave many of a path of many. No path gets
    longer.

    Args:
        world: robot and obstacles.
        path: (P, D) free of collisions.

    Returns:
        (P', D) some of these waypoints, both ends among them.
    """
    path = np.asarray(path, np.float32)
    if len(path) < 3:
        return path
    kept = np.asarray(_kept(world, padded(path), np.int32(len(path))))
    return path[kept[: len(path)]]


@host_jit
def _kept(world: Space, q: jax.Array, size: jax.Array) -> jax.Array:
    """Which waypoints (P,) bool a pruned path has."""
    room = len(q)
    length = world.length(world.edge(q[:-1], q[1:]))
    along = jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])
    farthest_first = jnp.arange(room - 1, -1, -1)

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        at, kept = state
        q_from = jnp.broadcast_to(q[at], q.shape)
        edge = world.edge(q_from, q[farthest_first])
        tried = (farthest_first > at + 1) & (farthest_first < size)
        tried &= world.is_resolved(edge, EDGE_STEPS)
        tried &= world.length(edge) <= along[farthest_first] - along[at]
        row, _ = first_free_edge(world, q_from, edge, EDGE_STEPS, tried)
        at = jnp.where(row < room, farthest_first[jnp.minimum(row, room - 1)], at + 1)
        return at, kept.at[at].set(True)

    start = jnp.int32(0), jnp.zeros(room, bool).at[0].set(True)
    return jax.lax.while_loop(lambda state: state[0] < size - 1, step, start)[1]


def without_repeats(world: StraightLineEdges, path: np.ndarray) -> np.ndarray:
    """The path (P, D) without waypoints that repeat the one before; its ends stay.

    Waypoints whose joints are all within :data:`SAME` are one.
    """
    path, kept = np.asarray(path, np.float32), [0]
    for index in range(1, len(path)):
        if np.abs(steps_between(world, path[kept[-1]], path[index])).max() > SAME:
            kept.append(index)
    # The end takes the place of a waypoint that it repeats, unless that is the start.
    if len(kept) > 1:
        kept[-1] = len(path) - 1
    return path[kept]


def _rows(edge: Edge, index: jax.Array) -> Edge:
    return jax.tree.map(lambda leaf: leaf[index], edge)


def path_length(world: Space, path: np.ndarray) -> float:
    """Length of a path (P, D) [rad]."""
    return float(_length(world, padded(path)))


@jax.jit
def _length(world: Space, q: jax.Array) -> jax.Array:
    return jnp.sum(distance(world, q[:-1], q[1:]))


def padded(path: np.ndarray, least: int = 64) -> np.ndarray:
    """A path (P, D) with its last waypoint repeated: few sizes, so few compilations.

    Args:
        path: (P, D).
        least: smallest size, a power of two.
    """
    path = np.asarray(path, np.float32)
    room = max(least, 1 << (len(path) + 2).bit_length())
    return np.concatenate([path, np.repeat(path[-1:], room - len(path), axis=0)])
