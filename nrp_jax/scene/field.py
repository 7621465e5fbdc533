"""Distance fields of occupancy grids: what the networks see of a home.

Collision checks do not use them, see :mod:`nrp_jax.scene.near_cells`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from nrp_jax.homes.grid import Grid
from nrp_jax.homes.memory import check_memory
from vrrt_jax.core.types import pytree

FINE = 2  # lattice steps a cell: the lattice holds the corners and the centers of all cells
_BYTES = 100  # of memory that a lattice point takes while its distance is computed


@pytree
class DistanceField:
    """Distances to the nearest solid cell at the points of a lattice; planar if it has one layer.

    The lattice begins at the corner of a rim of one solid cell around the map in x and y.
    """

    values: jax.Array  # (X', Y', Z') [m]
    step: jax.Array  # () between lattice points [m]

    @property
    def resolution(self) -> jax.Array:
        """() side of a cell [m]."""
        return self.step * FINE


def make_field(grid: Grid) -> DistanceField:
    """Compute the field of a map, with a rim of one solid cell around it in x and y.

    The lattice holds the corners of all cells. So the point of a cell that is nearest to a lattice
    point is a lattice point too, and the distance transform of the lattice is exact.

    Raises:
        ValueError: the map is too large for the memory that is free.
    """
    shape, dims = grid.occupied.shape, 2 if grid.planar else 3
    what = f"a map of {' x '.join(map(str, shape[:dims]))} cells"
    check_memory(_BYTES * FINE**dims * grid.occupied.size, what)
    solid = np.pad(grid.occupied, [(1, 1), (1, 1), (0, 0)], constant_values=True)
    for axis in range(dims):
        solid = _refine(solid, axis)
    step = grid.resolution / FINE
    distance = ndimage.distance_transform_edt(~solid, sampling=step)
    return DistanceField(values=jnp.asarray(distance, jnp.float32), step=jnp.float32(step))


def floor_clearance(field: DistanceField, height: float, every: int = 1) -> np.ndarray:
    """Clearances (X, Y) of the centers of cells from all that is as low as a height; on the host.

    Args:
        field: of the map.
        height: what is higher does not count [m].
        every: only so many cells apart, along each axis.
    """
    layers = int(np.ceil(height / float(field.step))) + 1
    centers = slice(FINE + FINE // 2, -FINE, FINE * every)  # without the rim
    return np.asarray(field.values)[centers, centers, :layers].min(axis=2)


def _refine(solid: np.ndarray, axis: int) -> np.ndarray:
    """Turn n cells along an axis into n * FINE + 1 lattice points.

    A lattice point between two cells is solid if one of the cells is.
    """
    solid = np.moveaxis(solid, axis, 0)
    points = np.zeros((solid.shape[0] * FINE + 1, *solid.shape[1:]), bool)
    for k in range(FINE + 1):
        points[k : k + len(solid) * FINE : FINE] |= solid
    return np.moveaxis(points, 0, axis)
