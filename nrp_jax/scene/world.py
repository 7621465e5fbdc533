"""A robot in a home: build its world, and ask whether configurations are free.

The world of a base that slides is :class:`nrp_jax.scene.grid_world.GridWorld`, that of a base that
drives like a car :class:`nrp_jax.scene.car_world.CarWorld`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene.car_world import CarWorld
from nrp_jax.scene.field import make_field
from nrp_jax.scene.grid_world import GridWorld, RoundBase
from nrp_jax.scene.near_cells import make_near_cells
from nrp_jax.scene.robots import MobileRobot
from vrrt_jax.core.fields import check_loaded
from vrrt_jax.core.precision import single_precision
from vrrt_jax.robots.kinematics import Chain, Spheres, placement

ARM_WEIGHT = {"snake": 0.167, "fetch": 0.125}  # of the paper's metrics [m/rad]
RESOLUTION = {"snake": 0.1, "fetch": 0.2}  # sub-steps of the paper [m] and [rad]
TURNING_RADIUS = 0.1  # of the Fetch's base [m]


@single_precision
def is_free(world: GridWorld, q: jax.Array) -> jax.Array:
    """Whether ``q`` (D,) touches no solid cell, not the floor, nor the robot itself, () bool.

    Joint limits are not checked; beside the map all is solid. Pure and vmappable. This is
    ``world.is_free``, so that a subclass that overrides it is obeyed.
    """
    return world.is_free(q)


# Of q (n, D), for the host.
batch_is_free = single_precision(jax.jit(jax.vmap(is_free, (None, 0))))


@single_precision
def build_world(
    robot: MobileRobot,
    grid: Grid,
    *,
    wrap: bool = True,
    resolution: float | None = None,
    arm_weight: float | None = None,
    turning_radius: float = TURNING_RADIUS,
) -> GridWorld:
    """Put a robot into a home.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: from :func:`nrp_jax.load_map` or a generator; the snake sees its planar map.
        wrap: joints without limits turn the short way round; otherwise they are intervals, as in
            the paper. A heading always wraps.
        resolution: longest sub-step of any joint between two collision checks [m] or [rad]; the
            paper's by default.
        arm_weight: meters that a radian of the arm counts for in the metric; the paper's by
            default.
        turning_radius: smallest one of a base that drives like a car [m].

    Raises:
        ValueError: a planar map for a robot that is not, or a setting that is not positive.
    """
    check_loaded(robot, "the robot", "nrp_jax.load_robot")
    check_loaded(grid, "the map", "nrp_jax.load_map")
    resolution = RESOLUTION[robot.name] if resolution is None else resolution
    arm_weight = ARM_WEIGHT[robot.name] if arm_weight is None else arm_weight
    for name, value in (
        ("resolution", resolution),
        ("arm_weight", arm_weight),
        ("turning_radius", turning_radius),
    ):
        if not value > 0:
            raise ValueError(f"{name} is {value}; expected a positive number, such as 0.1")
    grid = _fitting(robot.planar, grid)
    # Spheres in groups: larger ones have to look at more cells around them.
    radius = np.asarray(robot.collision_spheres.radius)
    reach = np.ceil(radius / grid.resolution * (1 - 1e-6))
    order = np.argsort(reach, kind="stable")
    spheres = jax.tree.map(lambda a: np.asarray(a)[order], robot.collision_spheres)
    # Only the arm must stay above the floor: the base and the torso stand on it.
    is_arm = spheres.link > robot.base_dim + 1
    floor = np.where(is_arm & (not robot.planar), spheres.radius, -np.inf)
    # The base may be anywhere on the map, with any heading.
    turn = [np.pi] * (robot.base_dim - 2)
    is_base = np.arange(robot.num_joints) < robot.base_dim
    corner = np.array(grid.origin[:2])
    fields = {
        "chain": robot.chain,
        "collision_spheres": _placement(spheres, robot.chain),
        "collision_radius": _float(spheres.radius),
        "floor": _float(floor),
        "planar_boxes": robot.planar_boxes,
        "shapes": robot.shapes,
        "base": _round_base(robot, grid, np.asarray(spheres.link)),
        "near": tuple(make_near_cells(grid, radius[reach == r].max()) for r in np.unique(reach)),
        "groups": tuple(np.unique(reach, return_counts=True)[1].tolist()),
        "field": make_field(grid),
        "corner": _split(corner),
        "lower": _float(np.concatenate([corner, np.negative(turn), robot.lower])),
        "upper": _float(np.concatenate([corner + grid.size[:2], turn, robot.upper])),
        "is_continuous": robot.is_continuous & (is_base | wrap),
        "arm_weight": jnp.float32(arm_weight),
        "resolution": jnp.float32(resolution),
    }
    if robot.base_dim == 2:
        return GridWorld(**fields)
    return CarWorld(**fields, radius=jnp.float32(turning_radius))


@single_precision
def with_grid(world: GridWorld, grid: Grid) -> GridWorld:
    """The same robot in another home; nothing re-compiles if the maps are of one size.

    Raises:
        ValueError: a planar map for a robot that is not.
    """
    grid = _fitting(world.field.values.shape[2] == 1, grid)
    corner = np.array(grid.origin[:2])
    base = world.base
    if base is not None:
        low = grid.flatten(0.0, float(base.height))
        base = dataclasses.replace(base, near=make_near_cells(low, float(base.radius)))
    # The largest radius of each group of spheres.
    ends = np.cumsum(world.groups)
    radius = [part.max() for part in np.split(np.asarray(world.collision_radius), ends[:-1])]
    return dataclasses.replace(
        world,
        base=base,
        near=tuple(make_near_cells(grid, float(r)) for r in radius),
        field=make_field(grid),
        corner=_split(corner),
        lower=world.lower.at[:2].set(corner),
        upper=world.upper.at[:2].set(corner + grid.size[:2]),
    )


def from_corner(world: GridWorld) -> GridWorld:
    """The same world with its map's corner at the origin.

    Planners work in it: far from the origin float32 has no digits left for a robot.
    """
    size = (jnp.array(world.field.values.shape[:2]) - 1) * world.field.step
    size = size - 2 * world.field.resolution  # the field has a rim of one cell
    return dataclasses.replace(
        world,
        corner=jnp.zeros_like(world.corner),
        lower=world.lower.at[:2].set(0.0),
        upper=world.upper.at[:2].set(size),
    )


def corner_of(world: GridWorld) -> np.ndarray:
    """The corner (2,) of a world's map, in float64 [m]."""
    return np.asarray(world.corner, np.float64).sum(axis=0)


def _fitting(planar: bool, grid: Grid) -> Grid:
    if planar:
        return grid.flatten()
    if grid.planar:
        raise ValueError(
            "this robot needs a map with heights, but this one is planar: shape "
            f"{grid.occupied.shape}; load a 3D map, or plan for the snake"
        )
    return grid


def _round_base(robot: MobileRobot, grid: Grid, sphere_link: np.ndarray) -> RoundBase | None:
    footprint, shapes = robot.footprint, robot.shapes
    if footprint is None or shapes is None:
        return None
    is_arm = np.array(shapes.link) > robot.base_dim + 1
    is_boxed = np.isin(sphere_link, shapes.box_link)
    low = grid.flatten(0.0, float(footprint.height))
    return RoundBase(
        near=make_near_cells(low, float(footprint.radius)),
        radius=footprint.radius,
        height=footprint.height,
        link=footprint.link,
        capsules=tuple(np.flatnonzero(is_arm).tolist()),
        spheres=tuple(np.flatnonzero(is_boxed).tolist()),
    )


def _split(corner: np.ndarray) -> jax.Array:
    """A place (2,) as two of float32, (2, 2), which sum up to it."""
    near = corner.astype(np.float32)
    return jnp.asarray(np.stack([near, corner - near]), jnp.float32)


def _placement(spheres: Spheres, chain: Chain) -> jax.Array:
    matrix = placement(np.asarray(spheres.link), np.asarray(spheres.center), chain.num_links)
    return _float(matrix)


def _float(array: np.ndarray) -> jax.Array:
    return jnp.asarray(array, jnp.float32)
