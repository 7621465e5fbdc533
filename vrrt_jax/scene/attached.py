"""Attach an object to the hand, so that it moves with it and is checked as a part of the robot."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.precision import single_precision
from vrrt_jax.robots.bodies import body_pose, moving_body
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.held import Grip, HeldObject, HeldSpheres
from vrrt_jax.scene.held_cover import corners, cover
from vrrt_jax.scene.obstacles import Obstacle, check_obstacle, floats, signed_distances, to_slots
from vrrt_jax.scene.world import (
    World,
    batch_is_free,
    held_names,
    no_such_obstacle,
    obstacle_list,
    with_obstacles,
)

DEEPEST = 0.015  # [m] how deep an object may be in an obstacle that it is gripped on
TOLERANCE = 1e-3  # [m] how much deeper it may be from then on
_ROUNDING = 1e-4  # [m] of the distances of spheres where the object is gripped


@single_precision
def attach(
    world: World,
    obstacle: str | Obstacle,
    link: str,
    *,
    q: Sequence[float] | np.ndarray | None = None,
) -> World:
    """Let the robot hold an object: it moves with a link from now on.

    The object is checked against all obstacles, against all other links of the robot, and against
    what these hold. It may touch whatever the same joint carries: the hand and its fingers.

    The planner sees spheres around the object: 24 at most that stick out of it by 1 cm, of objects
    that are larger than a hand by up to 3 cm, and around large plates more of them.
    ``world.attached[-1].bulge`` says how far. The exact check sees the object itself.

    An object often stands on something where it is gripped, and is modeled to sink in a little. So
    from then on the object may be as deep in each obstacle as it was at ``q``, and 1 mm more. That
    goes for the exact check. The planner lets each sphere be as near to each obstacle as it was at
    ``q``, even within a margin, and checks the object's corners where spheres stuck out into
    something there. An obstacle that the object is in by more than 15 mm at ``q`` gets
    nothing of this: the object is in collision there.

    The number of spheres is a part of the compiled program, in multiples of eight: attaching may
    compile once.

    Args:
        world: from :func:`vrrt_jax.build_world`.
        obstacle: the name of an obstacle, which leaves the world, or an object of its own. It is a
            sphere, a box, a capsule or a cylinder.
        link: a moving body of the robot, such as "hand".
        q: (D,) the configuration at which the object is gripped where it stands [rad] or [m]. With
            None, the pose of an :class:`Obstacle` is in the frame of ``link``, and it has no
            support.

    Raises:
        ValueError: there is no such obstacle or link, the link does not move, the name is taken,
            the object is a plane, or ``q`` is missing or malformed.
    """
    obstacles = obstacle_list(world)
    if isinstance(obstacle, str):
        found = [other for other in obstacles if other.name == obstacle]
        if not found:
            raise ValueError(no_such_obstacle(world, obstacle))
        if q is None:
            raise ValueError(f"'{obstacle}' stands in the world; give q, where it is gripped")
        (obstacle,) = found
        obstacles = [other for other in obstacles if other is not obstacle]
    elif obstacle.name in [other.name for other in obstacles] + held_names(world):
        raise ValueError(
            f"'{obstacle.name}' is the name of an obstacle already; expected another name, or the "
            "name itself to attach that obstacle"
        )
    check_obstacle(obstacle)
    held = _held(world, obstacles, obstacle, link, q)
    world = with_obstacles(world, obstacles)
    return world.holding([*world.attached, held])


@single_precision
def detach(world: World, name: str, *, q: Sequence[float] | np.ndarray | None = None) -> World:
    """Let go of an object that :func:`attach` gave to the robot.

    Args:
        world: robot and obstacles.
        name: of the object.
        q: (D,) where the robot lets go [rad] or [m]: the object is an obstacle from then on. With
            None it is gone.

    Raises:
        ValueError: the robot holds nothing of that name, there is no free slot for the obstacle, or
            ``q`` is malformed.
    """
    if name not in held_names(world):
        raise ValueError(f"the robot holds no '{name}'; it holds {held_names(world)}")
    (held,) = (held for held in world.attached if held.obstacle.name == name)
    bare = world.holding([other for other in world.attached if other is not held])
    if q is None:
        return bare
    pose = body_pose(world.robot.value, held.body, _checked(world, q)) @ pose_of(held.obstacle)
    return with_obstacles(bare, [*obstacle_list(bare), _placed(held.obstacle, pose)])


def touching_spheres(world: World, q: np.ndarray) -> list[str]:
    """Words for held objects of which only the covering spheres touch something at ``q`` (D,)."""
    return [
        f"the spheres around {held.obstacle.name}, which stick out of it by "
        f"{1e3 * held.bulge:.0f} mm, touch something"
        for held in world.attached
        if bool(batch_is_free(detach(world, held.obstacle.name), jnp.asarray(q)[None])[0])
    ]


def _held(
    world: World, obstacles: Sequence[Obstacle], obstacle: Obstacle, body: str, q: Any
) -> HeldObject:
    """An object held by a body among other obstacles."""
    link, in_link = moving_body(world.robot.value, body)
    if q is not None:
        hand = body_pose(world.robot.value, body, _checked(world, q))
        obstacle = _placed(obstacle, np.linalg.inv(hand) @ pose_of(obstacle))
    around = cover(obstacle.kind, (*floats(obstacle.size), 0.0, 0.0)[:3])
    spheres = _on_link(link, in_link @ pose_of(obstacle), around.center, around.radius)
    held = HeldObject(obstacle=obstacle, body=body, spheres=spheres, bulge=around.bulge)
    if q is None:
        return held
    to_world = hand @ np.linalg.inv(in_link)
    grip = _grip(world, obstacles, held, to_world, np.asarray(q, np.float64))
    return dataclasses.replace(held, grip=grip)


def _grip(
    world: World,
    obstacles: Sequence[Obstacle],
    held: HeldObject,
    to_world: np.ndarray,
    q: np.ndarray,
) -> Grip | None:
    """What is near a held object at ``q`` (D,), None if nothing is.

    Args:
        world: of the robot.
        obstacles: without the object.
        held: the object.
        to_world: (4, 4) pose of its link at ``q``.
        q: (D,) where it is gripped.
    """
    scene = exact_scene(world.robot.value, obstacles, geometry="spheres", attached=[held])
    depths = scene.depths(held.obstacle.name, q)
    beside = [other for other in obstacles if depths.get(other.name, 0.0) <= DEEPEST]
    if not beside:
        return None
    # How near the spheres are to these obstacles. Those that stick out into one may do so again.
    own = held.spheres
    distances = _distances(beside, to_world, own.center)
    is_cut = (distances < own.radius[:, None]).any(axis=1)
    # They contain the object no more on that side: its corners there are checked beside them.
    in_object, radius = corners(held.obstacle.kind, held.obstacle.size)
    link, in_link = moving_body(world.robot.value, held.body)
    found = _on_link(link, in_link @ pose_of(held.obstacle), in_object, radius)
    apart = np.linalg.norm(found.center[:, None] - own.center[is_cut], axis=-1)
    is_bare = (apart <= own.radius[is_cut] + TOLERANCE).any(axis=1)
    found = HeldSpheres(
        link=found.link[is_bare], center=found.center[is_bare], radius=found.radius[is_bare]
    )
    distances = np.concatenate([distances, _distances(beside, to_world, found.center)])
    return Grip(
        corners=found,
        distances={
            other.name: column - _ROUNDING
            for other, column in zip(beside, distances.T, strict=True)
        },
        supports={
            name: depth + TOLERANCE
            for name, depth in depths.items()
            if -TOLERANCE < depth <= DEEPEST
        },
    )


def _on_link(
    link: int, in_link: np.ndarray, centers: np.ndarray, radius: np.ndarray | float
) -> HeldSpheres:
    """Spheres on a link, of centers (n, 3) in a frame whose pose (4, 4) in the link is given."""
    return HeldSpheres(
        link=np.full(len(centers), link),
        center=_moved(in_link, centers),
        radius=np.broadcast_to(radius, len(centers)),
    )


def _moved(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _distances(
    obstacles: Sequence[Obstacle], to_world: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Distances (n, K) of points (n, 3) in a frame that has a pose (4, 4) to obstacles [m]."""
    slots = to_slots(obstacles, len(obstacles))
    centers = jnp.asarray(_moved(to_world, points).T, jnp.float32)
    return np.asarray(signed_distances(slots, centers).T, np.float64)


def _checked(world: World, q: Any) -> np.ndarray:
    """The configuration as numbers (D,)."""
    q = np.asarray(q, np.float64)
    if q.shape != (len(world.joint_names),) or not np.isfinite(q).all():
        raise ValueError(
            f"q is {q}; expected {len(world.joint_names)} finite numbers, for the joints "
            f"{', '.join(world.joint_names)}"
        )
    return q


def pose_of(obstacle: Obstacle) -> np.ndarray:
    """Position and quaternion as a pose (4, 4)."""
    pose, rotation = np.eye(4), np.zeros(9)
    quaternion = np.asarray(obstacle.quaternion, np.float64)
    mujoco.mju_quat2Mat(rotation, quaternion / np.linalg.norm(quaternion))
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), obstacle.position
    return pose


def _placed(obstacle: Obstacle, pose: np.ndarray) -> Obstacle:
    """The same with another pose (4, 4)."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, pose[:3, :3].ravel())
    return dataclasses.replace(
        obstacle, position=floats(pose[:3, 3]), quaternion=floats(quaternion)
    )
