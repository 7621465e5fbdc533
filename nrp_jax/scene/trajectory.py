"""From the waypoints of a path to a trajectory in small steps."""

import jax
import numpy as np

from nrp_jax.scene.exact import STEP
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edges import unwrapped
from vrrt_jax.core.shortcut import padded


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
    room = 1 << int(len(index) - 1).bit_length()  # few sizes, so few compilations
    padding = (0, room - len(index))
    q_a, q_b = (np.pad(path[index + k], [padding, (0, 0)], mode="edge") for k in (0, 1))
    points = _interpolate(world, q_a, q_b, np.pad(fraction, padding))
    steps = unwrapped(world, np.concatenate([path[:1], np.asarray(points)[: len(index)]]))
    return steps, np.concatenate([[0], np.cumsum(counts)])


@jax.jit
def _spans(world: GridWorld, path: jax.Array) -> jax.Array:
    return world.span(world.edge(path[:-1], path[1:]))


@jax.jit
def _interpolate(world: GridWorld, q_a, q_b, fraction) -> jax.Array:
    return world.interpolate(q_a, q_b, fraction)
