"""From the waypoints of a path to a trajectory in small steps."""

import jax
import numpy as np

from nrp_jax.scene.exact import STEP
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edges import unwrapped
from vrrt_jax.core.shortcut import padded

BLOCK = 256  # configurations that are computed at once


def trajectory_of(world: GridWorld, path: np.ndarray) -> np.ndarray:
    """A path (P, D) in steps (T, D) of 0.02 m or rad at most; angles go on where they wrap."""
    return with_waypoints(world, path)[0]


def with_waypoints(world: GridWorld, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """See :func:`trajectory_of`; and where on it (P,) the waypoints are, as indices."""
    if len(path) < 2:
        return np.asarray(path), np.arange(len(path))
    spans = np.asarray(_spans(world, padded(path)))[: len(path) - 1]
    counts = np.maximum(np.ceil(spans / STEP), 1).astype(int)
    index = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    fraction = (within / counts[index]).astype(np.float32)
    # Always as many at a time, so that whatever the path's length nothing compiles anew.
    columns = path[index], path[index + 1], fraction
    points = [
        _interpolate(world, *(_block(column, begin) for column in columns))
        for begin in range(0, len(index), BLOCK)
    ]
    steps = unwrapped(world, np.concatenate([path[:1], np.concatenate(points)[: len(index)]]))
    return steps, np.concatenate([[0], np.cumsum(counts)])


def _block(rows: np.ndarray, begin: int) -> np.ndarray:
    """So many rows from one on; the last is repeated where there are fewer."""
    return rows[np.minimum(np.arange(begin, begin + BLOCK), len(rows) - 1)]


@jax.jit
def _spans(world: GridWorld, path: jax.Array) -> jax.Array:
    return world.span(world.edge(path[:-1], path[1:]))


@jax.jit
def _interpolate(world: GridWorld, q_a, q_b, fraction) -> jax.Array:
    return world.interpolate(q_a, q_b, fraction)
