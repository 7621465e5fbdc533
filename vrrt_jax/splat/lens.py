"""Lenses: images that a real camera has taken become those of a pinhole camera."""

import dataclasses

import numpy as np
from scipy import ndimage

from vrrt_jax.core.opencv import load_opencv

RATIONAL, FISHEYE = "rational", "fisheye"  # what OpenCV calls its usual model, and the other
LENGTHS = {RATIONAL: (4, 5, 8, 12, 14), FISHEYE: (4,)}  # of their coefficients
MAX_LOST = 0.5  # share of the pinhole camera's image that the lens may leave unknown
KNOWN = 0.999  # share of a pixel that has to be known


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lens:
    """How a real camera differs from a pinhole camera, in OpenCV's terms.

    Matrices are as OpenCV has them: pixels count from the middle of the first one.
    """

    model: str  # RATIONAL or FISHEYE
    matrix: np.ndarray  # (3, 3) of the camera that took the image [px]
    coefficients: np.ndarray  # (n,), see LENGTHS
    pinhole: np.ndarray  # (3, 3) of the pinhole camera [px]

    def undistort(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the pinhole camera would have seen.

        Args:
            image: (H, W, C) float32 of the real camera; a mask is one of its channels.

        Returns:
            The image (H, W, C) float32, 0 where it is unknown, and what is known (H, W) bool.

        Raises:
            ModuleNotFoundError: OpenCV is not installed.
            ValueError: hardly anything would be left, so that coefficients and image do not fit.
        """
        cv2 = load_opencv("removing a lens's distortion")
        height, width = image.shape[:2]
        fisheye = cv2.fisheye if self.model == FISHEYE else cv2
        x, y = fisheye.initUndistortRectifyMap(
            self.matrix, self.coefficients, np.eye(3), self.pinhole, (width, height), cv2.CV_32FC1
        )
        x, y = (np.nan_to_num(part, nan=-1e4, posinf=-1e4, neginf=-1e4) for part in (x, y))
        planes = np.concatenate([image, np.ones((height, width, 1), np.float32)], axis=-1)
        straight = cv2.remap(planes, x, y, cv2.INTER_LINEAR)
        known = (straight[..., -1] > KNOWN) & _is_one_to_one(x, y)
        if known.mean() < 1 - MAX_LOST:
            raise ValueError(
                f"with these distortion coefficients {100 * (1 - known.mean()):.0f} % of the image "
                "without distortion are unknown; check that they belong to this camera, and the "
                "distortion model"
            )
        return np.where(known[..., None], straight[..., :-1], 0.0).astype(np.float32), known


def _is_one_to_one(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Where the map (H, W) from pinhole to real pixels does not fold back, as polynomials do."""
    (x_down, x_right), (y_down, y_right) = np.gradient(x), np.gradient(y)
    is_kept = (x_right > 0) & (y_down > 0) & (x_right * y_down > x_down * y_right)
    parts = np.zeros(x.shape, np.int32)
    ndimage.label(is_kept, output=parts)
    # What is beyond a fold is another part, wherever it lies.
    return is_kept & (parts == parts[x.shape[0] // 2, x.shape[1] // 2])
