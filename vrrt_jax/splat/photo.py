"""A user's photograph of the goal: its camera file, lens and mask become an image goal's parts."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vrrt_jax.core.data_file import of_file, read_fields
from vrrt_jax.splat.camera_fields import camera_and_lens, with_extrinsics
from vrrt_jax.splat.foreground import robot_before_background, robot_in_box
from vrrt_jax.splat.images import MIN_OPAQUE
from vrrt_jax.splat.lens import KNOWN
from vrrt_jax.splat.picture_file import read_image
from vrrt_jax.splat.pixels import unit_pixels, valid_mask
from vrrt_jax.splat.types import Camera

_MOST_OF_RIM = 0.75  # white in a robot's mask; more is an inverted one


@dataclasses.dataclass(frozen=True, kw_only=True)
class Photo:
    """What an :class:`~vrrt_jax.ImageGoal` needs of a photograph, without distortion."""

    # (H, W, 3), or (H, W, 4) with the robot's mask, of 0 and 1 unless it is the image's own fourth
    # channel; float32 in [0, 1]
    image: np.ndarray
    camera: Camera
    mask: np.ndarray | None  # (H, W) bool: the pixels that are known; None if all are


def load_photo(
    image: str | Path | np.ndarray,
    camera: str | Path | Mapping[str, Any],
    *,
    extrinsics: str | Path | Mapping[str, Any] | None = None,
    robot_mask: str | Path | np.ndarray | None = None,
    background: str | Path | np.ndarray | None = None,
    box: Sequence[float] | None = None,
    mask: np.ndarray | None = None,
) -> Photo:
    """Read a photograph of the robot at the goal, and make it one of a pinhole camera.

    The robot is told from the rest by one of ``robot_mask``, ``background`` and ``box``, by the
    image's own fourth channel, or, without any of these, by its plain background when it is
    planned to. Masks, like the image, are those of the real camera: both lose distortion together.

    Args:
        image: a file, or an array as of :class:`~vrrt_jax.ImageGoal`.
        camera: a JSON or YAML file, or its fields: see docs/your_photograph.md.
        extrinsics: another one with ``camera_to_world`` or ``world_to_camera``, where the first
            has none.
        robot_mask: a picture that is white on the robot and black elsewhere; or (H, W).
        background: a picture from the same camera without the robot; or (H, W, 3).
        box: x0, y0, x1, y1 [px] around the robot; needs OpenCV.
        mask: (H, W), true where the image is compared, as of :class:`~vrrt_jax.ImageGoal`.

    Raises:
        FileNotFoundError: there is no such file.
        ModuleNotFoundError: OpenCV is needed, and not installed.
        ValueError: a file, a field, or a size makes no sense; the message says what to do.
    """
    pixels = _picture(image, "the goal image")
    fields = camera if isinstance(camera, Mapping) else read_fields(camera)
    if extrinsics is not None:
        given = extrinsics if isinstance(extrinsics, Mapping) else read_fields(extrinsics)
        with _of_source(extrinsics):
            fields = with_extrinsics(fields, given)
    with _of_source(camera):
        pinhole, lens = camera_and_lens(fields, pixels.shape[:2])
    with _of_source(image):
        pixels = _with_mask(pixels, robot_mask, background, box)
    height, width = pixels.shape[:2]
    seen = np.ones((height, width), np.float32)
    if mask is not None:
        seen = valid_mask(mask, height, width)
    if lens is not None:
        straight, known = lens.undistort(np.concatenate([pixels, seen[..., None]], axis=-1))
        pixels, seen = straight[..., :-1], known & (straight[..., -1] > KNOWN)
    if any(option is not None for option in (robot_mask, background, box)):
        # It was told, not rendered: no pixel's share is known.
        pixels[..., 3] = np.round(pixels[..., 3])
    seen = seen > 0
    return Photo(image=pixels, camera=pinhole, mask=None if seen.all() else seen)


def _of_source(source: Any) -> contextlib.AbstractContextManager:
    """What is wrong inside names the source, if that is a file."""
    return of_file(source) if isinstance(source, str | Path) else contextlib.nullcontext()


def _picture(image: Any, what: str) -> np.ndarray:
    """Pixels (H, W, 3) or (H, W, 4) in [0, 1], of a file or an array."""
    return read_image(image) if isinstance(image, str | Path) else unit_pixels(image, what)


def _with_mask(pixels: np.ndarray, robot_mask: Any, background: Any, box: Any) -> np.ndarray:
    """The image (H, W, 3), or (H, W, 4) with what tells the robot."""
    options = {"robot_mask": robot_mask, "background": background, "box": box}
    given = [name for name, value in options.items() if value is not None]
    if len(given) > 1:
        raise ValueError(f"got {' and '.join(given)}; give one of them")
    if not given:
        return pixels
    if pixels.shape[2] == 4 and pixels[..., 3].min() < MIN_OPAQUE:
        raise ValueError(
            f"the goal image has a mask already, its fourth channel; drop {given[0]}, or give an "
            "image without transparency"
        )
    rgb = pixels[..., :3]
    height, width = rgb.shape[:2]
    if robot_mask is not None:
        with _of_source(robot_mask):
            alpha = valid_mask(_picture_of_mask(robot_mask), height, width, "the robot's mask")
            _check_not_inverted(alpha)
    elif background is not None:
        with _of_source(background):
            alpha = robot_before_background(rgb, _picture(background, "the background"))
    else:
        alpha = robot_in_box(rgb, box)
    return np.concatenate([rgb, alpha[..., None]], axis=-1)


def _picture_of_mask(mask: Any) -> np.ndarray:
    """A mask as it is given, or the colors of its file; not empty."""
    picture = np.asarray(mask)
    if isinstance(mask, str | Path):
        picture = read_image(mask)
        # Programs that label pictures write 0 and 1 of 255.
        if picture.max() == np.float32(1 / 255):
            picture = picture * np.float32(255)
    if not picture[..., :3].any() or (picture.ndim == 3 and picture.shape[2] == 4):
        raise ValueError(
            "the robot's mask is all black, or has transparency; expected a picture that is white "
            "on the robot and black elsewhere"
        )
    return picture


def _check_not_inverted(alpha: np.ndarray) -> None:
    """Raise a ValueError if a mask (H, W) is 1 nearly all around its rim, where no robot is."""
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    if rim.mean() > _MOST_OF_RIM:
        raise ValueError(
            f"the robot's mask is white on {100 * rim.mean():.0f} % of the image's rim; expected "
            "white on the robot and black elsewhere: invert it"
        )
