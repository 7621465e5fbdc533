"""Goal images: check them with their cameras and masks, and shrink them for the search."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from vrrt_jax.splat.background import (
    MAX_BORDER,
    MAX_COVERED,
    MIN_COVERED,
    robot_on_plain_background,
)
from vrrt_jax.splat.camera import cut, shrunk, squared, stack_cameras
from vrrt_jax.splat.pixels import check_brightness, unit_pixels, valid_mask
from vrrt_jax.splat.types import Camera, GoalImage

MIN_PX = 16  # of an image, on each side
MIN_OPAQUE = 0.99  # a fourth channel that is nowhere lower is no mask
MIN_VALID = 0.75  # share of a shrunk pixel that has to be valid for its mean to stand for it
MIN_SEEN = 0.1  # share of the robot that masks have to leave
MIN_AROUND = 0.01  # share of what they leave that has to be background
OUTLINE_PX = 0.7  # how far off the outline of a mask of 0 and 1 is, told from a photograph
SOFT = 0.1  # share of the outline's pixels from which on a mask has more than 0 and 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """A checked goal image in full size, with square pixels."""

    rgb: np.ndarray  # (H, W, 3) the robot over black, 0 where not valid
    alpha: np.ndarray  # (H, W) share of the pixel that the robot covers, 0 where not valid
    valid: np.ndarray  # (H, W) 1 where the pixel is compared, else 0
    camera: Camera
    is_hard: bool = False  # whether alpha was 0 or 1 nearly everywhere, before pixels were squared


def check_views(
    images: Sequence[Any],
    cameras: Sequence[Camera],
    masks: Sequence[Any] | None = None,
) -> list[View]:
    """Check goal images, and tell the robot from its background.

    Args:
        images: V arrays, see :func:`~vrrt_jax.splat.pixels.unit_pixels`. The fourth channel is
            alpha, the share of a pixel that the robot covers. Without it, or if all of it is
            opaque, see :func:`~vrrt_jax.splat.background.robot_on_plain_background`.
        cameras: V cameras of the images' sizes.
        masks: V arrays (H, W), true where a pixel is compared, false where it is unknown or
            occluded; or None for each.

    Raises:
        ValueError: what is wrong with an image, a camera or a mask, and what to do.
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
    views, alphas, valids = [], [], []
    for image, camera, mask in zip(images, cameras, masks, strict=True):
        pixels = _check_size(image, camera)
        height, width = pixels.shape[:2]
        valid = np.ones((height, width), np.float32)
        if mask is not None:
            valid = valid_mask(mask, height, width)
        rgb, alpha = _robot_of(pixels, valid)
        alphas.append(alpha.ravel())
        valids.append(valid.ravel())
        is_hard = _is_hard(alpha, valid)
        planes = np.concatenate([rgb, alpha[..., None], np.ones_like(alpha)[..., None]], axis=-1)
        planes, camera = _square_pixels(planes * valid[..., None], camera)
        views.append(
            View(
                rgb=planes[..., :3],
                alpha=planes[..., 3],
                valid=planes[..., 4],
                camera=camera,
                is_hard=is_hard,
            )
        )
    _check_masks(np.concatenate(alphas), np.concatenate(valids))
    shapes = {view.alpha.shape for view in views}
    if len(shapes) > 1:
        raise ValueError(f"the views have sizes {sorted(shapes)}; make them all one size")
    return views


def shrink_views(views: Sequence[View], image_px: int) -> tuple[GoalImage, Camera]:
    """Shrink V views to the size that is searched at.

    Args:
        views: from :func:`check_views`.
        image_px: wanted height; the images are reduced by the nearest whole factor.

    Returns:
        The goal (V, h, w, ...), and the V cameras stacked. The goal's ``valid`` is the share of a
        shrunk pixel that is valid, or 0 where the share is below 3/4.
    """
    goals, cameras = [], []
    for view in views:
        # The mean of a block is over its valid pixels alone.
        factor = _factor(view, image_px)
        share = _block_means(view.valid, factor)
        known = np.maximum(share, 1e-6)
        goals.append(
            GoalImage(
                rgb=jnp.asarray(_block_means(view.rgb, factor) / known[..., None]),
                alpha=jnp.asarray(_block_means(view.alpha, factor) / known),
                valid=jnp.asarray(np.where(share >= MIN_VALID, share, 0.0).astype(np.float32)),
            )
        )
        cameras.append(shrunk(view.camera, factor))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *goals), stack_cameras(cameras)


def _factor(view: View, image_px: int) -> int:
    return max(1, round(view.camera.height / image_px))


def outline_error_px(views: Sequence[View], image_px: int) -> float:
    """How far off the robot's outline may be in the views shrunk to a height [px].

    It is 0 for the soft masks of renders. A mask of 0 and 1, as one tells or paints it on a
    photograph, is off by up to :data:`OUTLINE_PX` of the photograph's own pixels.
    """
    errors = [OUTLINE_PX / _factor(view, image_px) for view in views if view.is_hard]
    return max(errors, default=0.0)


def _is_hard(alpha: np.ndarray, valid: np.ndarray) -> bool:
    """Whether a mask (H, W) has hardly any pixels between 0 and 1 along its outline."""
    is_soft = (alpha > 0.02) & (alpha < 0.98) & (valid > 0)
    return bool(np.sum(is_soft) < SOFT * _outline(alpha, valid))


def _outline(alpha: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The length (...) of the outline of masks (..., H, W) [px], where they are valid."""
    known = valid > 0
    across = np.abs(np.diff(alpha, axis=-1)) * (known[..., 1:] & known[..., :-1])
    down = np.abs(np.diff(alpha, axis=-2)) * (known[..., 1:, :] & known[..., :-1, :])
    # Of steps along the axes, in the mean over directions.
    return np.pi / 4 * (np.sum(across, axis=(-2, -1)) + np.sum(down, axis=(-2, -1)))


def mask_loss(goal: GoalImage, error_px: float) -> float:
    """The loss of a right pose where the goal's outline is off by so many of its pixels."""
    if not error_px:
        return 0.0
    valid = np.asarray(goal.valid)
    of_view = _outline(np.asarray(goal.alpha), valid) / np.maximum(valid.sum(axis=(1, 2)), 1.0)
    return error_px**2 * float(np.mean(of_view)) / 4


def prepare_goal(
    images: Sequence[Any],
    cameras: Sequence[Camera],
    image_px: int,
    masks: Sequence[Any] | None = None,
) -> tuple[GoalImage, Camera]:
    """Check goal images and shrink them: :func:`check_views`, then :func:`shrink_views`."""
    return shrink_views(check_views(images, cameras, masks), image_px)


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


def _check_size(image: Any, camera: Camera) -> np.ndarray:
    """The image (H, W, 3) or (H, W, 4), of the camera's size."""
    image = unit_pixels(image)
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"the goal image is {image.shape[1]}x{image.shape[0]} px but its camera makes "
            f"{camera.width}x{camera.height} px; give the camera of this image, or resize one"
        )
    if min(image.shape[:2]) < MIN_PX:
        raise ValueError(
            f"the goal image is {image.shape[1]}x{image.shape[0]} px; expected at least {MIN_PX} "
            "px on a side"
        )
    check_brightness(image)
    return image


def _robot_of(image: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The robot over black (H, W, 3), and its alpha (H, W); checked where ``valid`` (H, W) is 1."""
    if image.shape[2] == 4 and image[..., 3].min() < MIN_OPAQUE:
        rgb, alpha = image[..., :3], image[..., 3]
        _check_alpha(alpha, valid)
    else:
        rgb, alpha = robot_on_plain_background(image[..., :3], valid)
    return rgb * alpha[..., None], alpha


def _check_alpha(alpha: np.ndarray, valid: np.ndarray) -> None:
    """Raise a ValueError for a mask (H, W) of the robot that can hardly be one."""
    seen = alpha * valid
    covered = seen.mean()
    of_border = np.mean([row.mean() for row in (seen[0], seen[-1], seen[:, 0], seen[:, -1])])
    if alpha.mean() < MIN_COVERED:
        raise ValueError(
            "the goal image's mask (its fourth channel) is empty, or nearly: no robot to match; "
            "check that the mask is 1 on the robot"
        )
    if covered > MAX_COVERED or of_border > MAX_BORDER:
        raise ValueError(
            f"the goal image's mask (its fourth channel) covers {100 * covered:.0f} % of the image "
            f"and {100 * of_border:.0f} % of its border; expected 1 on the robot and 0 elsewhere: "
            "is it inverted?"
        )


def _check_masks(alpha: np.ndarray, valid: np.ndarray) -> None:
    """Raise a ValueError if the masks (n,) of all views hide the robot, or all but the robot."""
    seen = np.sum(valid * alpha)
    # What is hidden may have any alpha: where most is seen, that says nothing.
    if not seen or (seen < MIN_SEEN * alpha.sum() and valid.mean() < 0.5):
        left = f"only {100 * seen / alpha.sum():.1f} %" if seen else "nothing"
        raise ValueError(
            f"the masks leave {left} of the robot; True marks the pixels to compare: are they "
            "inverted?"
        )
    if valid.sum() - seen < MIN_AROUND * valid.sum():
        raise ValueError(
            "the masks leave nothing but the robot, so that nothing says where it ends; True marks "
            "the pixels to compare, background too: give the robot's own mask as fourth channel of "
            "the image"
        )


def _square_pixels(planes: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Planes (H, W, C) on square pixels, and the camera of these."""
    narrow = squared(camera)
    if narrow is camera:
        return planes, camera
    box = (0, 0, min(narrow.width * camera.aspect, camera.width), camera.height)
    resized = [
        Image.fromarray(planes[..., channel]).resize(
            (narrow.width, narrow.height), Image.Resampling.BILINEAR, box=box
        )
        for channel in range(planes.shape[2])
    ]
    return np.stack([np.asarray(plane) for plane in resized], axis=-1), narrow


def _block_means(image: np.ndarray, factor: int) -> np.ndarray:
    """Means over blocks. Blocks that overhang are padded with zeros, which are not valid."""
    pad = [(0, -image.shape[axis] % factor) for axis in (0, 1)] + [(0, 0)] * (image.ndim - 2)
    image = np.pad(image, pad)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image.reshape(height, factor, width, factor, *image.shape[2:])
    return blocks.mean(axis=(1, 3)).astype(np.float32)
