"""MJCF scenes as maps: what their geoms fill, cell by cell."""

from pathlib import Path

import mujoco
import numpy as np

from nrp_jax.homes.grid import HEIGHT, RESOLUTION, Grid
from nrp_jax.homes.memory import check_memory
from vrrt_jax.robots.xml_file import check_mjcf

_KINDS = mujoco.mjtGeom
_MEASURED = (
    _KINDS.mjGEOM_SPHERE,
    _KINDS.mjGEOM_CAPSULE,
    _KINDS.mjGEOM_ELLIPSOID,
    _KINDS.mjGEOM_CYLINDER,
    _KINDS.mjGEOM_BOX,
    _KINDS.mjGEOM_MESH,  # MuJoCo collides with its convex hull
)
_HALF = RESOLUTION / 2 * (1 - 1e-3)  # of the inside of a cell [m]
_THIN = 1e-4  # [m] the gap between the insides of two cells, where thinner geoms may be
_MOST_CELLS = 2e7  # near geoms, each takes some microseconds
_LEVEL = 1 - 1e-6  # least z of a floor's normal: rounded angles tilt it by a millimeter a meter


def read_mjcf_map(path: Path, crop: tuple[float, float, float, float] | None) -> Grid:
    """Cut the geoms of a scene into cells, from the floor up to 2 m above it.

    The floor is the highest level plane that faces up, or z = 0. A cell is solid if its inside
    touches a geom, or the half space behind another plane. Geoms that collide with nothing
    (``contype`` and ``conaffinity`` 0) are left out.

    Args:
        path: of the scene.
        crop: x0, y0, x1, y1 of the part to read, and a cell around it [m]; all of it if None.

    Raises:
        ValueError: MuJoCo cannot compile the scene, or it holds nothing solid, or something whose
            cells are not known.
    """
    try:
        check_mjcf(path)
        spec = mujoco.MjSpec.from_file(str(path))
        # A box that is moved to each cell; it must take nothing from the scene's defaults.
        probe = spec.worldbody.add_geom(
            type=_KINDS.mjGEOM_BOX, size=[_HALF] * 3, meshname="", quat=[1, 0, 0, 0], margin=0
        )
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot compile it: {error}") from error
    if model.nflex:
        raise ValueError("it has soft bodies (flex); make them boxes")
    # The geoms that can be collided with, at their places.
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    solid = (model.geom_contype | model.geom_conaffinity) > 0
    solid[probe.id] = False
    is_plane = model.geom_type == _KINDS.mjGEOM_PLANE
    planes, geoms = (np.flatnonzero(solid & kind) for kind in (is_plane, ~is_plane))
    for geom in geoms:
        if _KINDS(model.geom_type[geom]) not in _MEASURED:
            kind = _KINDS(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
            raise ValueError(f"its {_name(model, int(geom))} is of kind {kind}; make it of boxes")
    # A thin geom between two cells belongs to both.
    model.geom_size[geoms] = np.maximum(model.geom_size[geoms], _THIN)
    model.geom_aabb[geoms, 3:] = np.maximum(model.geom_aabb[geoms, 3:], _THIN)
    # Heights are those above the floor.
    is_floor = data.geom_xmat[planes, 8] > _LEVEL
    if is_floor.any():
        data.geom_xpos[:, 2] -= data.geom_xpos[planes[is_floor], 2].max()
    # A grid around all of them but for the floor, in cells of 0.1 m.
    boxes = [_bounds(model, data, int(g)) for g in geoms]
    walls = planes[~is_floor].tolist()
    outer = boxes + [_bounds(model, data, g) for g in walls]
    if not outer:
        raise ValueError("the scene has no geom to collide with but floors")
    low = np.append(np.min([b[0] for b in outer], axis=0)[:2], 0.0)
    high = np.append(np.max([b[1] for b in outer], axis=0)[:2], HEIGHT)
    if crop is not None:
        low[:2] = np.maximum(low[:2], np.array(crop[:2]) - RESOLUTION)
        high[:2] = np.minimum(high[:2], np.array(crop[2:]) + RESOLUTION)
    first = np.floor(low / RESOLUTION + 1e-6).astype(int)
    shape = np.ceil(high / RESOLUTION - 1e-6).astype(int) - first
    if (shape < 1).any():
        raise ValueError(f"nothing of it lies between {low[:2].tolist()} and {high[:2].tolist()}")
    check_memory(30.0 * shape.prod(), f"a map of {shape[0]} x {shape[1]} x {shape[2]} cells")
    _check_work(boxes, first, shape)
    occupied = np.zeros(shape, bool)
    for geom in walls:
        occupied |= _behind(data, geom, first, shape)
    _fill(model, data, probe.id, zip(geoms.tolist(), boxes, strict=True), first, occupied)
    if boxes and crop is None and not occupied.any():
        raise ValueError(
            f"nothing of it is solid from its floor up to {HEIGHT:g} m above, and the floor is the "
            "highest level plane that faces up: make a ceiling of boxes"
        )
    return Grid(occupied=occupied, origin=tuple((first * RESOLUTION).tolist()))


def _cells_near(
    bounds: tuple[np.ndarray, np.ndarray], first: np.ndarray, shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The cells (3,) to (3,) of a map, the last one left out, that bounds [m] reach."""
    lower, upper = bounds
    start = np.clip(np.floor(lower / RESOLUTION + 1e-6).astype(int) - first, 0, shape)
    stop = np.clip(np.ceil(upper / RESOLUTION - 1e-6).astype(int) - first, 0, shape)
    return start, np.maximum(stop, start)


def _check_work(boxes: list, first: np.ndarray, shape: np.ndarray) -> None:
    """Raise a ValueError if so many cells are near geoms that it would take hours."""
    ranges = [_cells_near(box, first, shape) for box in boxes]
    num = sum(float(np.prod(stop - start, dtype=float)) for start, stop in ranges)
    if num > _MOST_CELLS:
        raise ValueError(
            f"{num:.2g} cells of {RESOLUTION:g} m are near its geoms, in a map of {shape[0]} x "
            f"{shape[1]} cells; expected at most {_MOST_CELLS:.0e}: give lengths in meters, or "
            "read a part of it, see crop"
        )


def _fill(model, data, probe: int, geoms, first: np.ndarray, occupied: np.ndarray) -> None:
    """Mark the cells that geoms with their bounds touch: a box is moved to each cell near them."""
    data.geom_xmat[probe] = np.eye(3).ravel()
    shape = np.array(occupied.shape)
    for geom, bounds in geoms:
        start, stop = _cells_near(bounds, first, shape)
        for index in np.ndindex(*(stop - start)):
            cell = start + index
            data.geom_xpos[probe] = (first + cell + 0.5) * RESOLUTION
            if mujoco.mj_geomDistance(model, data, probe, geom, RESOLUTION, None) <= 0:
                occupied[tuple(cell)] = True


def _behind(data: mujoco.MjData, plane: int, first: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Cells (X, Y, Z) whose inside reaches the solid side of a plane, which has no end."""
    normal = data.geom_xmat[plane].reshape(3, 3)[:, 2]
    height = np.zeros(tuple(shape)) - normal @ data.geom_xpos[plane] - _HALF * np.abs(normal).sum()
    for axis in range(3):
        middle = (first[axis] + np.arange(shape[axis]) + 0.5) * RESOLUTION
        height += (normal[axis] * middle).reshape([-1 if a == axis else 1 for a in range(3)])
    return height < 0


def _bounds(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) and (3,) of a geom's bounding box in the world [m]; of a plane as drawn."""
    rotation = data.geom_xmat[geom].reshape(3, 3)
    if model.geom_type[geom] == _KINDS.mjGEOM_PLANE:
        reach = np.abs(rotation[:, :2]) @ model.geom_size[geom, :2]
        return data.geom_xpos[geom] - reach, data.geom_xpos[geom] + reach
    center = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3]
    reach = np.abs(rotation) @ model.geom_aabb[geom, 3:]
    return center - reach, center + reach


def _name(model: mujoco.MjModel, geom: int) -> str:
    return f"geom '{model.geom(geom).name}'" if model.geom(geom).name else f"geom number {geom}"
