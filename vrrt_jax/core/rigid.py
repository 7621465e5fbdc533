"""Rigid transforms that users give."""

from typing import Any

import numpy as np

_LARGEST = 1e9  # [m] beyond it products overflow
NOT_A_ROTATION = 3e-3  # how far a rotation is off if it is written with three decimals


def rigid(transform: Any, what: str) -> np.ndarray:
    """The transform (4, 4) in float64; what few decimals have bent is straightened.

    Args:
        transform: (4, 4).
        what: its name, for messages.

    Raises:
        ValueError: it is not rigid.
    """
    try:
        matrix = np.asarray(transform, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} is not made of numbers; expected 4 rows of 4") from None
    if matrix.shape != (4, 4):
        raise ValueError(
            f"{what} has shape {matrix.shape}; expected a rigid (4, 4) transform, 4 rows of 4"
        )
    last_row = [0.0, 0.0, 0.0, 1.0]
    if not np.allclose(matrix[3], last_row, rtol=0, atol=1e-6):
        is_transposed = np.allclose(matrix[:, 3], last_row, rtol=0, atol=1e-6)
        raise ValueError(
            f"{what} is not a rigid (4, 4) transform: its last row is {matrix[3].tolist()}; "
            f"expected 0 0 0 1{': transpose the matrix' if is_transposed else ''}"
        )
    rotation = matrix[:3, :3]
    if (
        not np.all(np.abs(matrix) < _LARGEST)
        or not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=NOT_A_ROTATION)
        or np.linalg.det(rotation) < 0
    ):
        raise ValueError(
            f"{what} is not a rigid (4, 4) transform; its upper left 3 x 3 block must be a "
            "rotation, and all of it finite"
        )
    if np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-5):
        return matrix
    # The nearest rotation.
    left, _, right = np.linalg.svd(rotation)
    straight = matrix.copy()
    straight[:3, :3] = left @ right
    return straight
