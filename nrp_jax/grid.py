"""Occupancy grids: what is solid in a home, cell by cell."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np

RESOLUTION = 0.1  # [m]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """Solid cells; cell (i, j, k) covers ``[i, i + 1) * resolution + origin`` and so on.

    A map of one layer (Z = 1) is planar. Everything outside in x and y is solid.
    """

    occupied: np.ndarray  # (X, Y, Z) bool
    resolution: float = RESOLUTION  # [m]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # corner of cell (0, 0, 0) [m]

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


def make_grid(
    occupied: np.ndarray, resolution: float = RESOLUTION, origin: tuple[float, ...] = (0, 0, 0)
) -> Grid:
    """A checked grid from an array (X, Y) or (X, Y, Z) of booleans or of 0 and 1.

    Raises:
        ValueError: wrong rank, empty, other values, or a resolution that is not positive.
    """
    occupied = np.asarray(occupied)
    if occupied.ndim not in (2, 3) or 0 in occupied.shape:
        raise ValueError(
            f"the map has shape {occupied.shape}; expected (X, Y) or (X, Y, Z) with cells in it"
        )
    if occupied.dtype != bool:
        values = np.unique(occupied)
        if not np.isin(values, [0, 1]).all():
            raise ValueError(
                f"the map holds values from {values[0]} to {values[-1]}; expected booleans, True "
                "where a cell is solid: apply a threshold first"
            )
    if not (np.isfinite(resolution) and resolution > 0):
        raise ValueError(f"the map's resolution is {resolution}; expected metres, such as 0.1")
    if occupied.ndim == 2:
        occupied = occupied[:, :, None]
    x, y, z = (*origin, 0.0)[:3]
    return Grid(
        occupied=occupied.astype(bool),
        resolution=float(resolution),
        origin=(float(x), float(y), float(z)),
    )


def load_map(path: str | Path) -> Grid:
    """Read a map.

    Args:
        path: ``.npz`` with ``occupied``, ``resolution_m`` and ``origin_m``; a ROS map's ``.yaml``
            (unknown pixels count as solid); or an MJCF scene ``.xml``, which is cut into cells.

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
    return readers[path.suffix](path)


def _read_npz(path: Path) -> Grid:
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = dict(data)
    except Exception as error:
        raise ValueError(f"map '{path}' is not a readable .npz file: {error}") from error
    if "occupied" not in arrays:
        raise ValueError(f"map '{path}' has no array 'occupied'; it has: {', '.join(arrays)}")
    origin = tuple(np.ravel(arrays.get("origin_m", np.zeros(3))).tolist())
    return make_grid(arrays["occupied"], float(arrays.get("resolution_m", RESOLUTION)), origin)


def _read_ros(path: Path) -> Grid:
    raise NotImplementedError


def _read_mjcf(path: Path) -> Grid:
    raise NotImplementedError(mujoco.__version__)
