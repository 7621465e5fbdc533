"""Robot and obstacles as arrays, and the question every planner asks: is this configuration free?

Obstacles live in slots, so that moving, adding or removing them never re-compiles. Distances are
exact and smooth, whereas MJX's collision functions give only a sign for boxes and cost many times
as much; :mod:`vrrt_jax.scene.mjx` checks one against the other.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.edges import StraightLineEdges
from vrrt_jax.core.types import TraceIgnoredNames, pytree, static
from vrrt_jax.robots.kinematics import Chain, Spheres, link_poses, place, placement
from vrrt_jax.scene.obstacles import (
    HALF_SPACE,
    Obstacle,
    Obstacles,
    floats,
    signed_distances,
    to_slots,
)


@pytree
class World(StraightLineEdges):
    """All that planners ask about robot and obstacles."""

    chain: Chain
    collision_spheres: (
        jax.Array
    )  # (L * 12, 3 n) placement of the covering spheres, against obstacles
    collision_radius: jax.Array  # (n,) [m]
    self_collision_spheres: (
        jax.Array
    )  # (L * 12, 3 m) placement of the thinner spheres, against each other
    contact_distance: (
        jax.Array
    )  # (m, m) distance at which two of them touch, 0 for pairs not checked [m]
    obstacles: Obstacles
    lower: jax.Array  # (D,)
    upper: jax.Array  # (D,)
    is_continuous: jax.Array  # (D,) bool, joints that turn for ever
    margin: jax.Array  # () clearance asked of obstacles [m]
    resolution: jax.Array  # () longest sub-step of an edge between two checks [rad]
    joint_names: TraceIgnoredNames = static()
    obstacle_names: TraceIgnoredNames = static()  # (K,) '' in empty slots
    kinds: TraceIgnoredNames = static()  # (K,)
    colors: TraceIgnoredNames = static()  # (K,)

    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`is_free`."""
        return is_free(self, q)


def obstacle_clearance(world: World, q: jax.Array) -> jax.Array:
    """Distance () [m] of the covering spheres at ``q`` (D,) to the nearest obstacle."""
    return _clearance(world, link_poses(world.chain, q))


def is_free(world: World, q: jax.Array) -> jax.Array:
    """Whether ``q`` (D,) touches neither an obstacle nor itself, () bool; limits are not looked at.

    Pure and vmappable; fast inside any ``jit``.
    """
    poses = link_poses(world.chain, q)
    return (_clearance(world, poses) > world.margin) & (_self_gap(world, poses) >= 0)


batch_is_free = jax.jit(jax.vmap(is_free, (None, 0)))  # of q (n, D), for the host


def _clearance(world: World, poses: jax.Array) -> jax.Array:
    distances = signed_distances(world.obstacles, place(world.collision_spheres, poses))
    return jnp.min(distances - world.collision_radius[:, None])


def _self_gap(world: World, poses: jax.Array) -> jax.Array:
    """Smallest difference () of squared distance and squared reach [m^2]."""
    centers = place(world.self_collision_spheres, poses)
    apart = sum((axis[:, None] - axis[None]) ** 2 for axis in centers)
    return jnp.min(
        apart - world.contact_distance**2, initial=jnp.inf
    )  # few links have no pair to check


def build_world(
    robot: Any,
    obstacles: Sequence[Obstacle] = (),
    *,
    num_slots: int = 16,
    margin: float = 0.0,
    resolution: float = 0.02,
) -> World:
    """Put a robot among obstacles.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        obstacles: what stands around it.
        num_slots: room for obstacles; raised to the next multiple of 8 that holds them all. Worlds
            of one robot with as many slots share their compiled functions.
        margin: clearance asked of obstacles [m].
        resolution: longest step between two collision checks on an edge [rad].

    Raises:
        ValueError: an obstacle of an unsupported kind, or a number out of range.
    """
    if not (np.isfinite(margin) and margin >= 0 and np.isfinite(resolution) and resolution > 0):
        raise ValueError(
            f"margin={margin} and resolution={resolution}: expected margin >= 0 m and "
            "resolution > 0 rad"
        )
    reach = np.zeros((len(robot.self_collision_spheres.radius),) * 2, np.float32)
    thin_radius = np.asarray(robot.self_collision_spheres.radius)
    first, second = np.asarray(robot.self_collision_pairs, int).reshape(-1, 2).T
    reach[first, second] = thin_radius[first] + thin_radius[second]
    num_slots = 8 * max(-(-num_slots // 8), -(-len(obstacles) // 8), 1)
    world = World(
        chain=robot.chain,
        collision_spheres=_placement(robot.collision_spheres, robot.chain),
        collision_radius=robot.collision_spheres.radius,
        self_collision_spheres=_placement(robot.self_collision_spheres, robot.chain),
        contact_distance=jnp.asarray(reach),
        obstacles=to_slots([], num_slots),
        lower=jnp.asarray(robot.lower, jnp.float32),
        upper=jnp.asarray(robot.upper, jnp.float32),
        is_continuous=jnp.asarray(robot.is_continuous, bool),
        margin=jnp.float32(margin),
        resolution=jnp.float32(resolution),
        joint_names=TraceIgnoredNames(robot.joint_names),
        obstacle_names=TraceIgnoredNames([""] * num_slots),
        kinds=TraceIgnoredNames([""] * num_slots),
        colors=TraceIgnoredNames([()] * num_slots),
    )
    return with_obstacles(world, obstacles)


def with_obstacles(world: World, obstacles: Sequence[Obstacle]) -> World:
    """The same robot among other obstacles; nothing re-compiles.

    Raises:
        ValueError: more obstacles than slots, a name used twice, an unsupported kind or a size that
            is not positive.
    """
    num_slots = len(world.obstacles.rounding)
    if len(obstacles) > num_slots:
        raise ValueError(
            f"{len(obstacles)} obstacles do not fit into {num_slots} slots; build the world with "
            f"num_slots={len(obstacles)} or more"
        )
    names = [o.name for o in obstacles]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"obstacle names must differ, but {twice} stand more than once; rename")
    spare = num_slots - len(obstacles)
    return dataclasses.replace(
        world,
        obstacles=to_slots(obstacles, num_slots),
        obstacle_names=TraceIgnoredNames(names + [""] * spare),
        kinds=TraceIgnoredNames([o.kind for o in obstacles] + [""] * spare),
        colors=TraceIgnoredNames([o.rgba for o in obstacles] + [()] * spare),
    )


def with_margin(world: World, margin: float) -> World:
    """The same world, where the robot keeps ``margin`` [m] farther from obstacles and itself."""
    reach = jnp.where(world.contact_distance > 0, world.contact_distance + margin, 0.0)
    return dataclasses.replace(world, margin=world.margin + margin, contact_distance=reach)


def obstacle_list(world: World) -> list[Obstacle]:
    """The obstacles in the world's slots, as the host sees them."""
    slots = jax.tree.map(np.asarray, world.obstacles)
    found = []
    for k, (name, kind) in enumerate(zip(world.obstacle_names, world.kinds, strict=True)):
        if not kind:
            continue
        half, rounding, quaternion = slots.half[k], float(slots.rounding[k]), np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, slots.rotation[k].astype(np.float64).ravel())
        position = slots.position[k]
        if kind == "plane":
            position = position + HALF_SPACE * slots.rotation[k][:, 2]
        size = {
            "sphere": (rounding, 0.0, 0.0),
            "box": half,
            "capsule": (rounding, half[2], 0.0),
            "cylinder": (half[0], half[2], 0.0),
            "plane": (0.0, 0.0, 1.0),
        }[kind]
        found.append(
            Obstacle(
                name=name,
                kind=kind,
                position=floats(position),
                quaternion=floats(quaternion),
                size=floats(size),
                rgba=world.colors[k],
            )
        )
    return found


def move_obstacle(
    world: World,
    name: str,
    *,
    position: Sequence[float] | None = None,
    quaternion: Sequence[float] | None = None,
    size: Sequence[float] | None = None,
) -> World:
    """Move, turn or resize one obstacle; nothing re-compiles.

    Args:
        world: robot and obstacles.
        name: of the obstacle.
        position: (3,) of its center in the world [m].
        quaternion: (4,) its turn in the world, w first.
        size: up to (3,) as MuJoCo's geom size: radius and half lengths [m].

    Raises:
        ValueError: no obstacle of that name.
    """
    obstacles = obstacle_list(world)
    if name not in [o.name for o in obstacles]:
        raise ValueError(f"no obstacle named '{name}'; the world has {[o.name for o in obstacles]}")
    changes = {"position": position, "quaternion": quaternion, "size": size}
    changes = {k: floats(v) for k, v in changes.items() if v is not None}
    if "size" in changes:
        changes["size"] = (*changes["size"], 0.0, 0.0)[:3]
    return with_obstacles(
        world, [dataclasses.replace(o, **changes) if o.name == name else o for o in obstacles]
    )


def _placement(spheres: Spheres, chain: Chain) -> jax.Array:
    matrix = placement(np.asarray(spheres.link), np.asarray(spheres.center), chain.num_links)
    return jnp.asarray(matrix)


def overrides_is_free(world: World) -> bool:
    """Whether a subclass has an ``is_free`` of its own, which the exact check does not know."""
    return type(world).is_free is not World.is_free
