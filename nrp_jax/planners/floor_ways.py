"""Ways of the base over the floor: what is near for a robot that walls stop.

The nearest node as the crow flies is often behind a wall, and a tree that extends it again and
again stays there. The length of the way over the floor tells which node is near, and which waypoint
leads on. Letters: ``X Y`` cells, ``n`` places.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph

from nrp_jax.homes.houses import BODY, ERODE
from nrp_jax.learning.difficulty import floor_graph
from nrp_jax.scene.field import floor_clearance
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, corner_of
from vrrt_jax.core.types import pytree

SIDE = 0.25  # of a place, a square, at most: neighbors are never on two sides of a wall [m]
ROUND = 1024  # numbers of places are padded to multiples of this, so that few sizes compile
MOST_PLACES = 6 * ROUND  # the ways between all of them are kept, of 151 MB
FAR = 1e3  # between places that the floor does not join [m]


@pytree
class FloorWays:
    """Lengths of the shortest ways between all places of a floor."""

    place: Any  # (X, Y) i32, the one that is nearest to each square
    length: Any  # (n, n) [m]
    side: Any  # () of a square [m]
    corner: Any  # (2,) of the map [m]

    def between(self, q_from: jax.Array, q_to: jax.Array) -> jax.Array:
        """Lengths (...) of the ways between the bases of configurations (..., D) [m]."""
        return self.length[self._place_of(q_from), self._place_of(q_to)]

    def _place_of(self, q: jax.Array) -> jax.Array:
        square = jnp.floor((q[..., :2] - self.corner) / self.side).astype(jnp.int32)
        x, y = jnp.moveaxis(jnp.clip(square, 0, jnp.array(self.place.shape) - 1), -1, 0)
        return self.place[x, y]


def floor_ways(robot: MobileRobot, world: GridWorld) -> FloorWays:
    """The ways over the floor of a map; those of the last few maps are kept.

    A place is free if the base has 0.3 m of free space around it there, as high as its trunk.

    Args:
        robot: whose base it is.
        world: of this robot.

    Raises:
        ValueError: the map has no such place, or too many.
    """
    free = floor_clearance(world.field, BODY[robot.name]) > ERODE
    if not free.any():
        raise ValueError(
            f"no place of the map has {ERODE} m of free space around it: plan with nrp-connect, "
            "which needs no floor"
        )
    cell = float(world.field.resolution)
    cells = max(int(SIDE / cell + 1e-6), 1)
    side = cells * cell
    place, length = _ways(free.tobytes(), free.shape, cells, side)
    corner = jnp.asarray(corner_of(world), jnp.float32)
    return FloorWays(place=place, length=length, side=jnp.float32(side), corner=corner)


@functools.lru_cache(maxsize=8)
def _ways(
    free: bytes, shape: tuple[int, int], cells: int, side: float
) -> tuple[jax.Array, jax.Array]:
    """Places (X, Y) and lengths (n, n), of squares of so many cells along each side of them."""
    padded = np.pad(np.frombuffer(free, bool).reshape(shape), [(0, -n % cells) for n in shape])
    rows, columns = (n // cells for n in padded.shape)
    squares = padded.reshape(rows, cells, columns, cells).any(axis=(1, 3))
    if squares.sum() > MOST_PLACES:
        raise ValueError(
            f"the map has {squares.sum()} free squares of {side:g} m; expected {MOST_PLACES} at "
            "most: crop it, or plan with nrp-connect, which needs no table of ways"
        )
    index = np.full(squares.shape, -1)
    index[squares] = np.arange(squares.sum())
    length = np.minimum(csgraph.dijkstra(floor_graph(index, side)), FAR)
    more = -len(length) % ROUND
    length = np.pad(length, (0, more), constant_values=FAR)
    nearest = ndimage.distance_transform_edt(~squares, return_distances=False, return_indices=True)
    place = index[tuple(np.asarray(nearest))]
    return jnp.asarray(place, jnp.int32), jnp.asarray(length, jnp.float32)
