"""Obstacles: slots on the device, primitive geoms on the host.

Every kind is one formula, a box with optional rounding and an optional round section: a sphere is a
rounded point, a capsule a rounded segment, a cylinder a box of round section and a floor a very
large box. So any slot holds any kind.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.types import pytree

KINDS = ("sphere", "box", "capsule", "cylinder", "plane")
PARKED = 1e3  # [m] where the empty slots are
HALF_SPACE = 50.0  # [m] half the edge of the box that stands for a plane


@dataclasses.dataclass(frozen=True, kw_only=True)
class Obstacle:
    """An obstacle as the host sees it: one primitive geom of an MJCF file."""

    name: str
    kind: str  # sphere, box, capsule, cylinder or plane
    position: tuple[float, float, float]  # in the world [m]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # wxyz
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)  # as MuJoCo's geom size [m]
    rgba: tuple[float, float, float, float] = (0.6, 0.6, 0.65, 1.0)


@pytree
class Obstacles:
    """K slots; an empty one is parked far away."""

    position: jax.Array  # (K, 3) [m]
    rotation: jax.Array  # (K, 3, 3) obstacle-to-world
    half: jax.Array  # (K, 3) half extents before rounding [m]
    rounding: jax.Array  # (K,) radius added all around [m]
    is_round: jax.Array  # (K,) bool, round section about the local z axis


def signed_distances(obstacles: Obstacles, points: jax.Array) -> jax.Array:
    """Exact distances (n, K) [m] from points (3, n) to obstacles, negative inside."""
    offset = points[:, :, None] - obstacles.position.T[:, None]
    x, y, z = (
        sum(offset[i] * obstacles.rotation[:, i, axis] for i in range(3)) for axis in range(3)
    )
    half_x, half_y, half_z = obstacles.half.T
    radial = jnp.sqrt(x * x + y * y + 1e-20)
    x = jnp.where(obstacles.is_round, radial, jnp.abs(x)) - half_x
    y = jnp.where(obstacles.is_round, -half_x, jnp.abs(y) - half_y)
    z = jnp.abs(z) - half_z
    outside = sum(jnp.maximum(axis, 0.0) ** 2 for axis in (x, y, z))
    inside = jnp.minimum(jnp.maximum(x, jnp.maximum(y, z)), 0.0)
    return jnp.sqrt(outside + 1e-20) + inside - obstacles.rounding


def load_obstacles(path: str | Path) -> list[Obstacle]:
    """Read the obstacles of an MJCF file: the geoms fixed to its world.

    Spheres, boxes, capsules, cylinders and planes are supported.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not MJCF, a body that moves, or a geom of another kind.
    """
    try:
        Path(path).read_bytes()
    except OSError as error:
        raise FileNotFoundError(f"cannot read the world '{path}': {error.strerror}") from None
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"'{path}' is not a valid MJCF world: {error}") from None
    if model.njnt:
        raise ValueError(
            f"'{path}' has the joint '{model.joint(0).name}'; obstacles stand still: remove it"
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    obstacles = []
    for g in range(model.ngeom):
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[g])
        obstacles.append(
            Obstacle(
                name=model.geom(g).name or f"geom_{g}",
                kind=mujoco.mjtGeom(model.geom_type[g]).name[len("mjGEOM_") :].lower(),
                position=floats(data.geom_xpos[g]),
                quaternion=floats(quaternion),
                size=floats(model.geom_size[g]),
                rgba=floats(model.geom_rgba[g]),
            )
        )
    for obstacle in obstacles:
        check_obstacle(obstacle)
    return obstacles


def to_slots(obstacles: Sequence[Obstacle], num_slots: int) -> Obstacles:
    """Fill K slots, and park the rest.

    Raises:
        ValueError: an unsupported kind, or a size or pose that makes no sense.
    """
    position = np.full((num_slots, 3), PARKED)
    rotation = np.tile(np.eye(3), (num_slots, 1, 1))
    half, rounding = np.zeros((num_slots, 3)), np.zeros(num_slots)
    is_round = np.zeros(num_slots, bool)
    for k, obstacle in enumerate(obstacles):
        check_obstacle(obstacle)
        matrix, (a, b, c) = np.zeros(9), obstacle.size
        unit = np.asarray(obstacle.quaternion) / np.linalg.norm(obstacle.quaternion)
        mujoco.mju_quat2Mat(matrix, unit)
        rotation[k], position[k] = matrix.reshape(3, 3), obstacle.position
        if obstacle.kind == "sphere":
            rounding[k] = a
        elif obstacle.kind == "box":
            half[k] = a, b, c
        elif obstacle.kind == "capsule":
            half[k, 2], rounding[k] = b, a
        elif obstacle.kind == "cylinder":
            half[k], is_round[k] = (a, a, b), True
        else:
            half[k] = HALF_SPACE
            position[k] -= HALF_SPACE * rotation[k][:, 2]
    return Obstacles(
        position=jnp.asarray(position, jnp.float32),
        rotation=jnp.asarray(rotation, jnp.float32),
        half=jnp.asarray(half, jnp.float32),
        rounding=jnp.asarray(rounding, jnp.float32),
        is_round=jnp.asarray(is_round),
    )


def check_obstacle(obstacle: Obstacle) -> None:
    """Raise a ValueError that names the obstacle if it cannot be collided with."""
    if obstacle.kind not in KINDS:
        raise ValueError(
            f"collision between the robot's spheres and '{obstacle.name}' ({obstacle.kind}) is not "
            f"supported; use one of {', '.join(KINDS)}"
        )
    needed = {"sphere": 1, "box": 3, "capsule": 2, "cylinder": 2, "plane": 0}[obstacle.kind]
    if not (np.all(np.isfinite(obstacle.position)) and np.all(np.isfinite(obstacle.quaternion))):
        raise ValueError(f"obstacle '{obstacle.name}' has a pose that is not finite")
    size = np.asarray(obstacle.size[:needed])
    if not np.all(np.isfinite(size) & (size > 0)):
        raise ValueError(
            f"obstacle '{obstacle.name}' ({obstacle.kind}) has size {obstacle.size}; expected "
            f"{needed} positive numbers [m]"
        )


def floats(values: Any) -> Any:
    """A tuple of plain floats."""
    return tuple(float(v) for v in values)
