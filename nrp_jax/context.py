"""Local windows: what the networks see of a map around the base of the robot.

A window is 4 x 4 m (x 2 m), aligned with the map, centred on the corner of cells nearest to the
base: cell (i, j) of it covers [0.1 (i - 20), 0.1 (i - 19)) from there. Outside the map everything
is occupied.
"""

import jax
import jax.numpy as jnp
import numpy as np

WINDOW_CELLS = 40


def pad(occupied: np.ndarray, outside: float = True) -> jax.Array:
    """A map (X, Y, Z) with a border of occupied cells, for :func:`window`; do this once a map."""
    border = (
        (WINDOW_CELLS // 2, WINDOW_CELLS // 2),
        (WINDOW_CELLS // 2, WINDOW_CELLS // 2),
        (0, 0),
    )
    return jnp.asarray(np.pad(occupied, border, constant_values=outside))


def window_centre(q: jax.Array, resolution=0.1, origin=(0.0, 0.0)) -> jax.Array:
    """Place (..., 2) [m] of the windows' centres for ``q`` (..., D): origins of local frames.

    The corner of cells nearest to the base; ``origin`` is the corner of the map's first cell [m].
    """
    origin = jnp.asarray(origin, q.dtype)[..., :2]
    return jnp.round((q[..., :2] - origin) / resolution) * resolution + origin


def window(padded: jax.Array, resolution, q: jax.Array, origin=(0.0, 0.0)) -> jax.Array:
    """The window (40, 40, Z) around ``q`` (D,); vmappable.

    Args:
        padded: from :func:`pad`, (X + 40, Y + 40, Z).
        resolution: side of a cell [m].
        q: (D,) configuration whose base, its first two joints, is in the map [m].
        origin: place of the corner of the map's first cell [m].
    """
    place = (q[:2] - jnp.asarray(origin, q.dtype)[:2]) / resolution
    first = jnp.round(place).astype(jnp.int32)  # the border shifts it by half a window, and back
    size = (WINDOW_CELLS, WINDOW_CELLS, padded.shape[2])
    return jax.lax.dynamic_slice(padded, (first[0], first[1], 0), size)


windows = jax.jit(jax.vmap(window, (None, None, 0, None)))  # of q (n, D): (n, 40, 40, Z)
