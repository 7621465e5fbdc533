"""The bodies of a MuJoCo model as triangle meshes in color, for pages and other programs."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from vrrt_jax.scene.obstacle_kinds import KINDS
from vrrt_jax.scene.obstacles import Obstacle

PLANE_HALF_M = 2.0  # [m] half the side of the square that is drawn of a plane
_PLANE_THICK_M = 0.004  # [m]


def body_mesh(model: mujoco.MjModel, body: int, groups: Collection[int]) -> Any:
    """All geoms of a body that stand in some groups, as one mesh.

    Args:
        model: a compiled model.
        body: index of the body.
        groups: of the geoms to take.

    Returns:
        A ``trimesh.Trimesh`` in the frame of the body [m], with a color for each vertex; None if
        the body has no such geom.
    """
    import trimesh

    first, num = model.body_geomadr[body], model.body_geomnum[body]
    geoms = [g for g in range(first, first + num) if model.geom_group[g] in groups]
    meshes = [_geom_mesh(model, geom) for geom in geoms]
    return trimesh.util.concatenate(meshes) if meshes else None


def obstacle_mesh(obstacle: Obstacle) -> Any:
    """An obstacle in its own frame, as :func:`body_mesh` has bodies in theirs."""
    import trimesh

    kind = KINDS[obstacle.kind]
    mesh = _PRIMITIVES[kind.geom](trimesh.creation, np.asarray(kind.geom_size(obstacle.size)))
    return _colored(mesh, obstacle.rgba)


def _colored(mesh: Any, rgba: Sequence[float] | np.ndarray) -> Any:
    color = np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8)
    mesh.visual.vertex_colors = np.tile(color, (len(mesh.vertices), 1))
    return mesh


def _geom_mesh(model: mujoco.MjModel, geom: int) -> Any:
    """A geom in the frame of its body, in its material's color or its own."""
    import trimesh

    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = _asset(model, int(model.geom_dataid[geom]))
    elif kind in _PRIMITIVES:
        mesh = _PRIMITIVES[kind](trimesh.creation, model.geom_size[geom])
    else:
        raise ValueError(
            f"geom {geom} is of the kind {kind.name}, which cannot be drawn; expected a mesh or a "
            "primitive"
        )
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    _colored(mesh, rgba)
    pose = np.eye(4)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    return mesh.apply_transform(pose)


def _asset(model: mujoco.MjModel, mesh: int) -> Any:
    """A mesh of the model's assets, in the frame of the geoms that show it."""
    import trimesh

    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    return trimesh.Trimesh(
        model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]],
        model.mesh_face[face : face + model.mesh_facenum[mesh]],
        process=False,
    )


def _ellipsoid(create: Any, size: np.ndarray) -> Any:
    return create.icosphere(subdivisions=2).apply_scale(size)


def _plane(create: Any, size: np.ndarray) -> Any:
    """A thin plate whose top is the plane; a size of zero has no end."""
    sides = [2 * min(half or PLANE_HALF_M, PLANE_HALF_M) for half in size[:2]]
    plate = create.box(extents=[*sides, _PLANE_THICK_M])
    return plate.apply_translation([0.0, 0.0, -_PLANE_THICK_M / 2])


# How trimesh makes each primitive of MuJoCo from its size.
_PRIMITIVES: Mapping[mujoco.mjtGeom, Callable[[Any, np.ndarray], Any]] = {
    mujoco.mjtGeom.mjGEOM_PLANE: _plane,
    mujoco.mjtGeom.mjGEOM_SPHERE: lambda make, size: make.icosphere(2, radius=size[0]),
    mujoco.mjtGeom.mjGEOM_CAPSULE: lambda make, size: make.capsule(2 * size[1], size[0]),
    mujoco.mjtGeom.mjGEOM_CYLINDER: lambda make, size: make.cylinder(size[0], 2 * size[1]),
    mujoco.mjtGeom.mjGEOM_BOX: lambda make, size: make.box(2 * size),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: _ellipsoid,
}
