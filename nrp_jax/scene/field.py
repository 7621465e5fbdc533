"""Distance fields of occupancy grids, with a safe answer between their points.

A field holds exact distances to the solid cells at the points of a lattice. A distance changes no
faster than the point moves. So the value at the nearest lattice point, less the distance to that
lattice point, is never more than the true distance.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from nrp_jax.homes.grid import Grid
from vrrt_jax.core.types import pytree

FINE = {2: 8, 3: 2}  # lattice steps a cell, for planar maps and for maps with heights


@pytree
class DistanceField:
    """Distances to the nearest solid cell; planar if there is one layer."""

    values: jax.Array  # (X', Y', Z') [m]
    origin: jax.Array  # (3,) position of the first lattice point [m]
    step: jax.Array  # () between lattice points [m]

    @property
    def fine(self) -> int:
        """Lattice steps a cell."""
        return FINE[2 if self.values.shape[2] == 1 else 3]

    @property
    def resolution(self) -> jax.Array:
        """() side of a cell [m]."""
        return self.step * self.fine


def make_field(grid: Grid) -> DistanceField:
    """Compute the field of a map, with a rim of one solid cell around it in x and y.

    The lattice holds the corners of all cells. So the point of a cell that is nearest to a lattice
    point is a lattice point too, and the distance transform of the lattice is exact.
    """
    dims = 2 if grid.planar else 3
    fine = FINE[dims]
    solid = np.pad(grid.occupied, [(1, 1), (1, 1), (0, 0)], constant_values=True)
    for axis in range(dims):
        solid = _refine(solid, fine, axis)
    step = grid.resolution / fine
    distance = ndimage.distance_transform_edt(~solid, sampling=step)
    origin = np.array(grid.origin) - grid.resolution * np.array([1, 1, 0])
    return DistanceField(
        values=jnp.asarray(distance, jnp.float32),
        origin=jnp.asarray(origin, jnp.float32),
        step=jnp.float32(step),
    )


def clearance_bound(field: DistanceField, points: jax.Array) -> jax.Array:
    """A lower bound (n,) of the distance from points (3, n) to the nearest solid cell [m].

    Beside the map the distance to the rim counts as negative: all is solid there.
    """
    shape = field.values.shape
    place = (points - field.origin[:, None]) / field.step
    # Axis by axis: the flat index of the nearest lattice point, and the squared distance to it.
    index, squared = jnp.int32(0), 0.0
    for axis in range(2 if shape[2] == 1 else 3):
        along, last = place[axis], shape[axis] - 1
        if axis == 2:  # above and below the map nothing is solid: the distance only grows there
            along = jnp.clip(along, 0, last)
        near = jnp.clip(jnp.round(along), 0, last)
        squared += (along - near) ** 2
        index = index * shape[axis] + near.astype(jnp.int32)
    return field.values.reshape(-1)[index] - field.step * jnp.sqrt(squared)


def _refine(solid: np.ndarray, fine: int, axis: int) -> np.ndarray:
    """Turn n cells along an axis into n * fine + 1 lattice points.

    A lattice point between two cells is solid if one of the cells is.
    """
    solid = np.moveaxis(solid, axis, 0)
    points = np.zeros((solid.shape[0] * fine + 1, *solid.shape[1:]), bool)
    for k in range(fine + 1):
        points[k : k + len(solid) * fine : fine] |= solid
    return np.moveaxis(points, 0, axis)
