"""Self-models: a robot's trained splats in several levels of detail, in one small file."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.arrays_file import MOST_WEIGHTS, float32_of, read_arrays
from vrrt_jax.core.files import replacing
from vrrt_jax.core.precision import single_precision
from vrrt_jax.splat.types import SplatModel

FORMAT = 3
CLOSE_UP = "close_up"
MAX_ENLARGEMENT = 1.125  # a level serves images up to so many times its own height
# Fields of the splats, and what the file calls them.
ARRAYS = {
    "mean": "mean",
    "radius": "radius",
    "density": "density",
    "rgb": "rgb",
    "view_color_gradient": "shade",
    "link": "link",
    "tau": "tau",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Level:
    """One level of detail, trained for images of one height."""

    splats: SplatModel
    size_px: int  # image height that it was trained at [px]
    psnr_db: float  # on unseen poses and cameras, over RGB and alpha
    # The loss divided by the share of the image that the robot covers. 95 % of correct poses have a
    # lower one, in whatever light the image is taken.
    match_threshold: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class SelfModel:
    """A robot's appearance, for :func:`vrrt_jax.plan`."""

    robot: str
    joint_names: tuple[str, ...]
    levels: tuple[Level, ...]  # by rising size
    close_up: Level  # for a part of a larger image around the outermost link
    seed: int  # of the first round of training
    info: dict[str, Any]  # how it was trained: numbers of images, steps, seconds, versions

    def level_for(self, height_px: int) -> Level:
        """The coarsest level trained for images about this high or higher, or the finest."""
        fitting = [level for level in self.levels if MAX_ENLARGEMENT * level.size_px >= height_px]
        return fitting[0] if fitting else self.levels[-1]


@single_precision
def save_self_model(model: SelfModel, path: str | Path) -> None:
    """Write a compressed ``.npz``, atomically."""
    path = Path(path)
    named = {**{str(i): level for i, level in enumerate(model.levels)}, CLOSE_UP: model.close_up}
    header = {
        "format": FORMAT,
        "robot": model.robot,
        "joint_names": list(model.joint_names),
        "seed": model.seed,
        "info": model.info,
        "levels": {
            name: {
                "size_px": level.size_px,
                "psnr_db": level.psnr_db,
                "match_bar": level.match_threshold,
                "starts": level.splats.starts,
            }
            for name, level in named.items()
        },
    }
    arrays: dict[str, Any] = {"header": np.array(json.dumps(header))}
    for name, level in named.items():
        for field, array in ARRAYS.items():
            value = np.asarray(getattr(level.splats, field))
            # Half precision rounds a center by at most 0.25 mm within 1 m of its link's frame.
            small = np.uint8 if array == "link" else np.float16 if value.ndim else np.float32
            arrays[f"{name}/{array}"] = value.astype(small)
    with replacing(path) as file:
        np.savez_compressed(file, **arrays)


@single_precision
def load_self_model(path: str | Path) -> SelfModel:
    """Read a self-model.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is truncated, or no self-model, or of another format.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no self-model at '{path}'; train one with: vrrt fit")
    arrays = read_arrays(path, "header", most=MOST_WEIGHTS)
    try:
        header = json.loads(str(arrays["header"]))
        if header["format"] != FORMAT:
            raise ValueError(f"it has self-model format {header['format']!r}, expected {FORMAT}")
        names = tuple(header["joint_names"])
        levels = {
            name: _level(name, numbers, arrays, 1 + len(names))
            for name, numbers in header["levels"].items()
        }
        close_up = levels.pop(CLOSE_UP)
        if not levels or not all(isinstance(name, str) for name in (header["robot"], *names)):
            raise ValueError("its header lacks levels, or names")
        return SelfModel(
            robot=header["robot"],
            joint_names=names,
            levels=tuple(levels.values()),
            close_up=close_up,
            seed=header["seed"],
            info=header["info"],
        )
    except (
        KeyError,
        TypeError,
        AttributeError,
        ValueError,
        OverflowError,
        RecursionError,
    ) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise ValueError(
            f"'{path}' is not a readable self-model ({what}); train it again with: vrrt fit"
        ) from None


def _level(
    name: str, numbers: dict[str, Any], arrays: dict[str, np.ndarray], num_links: int
) -> Level:
    """A level of a file.

    Raises:
        KeyError: a part is missing.
        ValueError: it has another shape, or values that no training leaves.
    """
    found = {}
    for field, array in ARRAYS.items():
        value = float32_of(arrays[f"{name}/{array}"], f"{name}/{array}")
        found[field] = value = value.astype(np.int32) if array == "link" else value
        if value.shape != (found["mean"].shape[:1], ())[array == "tau"] + (3,) * (
            array in ("mean", "rgb", "shade")
        ):
            raise ValueError(f"its {name}/{array} has shape {value.shape}")
    link, starts = found["link"], tuple(numbers["starts"])
    if not len(link) or link.min() < 0 or link.max() >= num_links or np.any(np.diff(link) < 0):
        raise ValueError(f"its {name}/link is not of a robot with {num_links} links")
    if not (np.all(found["radius"] > 0) and found["tau"] > 0):
        raise ValueError(f"its {name}/radius or {name}/tau is not positive")
    if starts[:1] != (0,) or any(type(n) is not int or not 0 <= n < len(link) for n in starts):
        raise ValueError(f"its level {name} starts at {starts}")
    told = [numbers[field] for field in ("size_px", "psnr_db", "match_bar")]
    if not all(type(n) in (int, float) and 0 < n < 1e5 for n in told):
        raise ValueError(f"its level {name} has {told} as size_px, psnr_db and match_bar")
    return Level(
        splats=SplatModel(**{k: jnp.asarray(v) for k, v in found.items()}, starts=starts),
        size_px=numbers["size_px"],
        psnr_db=numbers["psnr_db"],
        match_threshold=numbers["match_bar"],
    )
