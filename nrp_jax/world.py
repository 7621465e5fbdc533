"""A robot in a home: covering spheres against the distance field of an occupancy grid.

The field holds exact distances to the solid cells at the points of a lattice. Between them the
distance changes no faster than one moves, so ``field - offset`` never promises more room than there
is: no collision of a covering sphere is missed.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from nrp_jax.grid import Grid
from nrp_jax.robots import MobileRobot
from vrrt_jax.core.edges import Straight, joint_steps
from vrrt_jax.core.kinematics import Chain, link_poses, place, placement
from vrrt_jax.core.types import Spheres, pytree

ARM_WEIGHT = {"snake": 0.167, "fetch": 0.125}  # of the paper's metrics
RESOLUTION = {"snake": 0.1, "fetch": 0.2}  # sub-steps of the paper [m] and [rad]


@pytree
class GridWorld(Straight):
    """What planners ask about a robot on a sliding base in a home; edges are straight.

    An edge's length is that of the base's way plus ``arm_weight`` times that of the arm's; its
    sub-steps move no joint by more than ``resolution``.
    """

    chain: Chain
    cover: jax.Array  # (L * 12, 3 n) placement of the covering spheres
    cover_radius: jax.Array  # (n,) [m]
    thin: jax.Array  # (L * 12, 3 m) placement of the spheres checked against each other
    reach: jax.Array  # (m, m) distance at which two of them touch, 0 for pairs not checked [m]
    field: jax.Array  # (X', Y', Z') distance to the nearest solid cell at lattice points [m]
    field_origin: jax.Array  # (3,) position of the first lattice point [m]
    field_step: jax.Array  # () between lattice points [m]
    lower: jax.Array  # (D,)
    upper: jax.Array  # (D,)
    wraps: jax.Array  # (D,) bool
    arm_weight: jax.Array  # () metres a radian of the arm counts for
    resolution: jax.Array  # () longest sub-step of any joint [m] or [rad]

    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`is_free`."""
        return is_free(self, q)

    def interpolate(self, q_a: jax.Array, q_b: jax.Array, fraction: jax.Array) -> jax.Array:
        """Configurations (..., D) at a fraction (...) of the edges between others (..., D)."""
        part = self.part(self.edge(q_a, q_b), jnp.asarray(fraction))
        return self.normalise(self.end(q_a, part))

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        base, arm = jnp.zeros((2, q.shape[0], nodes.shape[0]), q.dtype)
        for joint in range(q.shape[1]):
            squared = joint_steps(self, nodes, q, joint) ** 2
            base, arm = (base + squared, arm) if joint < 2 else (base, arm + squared)
        length = jnp.sqrt(base) + self.arm_weight * jnp.sqrt(arm)
        return jnp.where(among, length, jnp.inf)

    def length(self, edge: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        base, arm = (jnp.sqrt(jnp.sum(s**2, -1)) for s in (edge[..., :2], edge[..., 2:]))
        return base + self.arm_weight * arm

    def steer(self, q_from: jax.Array, target: jax.Array, num_steps: int) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        edge = self.edge(q_from, jnp.clip(target, self.lower, self.upper))
        longest = jnp.max(jnp.abs(edge), axis=-1)
        return self.part(
            edge, jnp.minimum(1.0, num_steps * self.resolution / jnp.maximum(longest, 1e-9))
        )

    def checkable(self, edge: jax.Array, num_steps: int) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return jnp.max(jnp.abs(edge), axis=-1) <= num_steps * self.resolution * (1 + 1e-5)


def is_free(world: GridWorld, q: jax.Array) -> jax.Array:
    """Whether ``q`` (D,) touches neither a solid cell nor itself, () bool.

    Joint limits are not looked at; outside the map all is solid. Pure and vmappable.
    """
    poses = link_poses(world.chain, q)
    centres = place(world.thin, poses)
    apart = sum((axis[:, None] - axis[None]) ** 2 for axis in centres)
    clear = jnp.all(apart >= world.reach**2)
    return clear & jnp.all(clearance_at(world, place(world.cover, poses)) > world.cover_radius)


batch_is_free = jax.jit(jax.vmap(is_free, (None, 0)))  # of q (n, D), for the host


def clearance_at(world: GridWorld, points: jax.Array) -> jax.Array:
    """A lower bound (n,) of the distance from points (3, n) to the nearest solid cell [m]."""
    shape = world.field.shape
    place = (points - world.field_origin[:, None]) / world.field_step
    index, squared = jnp.int32(0), 0.0
    for axis in range(2 if shape[2] == 1 else 3):
        near = jnp.clip(jnp.round(place[axis]), 0, shape[axis] - 1)
        # Beyond the top and the bottom nothing is solid, and points there are farther still.
        along = place[axis] if axis < 2 else jnp.clip(place[axis], 0, shape[axis] - 1)
        squared += (along - near) ** 2
        index = index * shape[axis] + near.astype(jnp.int32)
    return world.field.reshape(-1)[index] - world.field_step * jnp.sqrt(squared)


def build_world(
    robot: MobileRobot, grid: Grid, *, wrap: bool = True, resolution: float | None = None
) -> GridWorld:
    """Put a robot into a home.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: from :func:`nrp_jax.load_map` or a generator; the snake sees its planar map.
        wrap: joints without limits turn the short way round; otherwise they are intervals.
        resolution: longest sub-step of any joint between two collision checks [m] or [rad].

    Raises:
        ValueError: a planar map for a robot that is not, or a resolution that is not positive.
    """
    resolution = RESOLUTION[robot.name] if resolution is None else resolution
    if not resolution > 0:
        raise ValueError(f"resolution is {resolution}; expected a positive number, such as 0.1")
    reach = np.zeros((len(robot.thin.radius),) * 2, np.float32)
    radius, (first, second) = np.asarray(robot.thin.radius), np.asarray(robot.pairs).T
    reach[first, second] = radius[first] + radius[second]
    grid = _fitting(robot.planar, grid)
    low, high = _limits(robot, grid)
    return GridWorld(
        chain=robot.chain,
        cover=_placement(robot.cover, robot.chain),
        cover_radius=robot.cover.radius,
        thin=_placement(robot.thin, robot.chain),
        reach=jnp.asarray(reach),
        **_field(grid),
        lower=low,
        upper=high,
        wraps=robot.wraps & wrap,
        arm_weight=jnp.float32(ARM_WEIGHT[robot.name]),
        resolution=jnp.float32(resolution),
    )


def with_grid(world: GridWorld, grid: Grid) -> GridWorld:
    """The same robot in another home; nothing re-compiles if the maps are of one size.

    Raises:
        ValueError: a planar map for a robot that is not.
    """
    grid = _fitting(world.field.shape[2] == 1, grid)
    low = np.array(grid.origin[:2])
    return dataclasses.replace(
        world,
        **_field(grid),
        lower=world.lower.at[:2].set(low),
        upper=world.upper.at[:2].set(low + grid.size[:2]),
    )


def sample_configurations(world: GridWorld, key: jax.Array, n: int) -> jax.Array:
    """Uniform configurations (n, D) inside the limits."""
    shape = (n, world.lower.shape[0])
    return jax.random.uniform(key, shape, minval=world.lower, maxval=world.upper)


def _fitting(planar: bool, grid: Grid) -> Grid:
    if planar:
        return grid.flatten()
    if grid.planar:
        raise ValueError(
            "this robot needs a map with heights, but this one is planar: shape "
            f"{grid.occupied.shape}; load a 3D map, or plan for the snake"
        )
    return grid


def _limits(robot: MobileRobot, grid: Grid) -> tuple[jax.Array, jax.Array]:
    turn = [np.pi] * (robot.base_dim - 2)
    low = np.array(grid.origin[:2])
    lower = np.concatenate([low, np.negative(turn), np.asarray(robot.lower)])
    upper = np.concatenate([low + grid.size[:2], turn, np.asarray(robot.upper)])
    return jnp.asarray(lower, jnp.float32), jnp.asarray(upper, jnp.float32)


def _field(grid: Grid) -> dict[str, jax.Array]:
    """Distances at a lattice ``fine`` times as dense as the cells, whose corners belong to it.

    The nearest point of a cell to a lattice point is a lattice point too, so the distance transform
    of the lattice is exact.
    """
    fine = 4 if grid.planar else 2
    solid = np.pad(grid.occupied, [(1, 1), (1, 1), (0, 0)], constant_values=True)
    for axis in range(2 if grid.planar else 3):
        solid = _refine(solid, fine, axis)
    step = grid.resolution / fine
    distance = ndimage.distance_transform_edt(~solid, sampling=step)
    origin = np.array(grid.origin) - grid.resolution * np.array([1, 1, 0])
    return {
        "field": jnp.asarray(distance, jnp.float32),
        "field_origin": jnp.asarray(origin, jnp.float32),
        "field_step": jnp.float32(step),
    }


def _refine(solid: np.ndarray, fine: int, axis: int) -> np.ndarray:
    """From n cells along an axis to n * fine + 1 lattice points; borders are solid if a side is."""
    solid = np.moveaxis(solid, axis, 0)
    points = np.zeros((solid.shape[0] * fine + 1, *solid.shape[1:]), bool)
    for k in range(fine + 1):
        points[k : k + len(solid) * fine : fine] |= solid
    return np.moveaxis(points, 0, axis)


def _placement(spheres: Spheres, chain: Chain) -> jax.Array:
    matrix = placement(np.asarray(spheres.link), np.asarray(spheres.centre), chain.num_links)
    return jnp.asarray(matrix)
