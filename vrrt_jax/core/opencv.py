"""OpenCV, which removes distortion, cuts robots out and finds camera poses; an optional extra."""

import importlib.util
from typing import Any


def load_opencv(purpose: str) -> Any:
    """The package ``cv2``.

    Args:
        purpose: what it is needed for, such as "a lens with distortion".

    Raises:
        ModuleNotFoundError: it is not installed; the message says how to install it.
    """
    if importlib.util.find_spec("cv2") is None:
        raise ModuleNotFoundError(f"{purpose} needs OpenCV: pip install 'vrrt-jax[photo]'")
    import cv2  # pyright: ignore[reportMissingImports]

    return cv2
