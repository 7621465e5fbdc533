"""Goal images: read and write files, check arrays, and shrink them for the search."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, UnidentifiedImageError

from vrrt_jax.splat.camera import cut, shrunk, stack_cameras
from vrrt_jax.splat.types import Camera, GoalImage

BACKGROUND_TOLERANCE = 0.06  # color difference that still counts as background
MIN_OPAQUE = 0.99  # a fourth channel that is nowhere lower is no mask
MIN_COVERED = 1e-4  # least share of an image that the robot has to cover
MAX_COVERED = 0.9  # largest share of an image on a plain background that can be robot
MIN_VALID = 0.75  # share of a shrunk pixel that has to be valid for its mean to stand for it


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
        path: of the file.
        rgb: (H, W, 3) the robot over black, in [0, 1].
        alpha: (H, W) share of each pixel that the robot covers, in [0, 1].
    """
    # Files hold colors that are not multiplied by alpha.
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
        images: V arrays (H, W, 3) or (H, W, 4), uint8 or float in [0, 1]. The fourth channel is
            alpha, the share of a pixel that the robot covers. Without it, or if all of it is
            opaque, a pixel is taken to be robot where it differs from the border's median color.
        cameras: V cameras of the images' sizes.
        image_px: wanted height; the images are reduced by the nearest whole factor.
        masks: V arrays (H, W) bool, False where a pixel is unknown or occluded; or None for each.

    Returns:
        The goal (V, h, w, ...), and the V cameras stacked. The goal's ``valid`` is the share of a
        shrunk pixel that is valid, or 0 where the share is below 3/4.

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
        rgb, alpha = _check_image(np.asarray(image), camera)
        valid = np.ones_like(alpha) if mask is None else _check_mask(mask, camera)
        # The mean of a block is over its valid pixels alone.
        factor = max(1, round(camera.height / image_px))
        share = _block_means(valid, factor)
        known = np.maximum(share, 1e-6)
        views.append(
            (
                _block_means(rgb * valid[..., None], factor) / known[..., None],
                _block_means(alpha * valid, factor) / known,
                np.where(share >= MIN_VALID, share, 0.0).astype(np.float32),
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
    """Cut a part out of each goal image, and out of its camera's view.

    Args:
        goal: whole images (V, H, W, ...).
        cameras: their V cameras.
        middle: (V, 2) middles of the parts, x, y [px]; moved inwards at the border.
        px: height and width of a part; at most the image's.

    Returns:
        The parts (V, px, px, ...), and the V cameras that see them.
    """
    size = np.minimum(px, [cameras.width, cameras.height])
    corner = np.clip(np.round(middle - size / 2), 0, [cameras.width, cameras.height] - size)
    (width, height), corner = size.tolist(), corner.astype(int)

    def parts(images: jax.Array) -> np.ndarray:
        views = zip(np.asarray(images), corner, strict=True)
        return np.stack([view[y : y + height, x : x + width] for view, (x, y) in views])

    return jax.tree.map(parts, goal), cut(cameras, corner, height, width)


def _check_image(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The robot over black (H, W, 3), and its alpha (H, W)."""
    image = _check_pixels(image, camera)
    has_mask = image.shape[2] == 4 and image[..., 3].min() < MIN_OPAQUE
    alpha = image[..., 3] if has_mask else _alpha_on_plain_background(image)
    if has_mask and alpha.mean() < MIN_COVERED:
        raise ValueError(
            "the goal image's mask (its fourth channel) is empty: no robot to match; check that "
            "the mask is 1 on the robot"
        )
    return image[..., :3] * alpha[..., None], alpha


def _check_pixels(image: np.ndarray, camera: Camera) -> np.ndarray:
    """The image as float32 (H, W, 3) or (H, W, 4) in [0, 1]."""
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
    return image


def _alpha_on_plain_background(image: np.ndarray) -> np.ndarray:
    """Alpha (H, W), 1 where the image differs from the median color of its border."""
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    apart = np.abs(image - np.median(border, axis=0))[..., :3].max(axis=-1)
    alpha = (apart > BACKGROUND_TOLERANCE).astype(np.float32)
    if alpha.mean() < MIN_COVERED:
        raise ValueError(
            "the goal image is blank: every pixel has the color of the border; give an image that "
            "shows the robot"
        )
    if alpha.mean() > MAX_COVERED:
        raise ValueError(
            f"{100 * alpha.mean():.0f} % of the goal image differ from the color of its border; "
            "expected a plain background, or the robot's mask as fourth channel"
        )
    return alpha


def _check_mask(mask: np.ndarray, camera: Camera) -> np.ndarray:
    """The mask (H, W) as 0 and 1."""
    mask = np.asarray(mask)
    if mask.shape != (camera.height, camera.width):
        raise ValueError(
            f"the mask has shape {mask.shape}; expected {(camera.height, camera.width)}, as the "
            "image"
        )
    if not mask.any():
        raise ValueError("the mask hides every pixel; True marks the pixels to compare")
    return mask.astype(bool).astype(np.float32)


def _block_means(image: np.ndarray, factor: int) -> np.ndarray:
    """Means over blocks. Blocks that overhang are padded with zeros, which are not valid."""
    pad = [(0, -image.shape[axis] % factor) for axis in (0, 1)] + [(0, 0)] * (image.ndim - 2)
    image = np.pad(image, pad)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image.reshape(height, factor, width, factor, *image.shape[2:])
    return blocks.mean(axis=(1, 3)).astype(np.float32)
