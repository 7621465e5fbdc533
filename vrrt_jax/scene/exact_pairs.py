"""What C MuJoCo has to be told, or not to be asked, to measure how far apart two shapes are."""

import mujoco
import numpy as np

_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(8, 3)
_GEOM = mujoco.mjtGeom


def box_mesh(spec: mujoco.MjSpec, name: str, size: np.ndarray) -> str:
    """Add a mesh of eight corners, which is a box of this size (3,) [m]; returns its name.

    MuJoCo knows of two boxes whether they touch, but not how far apart they are: it may see nothing
    at 1 mm. Of a box and a mesh it knows both.
    """
    spec.add_mesh(name=name, uservert=(_CORNERS * size).ravel().tolist())
    return name


def boxes_to_meshes(spec: mujoco.MjSpec) -> None:
    """Turn all boxes of a robot into meshes, see :func:`box_mesh`; this compiles the robot."""
    boxes = [geom for geom in spec.geoms if geom.type == _GEOM.mjGEOM_BOX]
    if not boxes:
        return
    model = spec.compile()
    for geom in boxes:
        index = geom.id
        geom.meshname = box_mesh(spec, f"box: {index}", model.geom_size[index])
        geom.type, geom.fromto = _GEOM.mjGEOM_MESH, [np.nan] * 6
        geom.pos, geom.quat = model.geom_pos[index], model.geom_quat[index]


def resize_mesh(model: mujoco.MjModel, geom: int, size: np.ndarray) -> None:
    """Give a mesh of :func:`box_mesh` that no other geom has another size (3,) [m]."""
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    vertices = slice(first, first + model.mesh_vertnum[mesh])
    model.mesh_vert[vertices] = np.sign(model.mesh_vert[vertices]) * size


def measure_rightly(model: mujoco.MjModel) -> None:
    """Let MuJoCo tell one contact of two convex shapes: their distance, which is right.

    Those that it adds by default, for boxes and meshes that rest on each other, are wrong by
    millimeters, and take the place of the right one, where shapes are seen from afar.
    """
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
