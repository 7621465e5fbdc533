"""Pixels and masks as users have them, checked and brought to one form."""

from typing import Any

import numpy as np

MIN_BITS_USED = 0.25  # largest value of a picture of 16 bits, as a share; less is of fewer bits
MIN_BRIGHTEST = 0.1  # largest value of a picture; less is of another range
MIN_ON_ROBOT = 0.5  # largest value of the robot's mask


def unit_pixels(image: Any, what: str = "the goal image") -> np.ndarray:
    """An image as float32 (H, W, 3) or (H, W, 4) in [0, 1].

    Args:
        image: (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) of bool, uint8, uint16, or floats in
            [0, 1]. A fourth channel of integers 0 and 1 is a mask, whatever the others go up to.
        what: its name in errors.

    Raises:
        ValueError: another shape or type, values out of range, NaN or infinite.
    """
    image = np.asarray(image)
    # One channel is grey.
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        is_first = image.ndim == 3 and image.shape[0] in (1, 3, 4)
        raise ValueError(
            f"{what} has shape {image.shape}; expected (height, width, 3) for RGB or (height, "
            "width, 4) with the robot's mask as fourth channel, or (height, width) for grey"
            f"{': move the channels to the end with np.moveaxis(image, 0, -1)' * is_first}"
        )
    if image.size == 0:
        raise ValueError(f"{what} is empty: its shape is {image.shape}")
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    if image.dtype == bool:
        image = image.astype(np.float32)
    elif image.dtype in (np.uint8, np.uint16):
        image = _scaled(image, what)
    elif not np.issubdtype(image.dtype, np.floating):
        raise ValueError(
            f"{what} has the type {image.dtype}; expected uint8, uint16, bool, or floats in [0, "
            "1]: image.astype(np.uint8) if its values go up to 255"
        )
    return _in_range(image.astype(np.float32), what)


def _scaled(image: np.ndarray, what: str) -> np.ndarray:
    """Integers as floats in [0, 1]."""
    full = np.iinfo(image.dtype).max
    largest = int(image[..., :3].max())
    if image.dtype == np.uint16 and 0 < largest < MIN_BITS_USED * full:
        raise ValueError(
            f"{what} has 16 bits, but its largest value is {largest} of {full}: scale it to all 16 "
            "bits, or convert it to 8"
        )
    scaled = image / full
    if image.shape[2] == 4 and image[..., 3].max() == 1:
        scaled[..., 3] = image[..., 3]
    return scaled


def _in_range(image: np.ndarray, what: str) -> np.ndarray:
    """The image (H, W, C), of finite floats in [0, 1]."""
    if not np.all(np.isfinite(image)):
        raise ValueError(
            f"{what} has {int(np.sum(~np.isfinite(image)))} values that are NaN or infinite; "
            "replace them and mask their pixels out"
        )
    if image.min() < -1e-3 or image.max() > 1 + 1e-3:
        raise ValueError(
            f"{what} has values from {image.min():.3g} to {image.max():.3g}; expected floats in "
            "[0, 1] or uint8: divide by 255 if they go up to that, and bring a picture of high "
            "dynamic range to [0, 1]"
        )
    return image


def check_brightness(image: np.ndarray) -> None:
    """Raise a ValueError if an image (H, W, C) is as good as black, or its mask is nowhere 1."""
    brightest = image[..., :3].max()
    if brightest < MIN_BRIGHTEST:
        raise ValueError(
            f"the goal image is blank or nearly black: its largest value is {brightest:.3g} of 1; "
            "expected colors in [0, 1] or uint8 up to 255: scale them"
        )
    if image.shape[2] == 4 and 0 < image[..., 3].max() < MIN_ON_ROBOT:
        raise ValueError(
            f"the goal image's mask (its fourth channel) goes up to {image[..., 3].max():.3g} of "
            "1; expected 1 on the robot, and 0 elsewhere"
        )


def valid_mask(mask: Any, height: int, width: int, what: str = "the mask") -> np.ndarray:
    """A mask of pixels that are compared, as float32 (H, W) of 0 and 1.

    Args:
        mask: (H, W) of bool, or numbers 0 and 1, or 0 and 255 (or 65535); also (H, W, C), as
            :func:`~vrrt_jax.read_image` gives it, with the same in all channels.
        height: H of its image [px].
        width: W of its image [px].
        what: its name in errors.

    Raises:
        ValueError: it has another shape or other values, or is nowhere true.
    """
    mask = np.asarray(mask)
    if mask.ndim == 3 and mask.shape[2] in (1, 3) and np.all(mask == mask[..., :1]):
        mask = mask[..., 0]
    if mask.shape != (height, width):
        is_turned = mask.shape == (width, height)
        raise ValueError(
            f"{what} has shape {mask.shape}; expected {(height, width)}, as the image"
            f"{': it is turned by a quarter' * is_turned}"
        )
    if mask.dtype != bool:
        mask = _truths(mask, what)
    if not mask.any():
        raise ValueError(f"{what} hides every pixel; True marks the pixels to compare")
    return mask.astype(np.float32)


def _truths(mask: np.ndarray, what: str) -> np.ndarray:
    """Numbers from 0 to 1, to 255 or to 65535 as truths: those in the upper half."""
    values = mask.astype(np.float64)
    largest = values.max()
    full = next((full for full in (1, 255, 65535) if largest <= full), np.inf)
    if not (
        np.all(np.isfinite(values)) and values.min() >= 0 and (largest > full / 2 or not largest)
    ):
        raise ValueError(
            f"{what} has values from {values.min():g} to {largest:g}; expected False and True, 0 "
            "and 1, or 0 and 255"
        )
    return values > full / 2
