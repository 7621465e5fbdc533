"""Matrices as calibrations have them: lists, or OpenCV's rows, cols and data."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vrrt_jax.core.fields import check_fields


def coefficient_row(value: Any) -> np.ndarray:
    """Distortion coefficients (n,), from a list, a row or a column."""
    array = _numbers(value, "distortion_coefficients")
    if array.ndim > 2 or (array.ndim == 2 and 1 not in array.shape):
        raise ValueError(
            f"distortion_coefficients have shape {array.shape}; expected one row: k1, k2, p1, p2, "
            "k3"
        )
    return array.ravel()


def matrix_of(value: Any, shape: tuple[int, int], name: str) -> np.ndarray:
    """A matrix, also from its rows one after the other."""
    array = _numbers(value, name)
    if array.shape != shape and array.shape != (shape[0] * shape[1],):
        raise ValueError(f"{name} has shape {array.shape}; expected {shape}")
    return array.reshape(shape)


def _numbers(value: Any, name: str) -> np.ndarray:
    """Finite numbers from lists, or from OpenCV's object with rows, cols and data."""
    shape: tuple[int, ...] | None = None
    is_opencv = isinstance(value, Mapping)
    if is_opencv:
        check_fields(value, ("rows", "cols", "data", "dt", "type_id"), name)
    try:
        if is_opencv:
            shape, value = (int(value["rows"]), int(value["cols"])), value["data"]
        array = np.asarray(value, np.float64)
        array = array if shape is None else array.reshape(shape)
    except KeyError as error:
        raise ValueError(f"{name} lacks {error}; expected rows, cols and data") from None
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"{name} is no matrix; expected lists of numbers, or rows, cols and data that fit"
        ) from None
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} has numbers that are not finite; calibrate again")
    return array
