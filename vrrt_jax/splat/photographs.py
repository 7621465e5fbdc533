"""Pictures as a camera would take them: exposure, noise, JPEG, and masks that are estimated."""

import dataclasses
import io

import numpy as np
from PIL import Image

from vrrt_jax.splat.background import robot_on_plain_background
from vrrt_jax.splat.mujoco_images import Picture

MASKS = ("true", "estimated")
BACKGROUND = (0.1, 0.5, 0.2)  # in front of which masks are estimated


@dataclasses.dataclass(frozen=True, kw_only=True)
class Photograph:
    """How a picture is taken."""

    brightness: float = 1.0  # of the light; what would be brighter than white is white
    noise: float = 0.0  # standard deviation of each channel of each pixel, of 1 for white
    jpeg: int | None = None  # quality of the file, from 1 to 95; None keeps every pixel
    mask: str = "true"  # one of MASKS; "estimated" is told from a plain background
    background: tuple[float, float, float] = BACKGROUND  # color of it

    def __post_init__(self):
        """Refuse what is no photograph."""
        if self.mask not in MASKS:
            raise ValueError(f"unknown mask '{self.mask}'; have: {', '.join(MASKS)}")
        if self.jpeg is not None and not 1 <= self.jpeg <= 95:
            raise ValueError(f"the JPEG quality is {self.jpeg}; expected 1 to 95")


def photograph(
    picture: Picture, how: Photograph, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Take a picture.

    Args:
        picture: the robot over black, in the light of training.
        how: the picture is taken.
        rng: of the noise.

    Returns:
        rgb (H, W, 3), the robot over black, and alpha (H, W), float32.

    Raises:
        ValueError: the robot cannot be told from the background.
    """
    alpha = picture.alpha[..., None]
    image = np.minimum(how.brightness * picture.rgb, alpha)
    is_estimated = how.mask == "estimated"
    if is_estimated:
        image = image + (1.0 - alpha) * np.asarray(how.background, np.float32)
    if how.noise:
        image = np.clip(image + how.noise * rng.normal(size=image.shape), 0.0, 1.0)
    if how.jpeg is not None:
        image = _through_jpeg(image, how.jpeg)
    if is_estimated:
        image, mask = robot_on_plain_background(image.astype(np.float32))
        alpha = mask[..., None]
        image = image * alpha
    return np.minimum(image, alpha).astype(np.float32), alpha[..., 0]


def _through_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray(np.round(255 * image).astype(np.uint8)).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file), np.float32) / 255
