"""Occupancy grids: what is solid in a home, cell by cell."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import yaml
from PIL import Image, UnidentifiedImageError

from vrrt_jax.robots.names import free_name

RESOLUTION = 0.1  # side of the cells that planners and networks expect [m]
HEIGHT = 2.0  # of the maps [m]; homes end there
_UNKNOWN = 0.196  # just below the occupancy of ROS's gray 205, which stands for unknown
_PROBE = "cell"  # name of the box that stands for a cell in MuJoCo


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """Solid cells; cell (i, j, k) covers ``[i, i + 1) * resolution + origin`` and so on.

    A map of one layer (Z = 1) is planar. Everything outside in x and y is solid. An array (X, Y), 0
    and 1 in place of booleans and an origin without a height are taken too.

    Raises:
        ValueError: wrong rank, empty, other values, a resolution that is not positive, or an origin
            that is no place.
    """

    occupied: np.ndarray  # (X, Y, Z) bool
    resolution: float = RESOLUTION  # [m]
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)  # corner of cell (0, 0, 0) [m]

    def __post_init__(self):
        """Check and convert the fields."""
        occupied, resolution = np.asarray(self.occupied), float(self.resolution)
        if occupied.ndim not in (2, 3) or 0 in occupied.shape:
            raise ValueError(
                f"the map has shape {occupied.shape}; expected (X, Y) or (X, Y, Z) with cells in it"
            )
        if occupied.dtype != bool:
            values = np.unique(occupied)
            if not np.isin(values, [0, 1]).all():
                raise ValueError(
                    f"the map holds values from {values[0]} to {values[-1]}; expected booleans, "
                    "True where a cell is solid: apply a threshold first"
                )
        if not (np.isfinite(resolution) and resolution > 0):
            raise ValueError(f"the map's resolution is {resolution}; expected meters, such as 0.1")
        origin = tuple(float(v) for v in self.origin)
        if len(origin) not in (2, 3) or not np.isfinite(origin).all():
            raise ValueError(f"the map's origin is {origin}; expected x, y and perhaps z in meters")
        if occupied.ndim == 2:
            occupied = occupied[:, :, None]
        object.__setattr__(self, "occupied", occupied.astype(bool, copy=False))
        object.__setattr__(self, "resolution", resolution)
        object.__setattr__(self, "origin", (*origin, 0.0)[:3])

    @property
    def planar(self) -> bool:
        """Whether there is one layer only."""
        return self.occupied.shape[2] == 1

    @property
    def size(self) -> np.ndarray:
        """Extent (3,) [m]."""
        return np.array(self.occupied.shape) * self.resolution

    def flatten(self, z_low: float = 0.0, z_high: float = 1.0) -> "Grid":
        """The planar map of all cells that have anything between two heights [m].

        Raises:
            ValueError: no layer lies between them.
        """
        if self.planar:
            return self
        bottom = self.origin[2] + np.arange(self.occupied.shape[2]) * self.resolution
        layers = (bottom < z_high - 1e-6) & (bottom + self.resolution > z_low + 1e-6)
        if not layers.any():
            raise ValueError(
                f"no layer of the map lies between {z_low} and {z_high} m; it spans "
                f"{self.origin[2]:.2f} to {self.origin[2] + self.size[2]:.2f} m"
            )
        flat = self.occupied[:, :, layers].any(axis=2, keepdims=True)
        return dataclasses.replace(self, occupied=flat)

    def crop(self, low: tuple[float, float], high: tuple[float, float]) -> "Grid":
        """The part between two corners [m], rounded to cells.

        Raises:
            ValueError: nothing of the map lies between them.
        """
        corners = (np.array([low, high]) - self.origin[:2]) / self.resolution
        first, last = np.clip(np.round(corners).astype(int), 0, self.occupied.shape[:2])
        if not (first < last).all():
            raise ValueError(
                f"nothing of the map lies between {low} and {high}; it spans "
                f"{self.origin[:2]} to {tuple(np.array(self.origin[:2]) + self.size[:2])} m"
            )
        x, y = np.array(self.origin[:2]) + first * self.resolution
        return dataclasses.replace(
            self,
            occupied=self.occupied[first[0] : last[0], first[1] : last[1]],
            origin=(float(x), float(y), self.origin[2]),
        )

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` that :func:`load_map` reads."""
        np.savez_compressed(
            path,
            occupied=self.occupied,
            resolution_m=self.resolution,
            origin_m=np.array(self.origin),
        )


def load_map(path: str | Path) -> Grid:
    """Read a map.

    Args:
        path: ``.npz`` with ``occupied``, ``resolution_m`` and ``origin_m``; a ROS map's ``.yaml``
            of mode trinary or scale (unknown and transparent pixels count as solid); or an MJCF
            scene ``.xml``, which is cut into cells. Cells smaller than 0.1 m are joined.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is of another kind or malformed.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"map '{path}' does not exist (or is a folder)")
    readers = {".npz": _read_npz, ".yaml": _read_ros, ".yml": _read_ros, ".xml": _read_mjcf}
    if path.suffix not in readers:
        raise ValueError(f"map '{path}': unknown kind; expected one of {', '.join(readers)}")
    try:
        return coarsened(readers[path.suffix](path))
    except ValueError as error:
        raise ValueError(f"map '{path}': {error}") from error


def coarsened(grid: Grid, resolution: float = RESOLUTION) -> Grid:
    """The map in larger cells, solid where any part of them is, or lies beside the map.

    Raises:
        ValueError: the cells are larger already.
    """
    if abs(grid.resolution - resolution) < 1e-6:
        return grid
    if grid.resolution > resolution:
        raise ValueError(
            f"the map's cells are {grid.resolution} m, but planning needs {resolution} m or less: "
            "scan or draw it finer"
        )
    # Axis by axis: a small cell makes the large cells solid that hold its first and last edge.
    ratio = grid.resolution / resolution
    axes = 2 if grid.planar else 3
    occupied = grid.occupied
    for axis in range(axes):
        cells = np.moveaxis(occupied, axis, 0)
        size = cells.shape[0] * ratio
        coarse = np.zeros((int(np.ceil(size - 1e-6)), *cells.shape[1:]), bool)
        edges = np.arange(cells.shape[0] + 1) * ratio
        np.logical_or.at(coarse, np.floor(edges[:-1] + 1e-6).astype(int), cells)
        np.logical_or.at(coarse, np.ceil(edges[1:] - 1e-6).astype(int) - 1, cells)
        # The last large cell may lie partly beside the map, where all is solid.
        if axis < 2 and size < len(coarse) - 1e-6:
            coarse[-1] = True
        occupied = np.moveaxis(coarse, 0, axis)
    return dataclasses.replace(grid, occupied=occupied, resolution=resolution)


def _read_npz(path: Path) -> Grid:
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = dict(data)
    except Exception as error:  # numpy and zipfile raise many kinds
        raise ValueError(f"it is not a readable .npz file: {error}") from error
    if "occupied" not in arrays:
        raise ValueError(f"it has no array 'occupied', only: {', '.join(arrays)}")
    origin = tuple(np.ravel(arrays.get("origin_m", np.zeros(3))).tolist())
    resolution = np.ravel(arrays.get("resolution_m", RESOLUTION))
    if len(resolution) != 1:
        raise ValueError(f"its resolution_m is {resolution.tolist()}; expected one number")
    return Grid(occupied=arrays["occupied"], resolution=float(resolution[0]), origin=origin)


def _read_ros(path: Path) -> Grid:
    """A planar map of ROS's map_server: gray values, the top row at the largest y."""
    try:
        about = yaml.safe_load(path.read_text())
        resolution, origin = float(about["resolution"]), [float(v) for v in about["origin"]]
        occupied_from = float(about.get("occupied_thresh", 0.65))
        free_below = min(float(about.get("free_thresh", _UNKNOWN)), _UNKNOWN)
        image = Image.open(path.parent / about["image"])
        gray = np.asarray(image.convert("L"), float) / 255
    except (KeyError, TypeError, ValueError, yaml.YAMLError, UnidentifiedImageError) as error:
        raise ValueError(
            f"it is not a map_server file with image, resolution and origin: {error!r}"
        ) from error
    if len(origin) > 2 and origin[2]:
        raise ValueError(f"it is turned by {origin[2]} rad; rotate the image and set yaw to 0")
    mode = about.get("mode", "trinary")
    if mode not in ("trinary", "scale"):
        raise ValueError(f"its mode is '{mode}'; expected 'trinary': save the map as trinary")
    if image.mode.startswith(("I", "F")):
        raise ValueError(
            f"its image has pixels of kind '{image.mode}'; expected 8 bits a pixel: convert it"
        )
    # Gray values are occupancies, unless negated: dark is solid. Transparent pixels are unknown.
    if not about.get("negate", 0):
        gray = 1 - gray
    clear = np.asarray(image.convert("RGBA").getchannel("A")) < 255
    solid = ~(gray < free_below) | (gray > occupied_from) | clear  # unknown is solid
    return Grid(occupied=solid[::-1].T, resolution=resolution, origin=(origin[0], origin[1], 0.0))


def _read_mjcf(path: Path) -> Grid:
    """Cut the geoms of a scene into cells, from the floor at z = 0 up to 2 m; planes are left out.

    A cell is solid if its inside touches a geom.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        half = RESOLUTION / 2 * (1 - 1e-3)
        name = free_name(_PROBE, {geom.name for geom in spec.geoms})
        spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3)
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot compile it: {error}") from error
    # The geoms that can be collided with, at their places.
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    probe = model.geom(name).id
    data.geom_xmat[probe] = np.eye(3).ravel()
    geoms = np.flatnonzero(
        (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
        & (model.geom_contype | model.geom_conaffinity > 0)
        & (np.arange(model.ngeom) != probe)
    )
    if not len(geoms):
        raise ValueError("the scene has no geom to collide with but planes")
    # A grid around all of them, in cells of 0.1 m.
    boxes = [_bounds(model, data, int(g)) for g in geoms]
    low = np.append(np.min([b[0] for b in boxes], axis=0)[:2], 0.0)
    high = np.append(np.max([b[1] for b in boxes], axis=0)[:2], HEIGHT)
    first = np.floor(low / RESOLUTION + 1e-6).astype(int)
    shape = np.ceil(high / RESOLUTION - 1e-6).astype(int) - first
    occupied = np.zeros(shape, bool)
    # Move the box to each cell near a geom: does it touch the geom?
    for geom, (lower, upper) in zip(geoms, boxes, strict=True):
        start = np.clip(np.floor(lower / RESOLUTION + 1e-6).astype(int) - first, 0, shape)
        stop = np.clip(np.ceil(upper / RESOLUTION - 1e-6).astype(int) - first, 0, shape)
        for index in np.ndindex(*np.maximum(stop - start, 0)):
            cell = start + index
            data.geom_xpos[probe] = (first + cell + 0.5) * RESOLUTION
            if mujoco.mj_geomDistance(model, data, probe, geom, RESOLUTION, None) <= 0:
                occupied[tuple(cell)] = True
    return Grid(occupied=occupied, origin=tuple((first * RESOLUTION).tolist()))


def _bounds(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) and (3,) of a geom's bounding box in the world [m]."""
    rotation = data.geom_xmat[geom].reshape(3, 3)
    center = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3]
    reach = np.abs(rotation) @ model.geom_aabb[geom, 3:]
    return center - reach, center + reach
