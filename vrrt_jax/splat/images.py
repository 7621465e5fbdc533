"""Goal images: from a picture file or an array to what the loss compares with."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, UnidentifiedImageError

from vrrt_jax.splat.camera import cut, shrunk, stack_cameras
from vrrt_jax.splat.types import Camera, GoalImage

BACKGROUND_TOLERANCE = 0.06  # color difference that still counts as background
OPAQUE = 0.99  # a fourth channel that is nowhere less is no mask
MOST = 0.9  # of an image on a plain background can be robot
KNOWN = 0.75  # share of a shrunk pixel that has to be valid, for its mean to stand for all of it


def read_image(path: str | Path) -> np.ndarray:
    """Read a picture as float32 (H, W, 3) or, with transparency, (H, W, 4), in [0, 1].

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a picture, or truncated.
    """
    try:
        with Image.open(path) as picture:
            has_alpha = "A" in picture.getbands() or "transparency" in picture.info
            pixels = np.asarray(picture.convert("RGBA" if has_alpha else "RGB"))
    except FileNotFoundError:
        raise FileNotFoundError(f"no goal image at '{path}'; make one with: vrrt render") from None
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise ValueError(f"'{path}' is not a readable picture: {error}") from None
    return pixels.astype(np.float32) / 255.0


def write_image(path: str | Path, rgb: np.ndarray, alpha: np.ndarray) -> None:
    """Write a goal image with its alpha as transparency: a PNG (H, W, 4).

    Args:
        path: where to.
        rgb: (H, W, 3) the robot over black, in [0, 1].
        alpha: (H, W).
    """
    straight = rgb / np.maximum(alpha, 1e-3)[..., None]
    pixels = np.concatenate([np.clip(straight, 0, 1), alpha[..., None]], axis=-1)
    Image.fromarray(np.round(255 * pixels).astype(np.uint8), "RGBA").save(path)


def prepare_goal(
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    image_px: int,
    masks: Sequence[np.ndarray | None] | None = None,
) -> tuple[GoalImage, Camera]:
    """Check goal images and shrink them, with their cameras, to the size that is searched at.

    Args:
        images: V arrays (H, W, 3) or (H, W, 4), uint8 or float in [0, 1]. The fourth channel is the
            robot's alpha; without it, or where all of it is opaque, whatever differs from the
            color that prevails on the border is taken to be robot.
        cameras: V cameras of the images' sizes.
        image_px: wanted height; the images are reduced by the nearest whole factor.
        masks: (H, W) bool, False where a pixel is unknown or occluded.

    Returns:
        The goal (V, h, w, ...), whose ``valid`` is the share of a pixel that is, or 0 where that is
        little; and the V cameras stacked.

    Raises:
        ValueError: what is wrong with an image, and what to do.
    """
    if len(images) != len(cameras) or len(images) == 0:
        raise ValueError(
            f"got {len(images)} goal images and {len(cameras)} cameras; give one camera an image"
        )
    masks = masks if masks is not None else [None] * len(images)
    if len(masks) != len(images):
        raise ValueError(
            f"got {len(masks)} masks for {len(images)} goal images; give a list with one, or None, "
            "for each"
        )
    views = []
    for image, camera, mask in zip(images, cameras, masks, strict=True):
        rgb, alpha = _checked(np.asarray(image), camera)
        valid = np.ones_like(alpha) if mask is None else _checked_mask(mask, camera)
        factor = max(1, round(camera.height / image_px))
        share = _blocks(valid, factor)
        known = np.maximum(share, 1e-6)
        views.append(
            (
                _blocks(rgb * valid[..., None], factor) / known[..., None],
                _blocks(alpha * valid, factor) / known,
                np.where(share >= KNOWN, share, 0.0).astype(np.float32),
                shrunk(camera, factor),
            )
        )
    shapes = {view[0].shape for view in views}
    if len(shapes) > 1:
        raise ValueError(
            f"the views have sizes {sorted(s[:2] for s in shapes)}; make them all one size"
        )
    rgb, alpha, valid = (jnp.asarray(np.stack([v[i] for v in views])) for i in range(3))
    goal = GoalImage(rgb=rgb, alpha=alpha, valid=valid)
    return goal, stack_cameras([view[3] for view in views])


def cut_goal(
    goal: GoalImage, cameras: Camera, middle: np.ndarray, px: int
) -> tuple[GoalImage, Camera]:
    """A part of each of V goal images, and the cameras that see it alone.

    Args:
        goal: whole images (V, H, W, ...).
        cameras: V cameras of them.
        middle: (V, 2) of the parts, x, y [px]; moved inwards at the border.
        px: height and width of a part, or what the image has.
    """
    size = np.minimum(px, [cameras.width, cameras.height])
    corner = np.clip(np.round(middle - size / 2), 0, [cameras.width, cameras.height] - size)
    (width, height), corner = size.tolist(), corner.astype(int)

    def parts(images: jax.Array) -> np.ndarray:
        views = zip(np.asarray(images), corner, strict=True)
        return np.stack([view[y : y + height, x : x + width] for view, (x, y) in views])

    return jax.tree.map(parts, goal), cut(cameras, corner, height, width)


def _checked(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The robot over black (H, W, 3), and its alpha (H, W)."""
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise ValueError(
            f"the goal image has shape {image.shape}; expected (height, width, 3) for RGB or "
            "(height, width, 4) with the robot's mask as fourth channel"
        )
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"the goal image is {image.shape[1]}x{image.shape[0]} px but its camera makes "
            f"{camera.width}x{camera.height} px; give the camera of this image, or resize one"
        )
    if image.dtype == np.uint8:
        image = image / 255.0
    image = image.astype(np.float32)
    if not np.all(np.isfinite(image)):
        raise ValueError(
            f"the goal image has {int(np.sum(~np.isfinite(image)))} values that are NaN or "
            "infinite; replace them and mask their pixels out"
        )
    if image.min() < -1e-3 or image.max() > 1 + 1e-3:
        raise ValueError(
            f"the goal image's values go from {image.min():.3g} to {image.max():.3g}; expected "
            "floats in [0, 1] or uint8"
        )
    if image.shape[2] == 4 and image[..., 3].min() < OPAQUE:
        alpha = image[..., 3]
        if alpha.mean() < 1e-4:
            raise ValueError(
                "the goal image's mask (its fourth channel) is empty: no robot to match; check "
                "that the mask is 1 on the robot"
            )
    else:
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        apart = np.abs(image - np.median(border, axis=0))[..., :3].max(axis=-1)
        alpha = (apart > BACKGROUND_TOLERANCE).astype(np.float32)
        if alpha.mean() < 1e-4:
            raise ValueError(
                "the goal image is blank: every pixel has the color of the border; give an "
                "image that shows the robot"
            )
        if alpha.mean() > MOST:
            raise ValueError(
                f"{100 * alpha.mean():.0f} % of the goal image differ from the color of its "
                "border; expected a plain background, or the robot's mask as fourth channel"
            )
    return image[..., :3] * alpha[..., None], alpha


def _checked_mask(mask: np.ndarray, camera: Camera) -> np.ndarray:
    mask = np.asarray(mask)
    if mask.shape != (camera.height, camera.width):
        raise ValueError(
            f"the mask has shape {mask.shape}; expected {(camera.height, camera.width)}, as the "
            "image"
        )
    if not mask.any():
        raise ValueError("the mask hides every pixel; True marks the pixels to compare")
    return mask.astype(bool).astype(np.float32)


def _blocks(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks; what overhangs is padded with zeros, and so not valid."""
    pad = [(0, -image.shape[axis] % factor) for axis in (0, 1)] + [(0, 0)] * (image.ndim - 2)
    image = np.pad(image, pad)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    cut = image.reshape(height, factor, width, factor, *image.shape[2:])
    return cut.mean(axis=(1, 3)).astype(np.float32)
