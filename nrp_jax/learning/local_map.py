"""Local windows: what the networks see of a map around the base of the robot.

A window is 4 x 4 m (x 2 m) and aligned with the map. Its center is the corner of cells nearest to
the base, which is also the origin of the local frame. Cell (i, j) of the window covers x from
0.1 (i - 20) to 0.1 (i - 19) m in the local frame, and y alike. Outside the map all is solid.
"""

from typing import Any

import jax
import jax.numpy as jnp

SIDE = 40  # cells


def center_cell(
    q: jax.Array, resolution: jax.Array | float = 0.1, origin: Any = (0.0, 0.0)
) -> jax.Array:
    """Corner of cells (..., 2) i32 nearest to the base at ``q`` (..., D), from the map's origin."""
    place = q[..., :2] - jnp.asarray(origin, q.dtype)[..., :2]
    return jnp.round(place / resolution).astype(jnp.int32)


def center(
    q: jax.Array, resolution: jax.Array | float = 0.1, origin: Any = (0.0, 0.0)
) -> jax.Array:
    """Place (..., 2) [m] of the window's center in the map: the origin of the local frame."""
    cell = center_cell(q, resolution, origin)
    return cell * resolution + jnp.asarray(origin, q.dtype)[..., :2]


def window(
    padded: jax.Array, q: jax.Array, resolution: jax.Array | float = 0.1, origin: Any = (0.0, 0.0)
) -> jax.Array:
    """The window (40, 40, Z) around ``q`` (D,); vmappable.

    Args:
        padded: (X + 40, Y + 40, Z) map with a border of 20 solid cells.
        q: (D,) configuration whose base, its first two joints, is in the map [m].
        resolution: side of a cell [m].
        origin: place of the corner of the map's first cell [m].
    """
    corner = center_cell(q, resolution, origin)  # the border shifts it by half a window, and back
    size = (SIDE, SIDE, padded.shape[2])
    return jax.lax.dynamic_slice(padded, (corner[0], corner[1], 0), size)


def stacked_window(
    padded: jax.Array, index: jax.Array, q: jax.Array, resolution: jax.Array | float = 0.1
) -> jax.Array:
    """The window (40, 40, Z) around ``q`` in map ``index`` of several (H, X + 40, Y + 40, Z)."""
    corner = center_cell(q, resolution)
    size = (1, SIDE, SIDE, padded.shape[3])
    return jax.lax.dynamic_slice(padded, (index, corner[0], corner[1], 0), size)[0]
