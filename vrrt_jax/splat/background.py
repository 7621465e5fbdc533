"""The robot on a plain background: which pixels are robot, and in which color.

The background has one color, up to noise. A pixel is robot where it differs by more than that
noise. JPEG files blur colors across the robot's outline: on a colorful background the pixels of the
outline are sorted by how much of the robot's own color they have.
"""

import numpy as np
from scipy import ndimage

MAX_TOLERANCE = 0.06  # color difference that counts as noise where the background has none
MIN_TOLERANCE = 1.5 / 255  # the least: that of rounding
OF_RESIDUE = 6.0  # tolerance in units of what a median filter takes from faint pixels
OF_SPREAD = 4.0  # and in units of the border's own spread
MAX_SPREAD = 0.06  # of the border's colors; more is no plain background
MAX_BORDER = 0.4  # largest share of the border that can be robot
MAX_COVERED = 0.9  # largest share of an image that can be robot
MIN_COVERED = 1e-3  # and the least
SPECK = 1e-4  # share of an image below which a patch, or a hole, is noise
RIM_PX = 7  # width of what is around a hole, on both sides
TINT = 0.15  # share of the links' difference that bleeds into the background between them
COLORFUL = 0.12  # difference of channels from which on a background's color bleeds
MIN_FAINT = 3e-3  # share of faint pixels from which on a picture has lost something
BLEED_PX = 3  # how far
OFF_LINE = 0.5  # how far off the line between two colors their mixtures are, of its length
FAINT = 2 / 255  # change of color across an outline that is none
MAX_FAINT = 0.2  # largest share of the robot's outline that can be so
OWN_COLOR = 0.9  # share of its own color from which on a pixel of the robot is not mended


def robot_on_plain_background(
    image: np.ndarray, valid: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Tell the robot from a background of one color, the median of the image's border.

    Args:
        image: (H, W, 3) in [0, 1].
        valid: (H, W) 1 where the image is known, else 0; all of it if None.

    Returns:
        The colors (H, W, 3), without what the background bled into them; and alpha (H, W), 0 or 1.

    Raises:
        ValueError: the background is not plain, or there is nothing or nothing but robot.
    """
    valid = np.ones(image.shape[:2], bool) if valid is None else valid > 0
    known = _border(valid)
    if not known.any():
        known = np.ones_like(known)
    color = np.median(_border(image)[known], axis=0)
    off = image - color
    apart = np.abs(off).max(axis=-1)
    spread = float(np.median(_border(apart)[known]))
    if spread > MAX_SPREAD:
        raise _not_plain(apart > MAX_TOLERANCE)
    is_robot = apart > max(_noise(off, apart), OF_SPREAD * spread)
    tint = 0.0
    # Without loss nothing bleeds.
    if np.ptp(color) > COLORFUL and np.mean(_is_faint(apart)) > MIN_FAINT:
        image, is_robot = _without_bleeding(image, color, apart, is_robot)
        tint = TINT
    is_robot = without_specks(is_robot, apart, spread, tint)
    _check_covered(is_robot, valid)
    _check_outline(is_robot & valid, apart)
    return image, is_robot.astype(np.float32)


def _border(image: np.ndarray) -> np.ndarray:
    """The outermost pixels of an image (H, W, ...)."""
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])


def _noise(off: np.ndarray, apart: np.ndarray) -> float:
    """Color difference that is noise, by what a median filter takes from faint pixels.

    It takes nothing from what is evenly shaded, such as a robot in nearly the background's color,
    but much from the ripples that JPEG leaves beside an edge.
    """
    faint = _is_faint(apart)
    if not faint.any():
        return MIN_TOLERANCE
    # Only around faint pixels: the filter is slow.
    rows, columns = (np.flatnonzero(faint.any(axis=axis)) for axis in (1, 0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    residue = np.abs(off[part] - ndimage.median_filter(off[part], size=(3, 3, 1))).max(axis=-1)
    level = OF_RESIDUE * float(np.median(residue[faint[part]]))
    return float(np.clip(level, MIN_TOLERANCE, MAX_TOLERANCE))


def _is_faint(apart: np.ndarray) -> np.ndarray:
    return (apart > 0.1 * MIN_TOLERANCE) & (apart <= MAX_TOLERANCE)


def _without_bleeding(
    image: np.ndarray, color: np.ndarray, apart: np.ndarray, is_robot: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The image, and what is robot, without mixtures of the robot's and the background's color.

    A mixture lies on the line between the background's color and that of the nearest pixel well
    inside of the robot. It is robot if it is nearer to the robot's color, which it then gets.
    """
    square = np.ones((2 * BLEED_PX + 1,) * 2)
    eroded = ndimage.binary_erosion(apart > MAX_TOLERANCE, square, border_value=1)
    inside = np.asarray(eroded, bool)
    if not inside.any():
        return image, is_robot
    nearest = np.zeros((2, *inside.shape), np.int32)
    distance = np.zeros(inside.shape)
    ndimage.distance_transform_edt(
        ~inside, return_indices=True, distances=distance, indices=nearest
    )
    own = image[nearest[0], nearest[1]] - color
    length2 = np.maximum(np.sum(own**2, axis=-1), 1e-6)
    share = np.sum((image - color) * own, axis=-1) / length2
    off_line = np.sum((image - color - share[..., None] * own) ** 2, axis=-1)
    is_mixture = ~inside & (off_line < OFF_LINE**2 * length2)
    is_robot = is_robot & ~(is_mixture & (share < 0.5))
    is_mended = is_robot & is_mixture & (share < OWN_COLOR) & (distance <= 2 * BLEED_PX)
    return np.where(is_mended[..., None], own + color, image), is_robot


def without_specks(
    is_robot: np.ndarray, apart: np.ndarray, spread: float, tint: float = 0.0
) -> np.ndarray:
    """What is robot (H, W), without specks, and without holes that are not background.

    A hole is small, or most of it differs from the background's color: there the robot's shading
    passes through that color. But what differs less than by ``tint`` times what is around it is
    background between two links that has taken on some of their color.
    """
    speck = SPECK * is_robot.size
    holes, num = _patches(~is_robot)
    index = np.arange(num + 1)
    size = np.bincount(holes.ravel(), minlength=num + 1)
    typical = np.asarray(ndimage.median(apart, holes, index))
    is_robot_color = typical > max(MIN_TOLERANCE, OF_SPREAD * spread)
    if tint:
        rim = ndimage.maximum_filter(holes, RIM_PX) * is_robot  # the hole that is near, if any
        around = np.nan_to_num(np.asarray(ndimage.median(apart, rim, index)))
        is_robot_color &= typical > tint * around
    is_filled = (size <= speck) | is_robot_color
    is_filled[np.unique(_border(holes))] = False  # open to the outside
    is_filled[0] = False  # the robot
    is_robot = is_robot | is_filled[holes]
    patches, num = _patches(is_robot)
    is_kept = np.bincount(patches.ravel(), minlength=num + 1) > speck
    is_kept[0] = False  # the background
    return is_kept[patches]


def _patches(mask: np.ndarray) -> tuple[np.ndarray, int]:
    """Numbers (H, W) of the connected patches of a mask, 0 outside of all, and how many."""
    numbers = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, output=numbers)
    return numbers, int(numbers.max())


def _check_covered(is_robot: np.ndarray, valid: np.ndarray) -> None:
    """Raise a ValueError if there is no robot, or too much where the image is known."""
    if is_robot.mean() < MIN_COVERED:
        raise ValueError(
            "the goal image is blank: every pixel has the color of the border, or nearly; give an "
            "image that shows the robot"
        )
    seen = is_robot & valid
    if seen.mean() > MAX_COVERED or _border(seen).mean() > MAX_BORDER:
        raise _not_plain(seen)


def _check_outline(is_robot: np.ndarray, apart: np.ndarray) -> None:
    """Raise a ValueError if what differs from the background fades into it, as shading does."""
    inside = np.asarray(ndimage.binary_erosion(is_robot, border_value=1), bool)
    outline = is_robot & ~inside
    change = ndimage.maximum_filter(apart, 5) - ndimage.minimum_filter(apart, 5)
    faint = np.mean(change[outline] < FAINT) if outline.any() else 0.0
    if faint > MAX_FAINT:
        raise ValueError(
            f"the background of the goal image is not plain: {100 * faint:.0f} % of the outline of "
            "what differs from its color is no edge, but shading or a shadow; light the background "
            "evenly, or give the robot's mask as fourth channel"
        )


def _not_plain(differs: np.ndarray) -> ValueError:
    return ValueError(
        f"{100 * differs.mean():.0f} % of the goal image differ from the color of its border, and "
        f"{100 * _border(differs).mean():.0f} % of the border itself; expected a plain background: "
        "take the picture before one color, or give the robot's mask as fourth channel"
    )
