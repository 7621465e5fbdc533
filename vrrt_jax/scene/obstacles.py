"""Obstacles: slots on the device, primitive geoms on the host.

Every kind is one formula, a box with optional rounding and an optional round section, so that any
slot holds any kind; :mod:`vrrt_jax.scene.obstacle_kinds` has the table of kinds.
"""

import dataclasses
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.files import write_text
from vrrt_jax.core.types import pytree
from vrrt_jax.robots.names import free_name
from vrrt_jax.robots.xml_file import check_mjcf
from vrrt_jax.scene.obstacle_kinds import KINDS, SlotShape

PARKED = 1e3  # [m] where the empty slots are


@dataclasses.dataclass(frozen=True, kw_only=True)
class Obstacle:
    """An obstacle as the host sees it: one primitive geom of an MJCF file."""

    name: str
    kind: str  # one of ``obstacle_kinds.KINDS``: sphere, box, capsule, cylinder or plane
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
    """Exact distances (K, n) [m] from obstacles to points (3, n), negative inside."""
    # Into each obstacle's frame, axis by axis: XLA's CPU backend is slow on small products. Points
    # come last: there are more of them, and loops over the last axis are the ones it vectorizes.
    offset = points[:, None] - obstacles.position.T[:, :, None]
    x, y, z = (
        sum(offset[i] * obstacles.rotation[:, i, axis, None] for i in range(3)) for axis in range(3)
    )
    # How far outside the faces. A round section has one face all around, at the radius half_x.
    half_x, half_y, half_z = obstacles.half.T[:, :, None]
    is_round = obstacles.is_round[:, None]
    radial = jnp.sqrt(x * x + y * y + 1e-20)
    x = jnp.where(is_round, radial, jnp.abs(x)) - half_x
    y = jnp.where(is_round, -half_x, jnp.abs(y) - half_y)
    z = jnp.abs(z) - half_z
    # Outside: the distance to the nearest face, edge or corner. Inside: to the nearest face.
    outside = sum(jnp.maximum(axis, 0.0) ** 2 for axis in (x, y, z))
    inside = jnp.minimum(jnp.maximum(x, jnp.maximum(y, z)), 0.0)
    return jnp.sqrt(outside + 1e-20) + inside - obstacles.rounding[:, None]


def load_obstacles(path: str | Path) -> list[Obstacle]:
    """Read the obstacles of an MJCF file: the geoms fixed to its world.

    Spheres, boxes, capsules, cylinders and planes are supported. Geoms without contype and
    conaffinity are for the eye, and no obstacles. A geom without a name gets one that no other has.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not MJCF, a body that moves, or a geom of another kind.
    """
    try:
        check_mjcf(path)
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"'{path}' is not a valid MJCF world: {error}") from None
    if model.njnt:
        raise ValueError(
            f"'{path}' has the joint '{model.joint(0).name}'; obstacles stand still: remove it"
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    if model.ngeom and not collides.any():
        warnings.warn(
            f"no geom of '{path}' is an obstacle, as all have contype=0 and conaffinity=0: they "
            "are for the eye; give contype=1 to those that should be kept free",
            stacklevel=2,
        )
    names = {model.geom(g).name for g in range(model.ngeom)}
    obstacles = []
    for g in np.flatnonzero(collides).tolist():
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[g])
        obstacles.append(
            Obstacle(
                name=model.geom(g).name or free_name(f"geom_{g}", names),
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


def write_obstacles(obstacles: Sequence[Obstacle], path: Path, comment: str = "") -> None:
    """Write obstacles as an MJCF file for :func:`load_obstacles`."""
    root = ET.Element("mujoco", model=path.stem)
    if comment:
        root.append(ET.Comment(f" {comment} "))
    body = ET.SubElement(root, "worldbody")
    for obstacle in obstacles:
        fields = {
            "pos": obstacle.position,
            "quat": obstacle.quaternion,
            "size": obstacle.size,
            "rgba": obstacle.rgba,
        }
        numbers = {key: " ".join(f"{v:.9g}" for v in value) for key, value in fields.items()}
        ET.SubElement(body, "geom", {"name": obstacle.name, "type": obstacle.kind, **numbers})
    ET.indent(root)
    write_text(path, ET.tostring(root, encoding="unicode") + "\n")


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
        kind = KINDS[obstacle.kind]
        matrix = np.zeros(9)
        unit = np.asarray(obstacle.quaternion) / np.linalg.norm(obstacle.quaternion)
        mujoco.mju_quat2Mat(matrix, unit)
        rotation[k], position[k] = matrix.reshape(3, 3), obstacle.position
        position[k] += kind.shift * rotation[k][:, 2]
        shape = kind.encode(obstacle.size)
        half[k], rounding[k], is_round[k] = shape.half, shape.rounding, shape.is_round
    return Obstacles(
        position=jnp.asarray(position, jnp.float32),
        rotation=jnp.asarray(rotation, jnp.float32),
        half=jnp.asarray(half, jnp.float32),
        rounding=jnp.asarray(rounding, jnp.float32),
        is_round=jnp.asarray(is_round),
    )


def from_slots(obstacles: Obstacles, kinds: Sequence[str]) -> list[dict[str, Any] | None]:
    """What the slots say about each obstacle: the reverse of :func:`to_slots`.

    Args:
        obstacles: K slots.
        kinds: (K,) the kind in each slot, '' where it is empty.

    Returns:
        For each slot, None or the fields kind, position, quaternion and size of an
        :class:`Obstacle`.
    """
    slots = jax.tree.map(np.asarray, obstacles)
    found: list[dict[str, Any] | None] = []
    for k, name in enumerate(kinds):
        if not name:
            found.append(None)
            continue
        kind, quaternion = KINDS[name], np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, slots.rotation[k].astype(np.float64).ravel())
        shape = SlotShape(
            half=slots.half[k],
            rounding=float(slots.rounding[k]),
            is_round=bool(slots.is_round[k]),
        )
        found.append(
            {
                "kind": name,
                "position": floats(slots.position[k] - kind.shift * slots.rotation[k][:, 2]),
                "quaternion": floats(quaternion),
                "size": floats(kind.decode(shape)),
            }
        )
    return found


def check_obstacle(obstacle: Obstacle) -> None:
    """Raise a ValueError that names the obstacle if it cannot be collided with."""
    if obstacle.kind not in KINDS:
        raise ValueError(
            f"collision between the robot's spheres and '{obstacle.name}' ({obstacle.kind}) is not "
            f"supported; use one of {', '.join(KINDS)}"
        )
    position, quaternion, size = (
        _numbers(value) for value in (obstacle.position, obstacle.quaternion, obstacle.size)
    )
    is_pose = position.shape == (3,) and quaternion.shape == (4,)
    if not (is_pose and np.all(np.isfinite(position)) and np.all(np.isfinite(quaternion))):
        raise ValueError(
            f"obstacle '{obstacle.name}' has a pose that is not finite: position "
            f"{obstacle.position!r}, quaternion {obstacle.quaternion!r}; expected x, y, z [m] and "
            "w, x, y, z"
        )
    if not np.any(quaternion):
        raise ValueError(
            f"obstacle '{obstacle.name}' has a quaternion of zeros; expected (1, 0, 0, 0) where it "
            "is not turned"
        )
    needed = KINDS[obstacle.kind].num_sizes
    used = size[:needed] if size.ndim == 1 and len(size) <= 3 else np.full(1, np.nan)
    if len(used) < needed or not np.all(np.isfinite(used) & (used > 0)):
        raise ValueError(
            f"obstacle '{obstacle.name}' ({obstacle.kind}) has size {obstacle.size}; expected "
            f"{needed} positive numbers [m]"
        )


def _numbers(values: Any) -> np.ndarray:
    """Numbers as an array; NaN for what is none."""
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.array(np.nan)


def floats(values: Any) -> Any:
    """A tuple of plain floats."""
    return tuple(float(v) for v in values)
