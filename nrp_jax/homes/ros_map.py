"""Maps of ROS's map_server: a YAML file and an image, read as map_server reads them."""

import contextlib
import dataclasses
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from nrp_jax.homes.grid import FARTHEST, Grid, coarsened, part_of
from nrp_jax.homes.memory import check_memory
from vrrt_jax.core.data_file import read_yaml
from vrrt_jax.core.pictures import open_picture

_MODES = ("trinary", "scale", "raw")
_FIELDS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
_UNKNOWN = 205  # gray that map savers write for unknown
_STRIP = 1 << 22  # pixels converted at a time
_WORDS = {False: ("0", "n", "no", "false", "off"), True: ("1", "y", "yes", "true", "on")}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _About:
    """What the YAML file says."""

    image: Path
    resolution: float  # [m]
    origin: tuple[float, float]  # [m]
    mode: str
    negate: bool
    occupied_from: float
    free_below: float


def read_ros_map(path: Path, crop: tuple[float, float, float, float] | None) -> Grid:
    """A planar map in cells of 0.1 m; what is not known to be free is solid.

    Args:
        path: of the YAML file.
        crop: x0, y0, x1, y1 of the part to read [m]; all of it if None.

    Raises:
        ValueError: the file or its image is malformed, or of a kind that cannot be read.
    """
    about = _read_about(path)
    with _opened(about.image) as image:
        width, height = image.size
        first, last = part_of((width, height), about.resolution, about.origin, crop)
        # The top row lies at the largest y.
        box = (first[0], height - last[1], last[0], height - first[1])
        solid = _solid(image, about, box)
    corner = np.array(about.origin) + np.array(first) * about.resolution
    grid = Grid(
        occupied=solid[::-1].T, resolution=about.resolution, origin=(corner[0], corner[1], 0.0)
    )
    return coarsened(grid, cells=max(width, height))


def _read_about(path: Path) -> _About:
    """The fields of the YAML file, each checked."""
    try:
        about = read_yaml(path)
    except ValueError as error:
        raise ValueError(f"it is not a YAML file: {' '.join(str(error).split())}") from error
    wanted = ("image", "resolution", "origin")
    if not isinstance(about, dict) or any(name not in about for name in wanted):
        have = ", ".join(map(str, about)) if isinstance(about, dict) else type(about).__name__
        raise ValueError(
            f"it is not a map_server file with image, resolution and origin; it has: {have}"
        )
    if unused := [str(name) for name in about if name not in _FIELDS]:
        warnings.warn(
            f"the fields {', '.join(unused)} of '{path.name}' are not used; known ones: "
            f"{', '.join(_FIELDS)}",
            stacklevel=4,
        )
    if not isinstance(about["image"], str) or not about["image"].strip():
        raise ValueError(f"its image is {about['image']!r}; expected the name of a file")
    mode = about.get("mode", "trinary")
    if not isinstance(mode, str) or mode.lower() not in _MODES:
        raise ValueError(f"its mode is {mode!r}; expected one of {', '.join(_MODES)}")
    negate = _truth(about.get("negate", 0))
    if negate and mode.lower() == "raw":
        raise ValueError("its mode is raw and negate is set, which map servers read differently")
    resolution = _number(about["resolution"], "resolution")
    if not resolution > 0:
        raise ValueError(f"its resolution is {resolution}; expected meters a pixel, such as 0.05")
    thresholds = []
    for name, usual in (("occupied_thresh", 0.65), ("free_thresh", 0.196)):
        thresholds.append(_number(about.get(name, usual), name))
        if not 0 <= thresholds[-1] <= 1:
            raise ValueError(f"its {name} is {thresholds[-1]}; expected a share from 0 to 1")
    return _About(
        image=path.parent / Path(about["image"].strip()).expanduser(),
        resolution=resolution,
        origin=_origin(about["origin"]),
        mode=mode.lower(),
        negate=negate,
        occupied_from=thresholds[0],
        free_below=thresholds[1],
    )


def _origin(value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"its origin is {value!r}; expected x, y and yaw, as [-1.0, -2.0, 0.0]")
    x, y, yaw = (_number(part, "origin") for part in value)
    if abs(math.remainder(yaw, 2 * math.pi)) > 1e-6:
        raise ValueError(f"it is turned by {yaw} rad; rotate the image and set yaw to 0")
    if max(abs(x), abs(y)) > FARTHEST:
        raise ValueError(f"its origin is {value!r}; expected places within {FARTHEST:g} m of 0")
    return x, y


def _number(value: Any, name: str) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # YAML reads 1e-2 as text
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"its {name} has {value!r}; expected a finite number")
    return number


def _truth(value: Any) -> bool:
    """A truth in any of YAML's spellings."""
    word = str(value).strip().lower()
    for truth, words in _WORDS.items():
        if word in words:
            return truth
    raise ValueError(f"its negate is {value!r}; expected 0 or 1")


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image of any size: the user's own file is no bomb."""
    if not path.is_file():
        raise ValueError(f"its image '{path}' does not exist; expected it beside the YAML file")
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with open_picture(path) as image:
            if image.mode.startswith(("I", "F")):
                raise ValueError(
                    f"its image has pixels of kind '{image.mode}'; expected 8 bits a pixel: "
                    "convert it"
                )
            width, height = image.size
            what = f"its image of {width} x {height} pixels"
            try:
                check_memory(width * height * (1 if image.mode in ("1", "L", "P") else 4), what)
            except ValueError as error:
                raise ValueError(f"{error}; save that part as an image of its own") from error
            yield image
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise ValueError(f"its image '{path}' cannot be read: {error}") from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _solid(image: Image.Image, about: _About, box: tuple[int, int, int, int]) -> np.ndarray:
    """Solid pixels (H, W) bool of a part: left, top, right, bottom."""
    if image.has_transparency_data:
        kind = "RGBA"
    else:
        kind = "L" if image.mode in ("1", "L") else "RGB"
    left, top, right, bottom = box
    solid = np.empty((bottom - top, right - left), bool)
    # Alpha is averaged in where the mode is trinary. Otherwise what is not opaque is unknown.
    averaged = {"L": 1, "RGB": 3, "RGBA": 4 if about.mode == "trinary" else 3}[kind]
    free = _free(about, np.arange(255 * averaged + 1) / averaged)
    unknown = ((255 - _UNKNOWN) if about.negate else _UNKNOWN) * averaged
    if averaged == 4:
        unknown = 3 * _UNKNOWN + 255
    is_unknown_free = False
    rows = max(1, _STRIP // max(right - left, 1))
    for row in range(top, bottom, rows):
        strip = image.crop((left, row, right, min(row + rows, bottom))).convert(kind)
        pixels = np.asarray(strip).reshape(strip.height, strip.width, -1)
        sums = pixels[..., :averaged].sum(axis=2, dtype=np.uint16)
        part = ~free[sums]
        if kind == "RGBA" and averaged == 3:
            part |= pixels[..., 3] < 255
        solid[row - top : row - top + strip.height] = part
        is_unknown_free |= bool(free[unknown]) and bool((sums == unknown).any())
    if is_unknown_free and about.mode != "raw":
        why, what = f"free_thresh is {about.free_below}", "set it to 0.196"
        if averaged == 4:
            why, what = "the mean counts the alpha channel too", "save the image without one"
        warnings.warn(
            f"gray {_UNKNOWN} in '{about.image.name}', which map savers write for unknown, is free "
            f"as {why}; {what} to make unknown solid",
            stacklevel=5,
        )
    return solid


def _free(about: _About, shade: np.ndarray) -> np.ndarray:
    """Whether pixels of mean values (n,) from 0 to 255 are free."""
    if about.mode == "raw":  # the value is the chance in percent that the pixel is solid
        return np.round(shade) / 100 < about.free_below
    if about.negate:
        shade = 255 - shade
    occupancy = (255 - shade) / 255
    return (occupancy < about.free_below) & ~(occupancy > about.occupied_from)
