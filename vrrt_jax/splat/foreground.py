"""The robot in front of anything: told from a picture without it, or from a box around it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from vrrt_jax.core.opencv import load_opencv
from vrrt_jax.splat.background import MAX_COVERED, MIN_COVERED, without_specks
from vrrt_jax.splat.pixels import unit_pixels

BLUR_PX = 0.7  # of both pictures, against noise
SURE, LIKELY = 0.07, 0.035  # differences of robot and background, and of what touches such
OF_NOISE = 6.0, 3.5  # the same in units of the noise
EDGE_PX = 2  # width of the robot's outline, of which what has less ...
OF_CONTRAST = 0.3  # ... than this share of the contrast there is background
MAX_NOISE = 0.05  # more is another picture
DARK, BRIGHT = 0.06, 0.97  # colors between these tell the exposure
MAX_EXPOSURE = 4.0  # of the one picture over that of the other
GRABCUT_PX = 300  # longer side of what is cut; more is slow
GRABCUT_ROUNDS = 5
AROUND = 0.3  # of what is outside of the box as much is looked at, in units of its sides
MIN_OUTSIDE = 0.05  # share of the image that has to be outside of the box
OF_BOX = 0.02, 0.97  # least and largest share of the box that is robot


def robot_before_background(image: Any, background: Any) -> np.ndarray:
    """Tell the robot from what the same camera sees without it.

    The two pictures may differ in exposure, white balance and noise. What else has moved or changed
    counts as robot, and so do hard shadows.

    Args:
        image: (H, W, 3), see :func:`~vrrt_jax.splat.pixels.unit_pixels`.
        background: (H, W, 3) the same view without the robot.

    Returns:
        Alpha (H, W) float32: 1 on the robot, else 0.

    Raises:
        ValueError: the pictures are of different sizes, or nearly nothing or all of them differs.
    """
    image, background = (
        unit_pixels(picture, what)[..., :3]
        for picture, what in ((image, "the goal image"), (background, "the background"))
    )
    if image.shape != background.shape:
        raise ValueError(
            f"the background is {background.shape[1]}x{background.shape[0]} px, the goal image "
            f"{image.shape[1]}x{image.shape[0]} px; take both with the same camera, and resize "
            "neither"
        )
    expected = np.minimum(_exposure(image, background) * background, 1.0)
    blur = (BLUR_PX, BLUR_PX, 0)
    off = ndimage.gaussian_filter(image - expected, blur)
    apart = np.abs(off).max(axis=-1)
    noise = 1.4826 * float(np.median(np.abs(off)))
    sure, likely = (max(a, b * noise) for a, b in zip((SURE, LIKELY), OF_NOISE, strict=True))
    is_robot = ndimage.binary_propagation(apart > sure, mask=apart > likely)
    is_robot = without_specks(_sharpened(np.asarray(is_robot, bool), apart), apart, noise)
    if noise > MAX_NOISE or is_robot.mean() > MAX_COVERED:
        raise ValueError(
            f"{100 * is_robot.mean():.0f} % of the goal image differ from the background, by a "
            f"noise of {noise:.2g} of 1; take both from the same place, in the same light"
        )
    if is_robot.mean() < MIN_COVERED:
        raise ValueError(
            "the goal image hardly differs from its background; give a background without the "
            "robot, and a goal image with it"
        )
    return is_robot.astype(np.float32)


def _sharpened(is_robot: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """What is robot (H, W), without what the blur has put around it."""
    inside = np.asarray(ndimage.binary_erosion(is_robot, iterations=EDGE_PX, border_value=1), bool)
    contrast = ndimage.maximum_filter(apart, 2 * EDGE_PX + 1)
    return inside | (is_robot & (apart > OF_CONTRAST * contrast))


def _exposure(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Gain (3,) that makes the background as bright as the image, of what both show."""
    gains = np.ones(3, np.float32)
    for channel in range(3):
        a, b = image[..., channel].ravel(), background[..., channel].ravel()
        usable = (a > DARK) & (b > DARK) & (a < BRIGHT) & (b < BRIGHT)
        ratios = np.log(a[usable] / b[usable])
        if ratios.size < MIN_COVERED * a.size:
            continue
        # The densest ratio: what the robot covers has any.
        counts, edges = np.histogram(ratios, bins=200, range=(-2.0, 2.0))
        peak = edges[np.argmax(np.convolve(counts, np.ones(3), "same"))] + 0.01
        near = ratios[np.abs(ratios - peak) < 0.1]
        gains[channel] = np.exp(np.median(near if near.size else ratios))
    return np.clip(gains, 1 / MAX_EXPOSURE, MAX_EXPOSURE)


def robot_in_box(image: Any, box: Sequence[float]) -> np.ndarray:
    """Cut the robot out of a box around it, by colors inside and outside (GrabCut).

    Args:
        image: (H, W, 3), see :func:`~vrrt_jax.splat.pixels.unit_pixels`.
        box: x0, y0, x1, y1 [px] from the upper left corner; all of the robot is inside.

    Returns:
        Alpha (H, W) float32: 1 on the robot, else 0, and between on its outline.

    Raises:
        ModuleNotFoundError: OpenCV is not installed.
        ValueError: the box is not inside the image or holds nearly all of it, or nearly nothing or
            all in it is robot.
    """
    pixels = unit_pixels(image)[..., :3]
    height, width = pixels.shape[:2]
    x0, y0, x1, y1 = checked_box(box, height, width)
    cv2 = load_opencv("a mask from a box")
    rim = AROUND * max(x1 - x0, y1 - y0)
    left, top = int(max(x0 - rim, 0)), int(max(y0 - rim, 0))
    part = np.round(255 * pixels[top : int(y1 + rim), left : int(x1 + rim)]).astype(np.uint8)
    scale = min(1.0, GRABCUT_PX / max(part.shape[:2]))
    small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    corners = scale * (np.array([x0, y0, x1, y1]) - [left, top, left, top])
    (low_x, low_y), (high_x, high_y) = np.floor(corners[:2]), np.ceil(corners[2:])
    inside = np.s_[int(low_y) : int(high_y), int(low_x) : int(high_x)]
    labels[inside] = cv2.GC_PR_FGD
    cv2.setRNGSeed(0)  # it begins with random clusters
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(small, labels, None, *models, GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    is_robot = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    is_robot = without_specks(is_robot, np.zeros(is_robot.shape), 0.0)
    share = is_robot[inside].mean()
    if not OF_BOX[0] <= share <= OF_BOX[1]:
        raise ValueError(
            f"{100 * share:.0f} % of the box look like robot, by the colors inside and outside of "
            "it; give a box closer around the robot, a background picture, or a mask"
        )
    alpha = np.zeros((height, width), np.float32)
    of_part = cv2.resize(
        is_robot.astype(np.float32), part.shape[1::-1], interpolation=cv2.INTER_LINEAR
    )
    alpha[top : top + part.shape[0], left : left + part.shape[1]] = np.clip(of_part, 0.0, 1.0)
    return alpha


def checked_box(box: Sequence[float], height: int, width: int) -> tuple[float, ...]:
    """The box x0, y0, x1, y1 [px] in an image, or a ValueError."""
    try:
        values = np.asarray(box, np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.array(np.nan)
    if values.shape != (4,) or not np.all(np.isfinite(values)):
        raise ValueError(f"the box is {box!r}; expected four numbers x0, y0, x1, y1 in pixels")
    x0, y0, x1, y1 = values.tolist()
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise ValueError(
            f"the box from {x0:g}, {y0:g} to {x1:g}, {y1:g} is not inside the image of "
            f"{width}x{height} px; expected x0, y0, x1, y1 in pixels from the upper left corner, "
            "with x0 < x1 and y0 < y1"
        )
    if (x1 - x0) * (y1 - y0) > (1 - MIN_OUTSIDE) * width * height:
        raise ValueError(
            "the box holds all of the image, or nearly, so that nothing shows the background; "
            "give a box closer around the robot"
        )
    return x0, y0, x1, y1
