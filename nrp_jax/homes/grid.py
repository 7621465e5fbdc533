"""Occupancy grids: what is solid in a home, cell by cell."""

import dataclasses
import warnings
from pathlib import Path

import numpy as np

from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.data_file import of_file

FARTHEST = 1e9  # [m] that a map may lie away from 0
RESOLUTION = 0.1  # side of the cells that planners and networks expect [m]
HEIGHT = 2.0  # of the maps [m]; homes end there


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
        if len(origin) not in (2, 3) or not (np.abs(origin) <= FARTHEST).all():
            raise ValueError(
                f"the map's origin is {origin}; expected x, y and perhaps z in meters, within "
                f"{FARTHEST:g} m of 0"
            )
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


def load_map(path: str | Path, *, crop: tuple[float, float, float, float] | None = None) -> Grid:
    """Read a map.

    Args:
        path: ``.npz`` with ``occupied``, ``resolution_m`` and ``origin_m``; a ROS map's ``.yaml``,
            read as map_server does (what is not known to be free is solid); or an MJCF scene
            ``.xml``, which is cut into cells. Cells smaller than 0.1 m are joined.
        crop: x0, y0, x1, y1 of the part to read [m], rounded to cells; all of it if None.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is of another kind, malformed or too large for the memory, or nothing
            of the map lies in ``crop``.
    """
    from nrp_jax.homes.mjcf_map import read_mjcf_map
    from nrp_jax.homes.ros_map import read_ros_map

    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"map '{path}' does not exist (or is a folder)")
    readers = {
        ".npz": _read_npz,
        ".yaml": read_ros_map,
        ".yml": read_ros_map,
        ".xml": read_mjcf_map,
    }
    if path.suffix not in readers:
        raise ValueError(f"map '{path}': unknown kind; expected one of {', '.join(readers)}")
    if crop is not None and (len(crop) != 4 or not np.isfinite(crop).all()):
        raise ValueError(f"crop is {crop}; expected four numbers x0, y0, x1, y1 [m]")
    with of_file(path):
        try:
            grid = readers[path.suffix](path, crop)
            grid = grid if crop is None else grid.crop(crop[:2], crop[2:])
        except MemoryError:
            raise ValueError("too little memory; read a part of it, see crop") from None
    if crop is not None:
        _warn_of_cut(grid, crop)
    if np.all(grid.occupied):
        warnings.warn(
            f"map '{path}': all of its {grid.occupied.size} cells are solid; expected free ones: "
            "an image may be 0 and 1 instead of 0 and 255, or need negate",
            stacklevel=2,
        )
    return grid


def _warn_of_cut(grid: Grid, crop: tuple[float, float, float, float]) -> None:
    """Warn where the part that was read ends before the one that was asked for."""
    low, high = grid.origin[:2], np.array(grid.origin[:2]) + grid.size[:2]
    if np.any(low - np.array(crop[:2]) > RESOLUTION) or np.any(crop[2:] - high > RESOLUTION):
        spans = f"{np.round(low, 3).tolist()} to {np.round(high, 3).tolist()}"
        warnings.warn(
            f"the crop {tuple(np.round(crop, 3).tolist())} reaches beyond the map; the part that "
            f"is there spans {spans} m, and all around it is solid",
            stacklevel=3,
        )


def coarsened(grid: Grid, resolution: float = RESOLUTION, *, cells: int | None = None) -> Grid:
    """The map in larger cells, solid where any part of them is, or lies beside the map.

    Args:
        grid: a map of smaller cells.
        resolution: side of the larger cells [m].
        cells: of the longer side of the whole map, where this is a part of it.

    Raises:
        ValueError: the cells are larger already.
    """
    p, q = _ratio(grid.resolution, resolution, max(grid.occupied.shape) if cells is None else cells)
    if p > q:
        raise ValueError(
            f"the map's cells are {grid.resolution:g} m, but planning needs {resolution} m or "
            "less: scan or draw it finer"
        )
    # Axis by axis: a large cell is solid if one of the small cells in it is. In whole numbers, a
    # small cell is p long and a large one q, so that nothing is rounded.
    occupied = grid.occupied
    for axis in range(2 if grid.planar else 3):
        num = occupied.shape[axis]
        large = np.arange(-(-num * p // q))
        first, end = large * q // p, np.minimum(-(-(large + 1) * q // p), num)
        coarse = np.take(occupied, first, axis)
        for k in range(1, int((end - first).max())):
            coarse |= np.take(occupied, np.minimum(first + k, end - 1), axis)
        # The last large cell may lie partly beside the map, where all is solid.
        if axis < 2 and num * p % q:
            np.moveaxis(coarse, axis, 0)[-1] = True
        occupied = coarse
    return dataclasses.replace(grid, occupied=occupied, resolution=resolution)


def _ratio(small: float, large: float, cells: int) -> tuple[int, int]:
    """The simplest fraction p / q that is the ratio of two sides, or nearly.

    Files hold rounded numbers, as 0.0500000007 of float32. Over all cells of a map the fraction is
    wrong by a twentieth of a small cell at most.
    """
    ratio = small / large
    for q in range(1, 1_000_000):
        p = max(round(ratio * q), 1)
        if abs(p / q - ratio) * cells <= 0.05 * ratio:
            return p, q
    raise ValueError(f"the map's cells of {small} m are too small to be joined to {large} m")


def part_of(
    shape: tuple[int, int],
    resolution: float,
    origin: tuple[float, ...],
    crop: tuple[float, float, float, float] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """First and last index + 1, (2,) each, of the small cells that a part is made of.

    The part is a little larger than asked for, so that it begins where a large cell does.

    Raises:
        ValueError: nothing of the map lies in it.
    """
    if crop is None:
        return np.zeros(2, int), np.array(shape)
    _, q = _ratio(resolution, RESOLUTION, max(shape))
    blocks = (np.array(crop).reshape(2, 2) - origin) / (resolution * q)
    first, last = np.floor(blocks[0]) - 1, np.ceil(blocks[1]) + 1
    first, last = (np.clip(index * q, 0, shape).astype(int) for index in (first, last))
    if not (first < last).all():
        high = np.array(origin) + np.array(shape) * resolution
        raise ValueError(
            f"nothing of the map lies in the crop {tuple(crop)}; it spans {tuple(origin)} to "
            f"{tuple(high.tolist())} m"
        )
    return first, last


def _read_npz(path: Path, crop: tuple[float, float, float, float] | None) -> Grid:
    known = ("occupied", "resolution_m", "origin_m")
    arrays = read_arrays(path, "occupied")
    if unknown := sorted({*arrays} - {*known}):
        raise ValueError(f"it has unknown arrays {', '.join(unknown)}; expected {', '.join(known)}")
    for name, array in arrays.items():
        if array.dtype.kind not in ("biuf" if name == "occupied" else "iuf"):
            raise ValueError(f"its {name} is of type {array.dtype}; expected numbers")
    origin, resolution = arrays.get("origin_m", np.zeros(3)), arrays.get("resolution_m", RESOLUTION)
    if np.size(resolution) != 1:
        raise ValueError(f"its resolution_m has shape {np.shape(resolution)}; expected one number")
    if np.shape(origin) not in ((2,), (3,)):
        raise ValueError(f"its origin_m has shape {np.shape(origin)}; expected (3,): x, y, z in m")
    grid = Grid(
        occupied=arrays["occupied"],
        resolution=float(np.ravel(resolution)[0]),
        origin=tuple(origin.tolist()),
    )
    shape = grid.occupied.shape[:2]
    first, last = part_of(shape, grid.resolution, grid.origin[:2], crop)
    x, y = np.array(grid.origin[:2]) + first * grid.resolution
    part = grid.occupied[first[0] : last[0], first[1] : last[1]]
    grid = dataclasses.replace(grid, occupied=part, origin=(x, y, grid.origin[2]))
    return coarsened(grid, cells=max(shape))
