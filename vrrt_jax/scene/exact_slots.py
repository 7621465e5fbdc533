"""Obstacles in slots of a MuJoCo model: a robot is compiled once, and scenes are moved into it."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from vrrt_jax.scene.exact_pairs import resize_mesh
from vrrt_jax.scene.obstacle_kinds import KINDS
from vrrt_jax.scene.obstacles import Obstacle

ALL_BITS = 0x7FFFFFFF  # contact bits of obstacles that everything sees
_ROUND = 8  # room for obstacles of a kind comes in multiples of so many
_PARKED = (0.0, 0.0, -1e3)  # [m] where empty slots are


def room_for(obstacles: Sequence[Obstacle]) -> tuple[tuple[str, int], ...]:
    """How many slots of which kind hold these obstacles; few different answers."""
    kinds = [obstacle.kind for obstacle in obstacles]
    return tuple(
        (kind, _ROUND * -(-kinds.count(kind) // _ROUND)) for kind in KINDS if kind in kinds
    )


def add_slots(spec: mujoco.MjSpec, room: Sequence[tuple[str, int]], bits: int) -> None:
    """Add a body with one geom for every slot.

    Args:
        spec: of the robot.
        room: from :func:`room_for`.
        bits: contact bits of obstacles.
    """
    for kind, num in room:
        for k in range(num):
            body = spec.worldbody.add_body(name=f"slot: {kind} {k}", pos=_PARKED)
            size = KINDS[kind].geom_size((1.0, 1.0, 1.0))
            body.add_geom(type=KINDS[kind].geom, size=size, contype=bits, conaffinity=bits)


def slots_of(model: mujoco.MjModel, num_bodies: int) -> dict[str, np.ndarray]:
    """The geoms (n,) of the slots of each kind.

    Args:
        model: with slots.
        num_bodies: bodies that are not slots; they come first.
    """
    geoms = np.flatnonzero(model.geom_bodyid >= num_bodies)
    return {
        kind: geoms[model.geom_type[geoms] == int(about.geom)]
        for kind, about in KINDS.items()
        if np.any(model.geom_type[geoms] == int(about.geom))
    }


def place_obstacles(
    model: mujoco.MjModel, slots: Mapping[str, np.ndarray], obstacles: Sequence[Obstacle]
) -> None:
    """Move obstacles into the slots, and park those that are left.

    Args:
        model: with slots.
        slots: from :func:`slots_of`, with room for all.
        obstacles: K primitives, checked already.
    """
    for kind, geoms in slots.items():
        standing = [obstacle for obstacle in obstacles if obstacle.kind == kind]
        for geom, obstacle in zip(geoms, standing, strict=False):
            place(model, geom, obstacle)
        empty = model.geom_bodyid[geoms[len(standing) :]]
        model.body_pos[empty] = _PARKED
        model.body_quat[empty] = [1.0, 0.0, 0.0, 0.0]


def place(model: mujoco.MjModel, geom: int, obstacle: Obstacle) -> None:
    """Give a geom of the obstacle's kind, alone on its body, the obstacle's pose and size."""
    body = model.geom_bodyid[geom]
    quaternion = np.asarray(obstacle.quaternion, float)
    model.body_pos[body] = obstacle.position
    model.body_quat[body] = quaternion / np.linalg.norm(quaternion)
    if obstacle.kind == "plane":
        return  # it has no end
    size, num_sizes = np.zeros(3), KINDS[obstacle.kind].num_sizes
    size[:num_sizes] = obstacle.size[:num_sizes]
    model.geom_size[geom] = size
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        resize_mesh(model, int(geom), size)
    # What MuJoCo's compiler derives from the size: the box around it and its radius.
    model.geom_aabb[geom] = [0.0, 0.0, 0.0, *_half_extents(obstacle.kind, size)]
    model.geom_rbound[geom] = _radius(obstacle.kind, size)
    model.bvh_aabb[model.body_bvhadr[body]] = model.geom_aabb[geom]


def lever_arms(model: mujoco.MjModel) -> np.ndarray:
    """How much two bodies approach each other at most while one joint moves by one.

    Lengths from joint to joint bound it in all configurations.

    Returns:
        (D, nbody, nbody) [m/rad], or [m/m] for slides; joints that carry both or none do nothing.
    """
    # The farthest point of a body's geoms from the body's frame.
    extent = np.zeros(model.nbody)
    is_moving = model.body_weldid[model.geom_bodyid] != 0
    boxes = model.geom_pos, model.geom_aabb[:, :3], model.geom_aabb[:, 3:]
    reach = sum(np.linalg.norm(part[is_moving], axis=1) for part in boxes)
    np.maximum.at(extent, model.geom_bodyid[is_moving], reach)
    arms = np.zeros((model.nq, model.nbody))
    is_slide = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    offset, anchor = (np.linalg.norm(part, axis=1) for part in (model.body_pos, model.jnt_pos))
    travel = np.where(is_slide, np.abs(model.jnt_range).max(axis=1), 0.0)
    for body in np.flatnonzero(model.body_weldid):
        # From the body towards the base: the length of the way so far.
        length, at = extent[body], body
        while at:
            first = model.body_jntadr[at]
            joints = slice(first, first + model.body_jntnum[at]) if first >= 0 else slice(0)
            arms[joints, body] = np.where(is_slide[joints], 1.0, length + anchor[joints])
            length += travel[joints].sum() + offset[at]
            at = model.body_parentid[at]
    carries = arms > 0
    between = carries[:, :, None] != carries[:, None]
    return np.where(between, arms[:, :, None] + arms[:, None], 0.0)


def _half_extents(kind: str, size: np.ndarray) -> np.ndarray:
    """Half edges (3,) of the box around a geom [m]."""
    if kind == "sphere":
        return np.full(3, size[0])
    if kind == "capsule":
        return np.array([size[0], size[0], size[0] + size[1]])
    if kind == "cylinder":
        return np.array([size[0], size[0], size[1]])
    return size


def _radius(kind: str, size: np.ndarray) -> float:
    """Radius of the sphere around a geom [m]."""
    if kind == "sphere":
        return size[0]
    if kind == "capsule":
        return size[0] + size[1]
    if kind == "cylinder":
        return float(np.hypot(size[0], size[1]))
    return float(np.linalg.norm(size))
