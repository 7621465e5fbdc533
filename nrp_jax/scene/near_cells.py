"""Spheres against the solid cells of a home, exactly.

A sphere touches a cell if the cell's nearest point lies within its radius. Only cells near the one
that holds the sphere's center matter. Which of those are solid stands in a few integers, a bit for
each, which are computed once for a map. So a sphere takes one look-up and no search.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from vrrt_jax.core.types import pytree, static

_WORD = 32  # bits of an integer
_MOST = 800  # cells that are near


@pytree
class NearCells:
    """Which cells around each cell are solid; planar if there is one layer.

    Places in x and y are measured from the corner of the map. Letters: ``W`` integers.
    """

    bits: jax.Array  # (X, Y, Z, W) u32, bit k: whether the k-th near cell is solid
    bottom: jax.Array  # () height of the lowest layer [m]
    cell: jax.Array  # () side of a cell [m]
    slack: jax.Array  # () distances are rounded by so much [m]
    reach: int = static()  # near cells are so many cells away at most, along each axis

    @property
    def is_planar(self) -> bool:
        """Whether heights do not matter."""
        return self.bits.shape[2] == 1


def make_near_cells(grid: Grid, radius: float) -> NearCells:
    """Prepare a map for spheres of a radius [m] at most.

    Raises:
        ValueError: the cells are far smaller than the spheres.
    """
    reach = max(1, int(np.ceil(radius / grid.resolution * (1 - 1e-6))))
    flat = 0 if grid.planar else reach
    if (count := (2 * reach + 1) ** 2 * (2 * flat + 1)) > _MOST:
        raise ValueError(
            f"the map's cells of {grid.resolution:g} m are too small for a robot with parts of "
            f"{radius:g} m: {count} cells to look at; join them with nrp_jax.homes.grid.coarsened"
        )
    solid = np.pad(grid.occupied, [(reach, reach), (reach, reach), (flat, flat)])
    shape = grid.occupied.shape
    offsets = list(itertools.product(*[range(2 * r + 1) for r in (reach, reach, flat)]))
    bits = np.zeros((*shape, -(-len(offsets) // _WORD)), np.uint32)
    for k, (i, j, m) in enumerate(offsets):
        part = solid[i : i + shape[0], j : j + shape[1], m : m + shape[2]]
        bits[..., k // _WORD] |= part.astype(np.uint32) << np.uint32(k % _WORD)
    return NearCells(
        bits=jnp.asarray(bits),
        bottom=jnp.float32(grid.origin[2]),
        cell=jnp.float32(grid.resolution),
        slack=jnp.float32(4 * np.finfo(np.float32).eps * (grid.size.max() + 1)),
        reach=reach,
    )


def occupied_cells(near: NearCells) -> np.ndarray:
    """Which cells (X, Y, Z) of the map are solid."""
    # Of the near cells the middle one is the cell itself.
    own = ((2 * near.reach + 1) ** (2 if near.is_planar else 3)) // 2
    word, bit = divmod(own, _WORD)
    return ((np.asarray(near.bits[..., word]) >> np.uint32(bit)) & 1).astype(bool)


def touches(near: NearCells, points: jax.Array, radius: jax.Array) -> jax.Array:
    """Whether spheres touch a solid cell, (n,) bool; beside the map all is solid.

    Args:
        near: from :func:`make_near_cells`, for radii as large as these.
        points: (3, n) centers, x and y from the corner of the map [m].
        radius: (n,) [m], or one for all.
    """
    shape = near.bits.shape
    # Axis by axis: the flat index of the cell around the center, and the squared gaps between the
    # center and the near cells along the axis, in cells.
    reaching = (radius + near.slack) / near.cell
    index, gaps, beside = jnp.int32(0), [], jnp.zeros(points.shape[1], bool)
    for axis in range(2 if near.is_planar else 3):
        along = (points[axis] - (near.bottom if axis == 2 else 0)) / near.cell
        if axis < 2:  # beside the map all is solid, at any height
            beside |= (along <= reaching) | (along >= shape[axis] - reaching)
        own = jnp.clip(jnp.floor(along), 0, shape[axis] - 1)
        index = index * shape[axis] + own.astype(jnp.int32)
        inside = along - own
        offsets = range(-near.reach, near.reach + 1)
        gaps.append([jnp.maximum(jnp.maximum(o - inside, inside - o - 1), 0) ** 2 for o in offsets])
    words = near.bits.reshape(-1, shape[3])[index]
    # Without the barrier XLA's CPU fusions compute all this once for every near cell.
    gaps, words, squared = jax.lax.optimization_barrier((gaps, words, reaching**2))
    # The near cells that the sphere reaches, as bits, in the order of ``make_near_cells``.
    reached = [jnp.uint32(0)] * shape[3]
    for k, gap in enumerate(itertools.product(*gaps)):
        bit = jnp.where(sum(gap) <= squared, jnp.uint32(1 << k % _WORD), jnp.uint32(0))
        reached[k // _WORD] |= bit
    hits = [(own & word) != 0 for own, word in zip(reached, words.T, strict=True)]
    return functools.reduce(jnp.logical_or, hits, beside)
