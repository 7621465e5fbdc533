"""Calibrations as OpenCV and ROS write them: a pinhole camera, and the lens before it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vrrt_jax.core.fields import check_fields
from vrrt_jax.splat.calibration_numbers import coefficient_row, matrix_of
from vrrt_jax.splat.camera import camera_from_matrix
from vrrt_jax.splat.extrinsics import POSES, world_to_camera
from vrrt_jax.splat.lens import FISHEYE, LENGTHS, RATIONAL, Lens
from vrrt_jax.splat.types import Camera

# What is read, by the names that it has in files. The first one is used in messages.
NAMES = {
    "camera_matrix": ("camera_matrix", "K", "k", "mtx"),
    "distortion_coefficients": ("distortion_coefficients", "dist_coeffs", "dist", "D", "d"),
    "distortion_model": ("distortion_model",),
    "fisheye_model": ("fisheye_model",),  # of OpenCV's own calibration program
    "image_width": ("image_width", "width"),
    "image_height": ("image_height", "height"),
    "projection_matrix": ("projection_matrix", "P", "p"),
    "rectification_matrix": ("rectification_matrix", "R", "r"),
    "binning_x": ("binning_x",),
    "binning_y": ("binning_y",),
    "roi": ("roi",),
    "image_scale": ("image_scale",),  # of this project: size of the image over the calibrated one
    "rectified": ("rectified",),  # of this project: whether the image has lost its distortion
}
# What does not change what the camera sees.
TOLD = (
    *("header", "camera_name", "calibration_time", "nframes", "nr_of_frames", "board_width"),
    *("board_height", "square_size", "marker_size", "aspectRatio", "fix_aspect_ratio", "flags"),
    *("avg_reprojection_error", "reprojection_error", "rms", "per_view_reprojection_errors"),
    *("extrinsic_parameters", "image_points", "grid_points", "cameraId"),
)
MODELS = {
    "plumb_bob": (RATIONAL, (4, 5)),
    "rational_polynomial": (RATIONAL, (8, 12, 14)),
    "equidistant": (FISHEYE, LENGTHS[FISHEYE]),
    "fisheye": (FISHEYE, LENGTHS[FISHEYE]),
}
ALIKE = 0.03  # how far the shares of x and y are apart at most, if an image was scaled
MIDDLE = 0.05, 0.95  # where principal points are, in units of the image
NO_MODEL = ("", "none")  # as ROS says it of cameras without distortion
ADVICE = {
    **dict.fromkeys(
        ("cam_to_world", "c2w", "extrinsics", "rvec", "tvec"),
        'give "camera_to_world" or "world_to_camera", 4 x 4',
    ),
    **dict.fromkeys(
        ("focal", "centre", "fx", "fy", "cx", "cy"), "they are in camera_matrix: give it alone"
    ),
}


def is_calibration(fields: Any) -> bool:
    """Whether a camera's fields are those of a calibration."""
    return isinstance(fields, Mapping) and any(name in fields for name in NAMES["camera_matrix"])


def calibrated(fields: Mapping[str, Any], size: tuple[int, ...]) -> tuple[Camera, Lens | None]:
    """The pinhole camera of a calibration, for images of a size (H, W), and its lens.

    Args:
        fields: of OpenCV's or ROS's file, in one of the spellings of :data:`NAMES`, with the
            extrinsics of :func:`~vrrt_jax.splat.extrinsics.world_to_camera`.
        size: height and width of the image [px].

    Returns:
        The camera of the image without distortion; None in place of the lens if there is none.

    Raises:
        ValueError: a field is missing, unknown or makes no sense, or is of another image.
    """
    spelled = {name for names in NAMES.values() for name in names}.difference(NAMES)
    named = {name: value for name, value in fields.items() if name not in (*spelled, *TOLD)}
    check_fields(named, (*NAMES, *POSES), "the camera", ADVICE)
    read = {name: _one_of(fields, names) for name, names in NAMES.items()}
    scale = _scale(read, size)
    _check_plain(read)
    matrix = _camera_matrix(matrix_of(read["camera_matrix"], (3, 3), "camera_matrix"))
    is_rectified = _truth(read["rectified"], "rectified")
    _check_middle(matrix, read)
    model, coefficients = (RATIONAL, np.zeros(0)) if is_rectified else _distortion(read)
    straight = _projection(read["projection_matrix"])
    # An image without distortion stays as it was taken.
    if straight is None or not (is_rectified or coefficients.any()):
        straight = matrix
    matrix, pinhole = _scaled(matrix, scale), _scaled(straight, scale)
    lens = None
    if coefficients.any():
        lens = Lens(model=model, matrix=matrix, coefficients=coefficients, pinhole=pinhole)
    camera = camera_from_matrix(
        world_to_camera(fields),
        focal=(pinhole[0, 0], pinhole[1, 1]),
        # Ours counts from the corner of the image, OpenCV's from the middle of its first pixel.
        principal_point=(pinhole[0, 2] + 0.5, pinhole[1, 2] + 0.5),
        height=size[0],
        width=size[1],
    )
    return camera, lens


def _one_of(fields: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """The value of the field that has one of several names; None without any."""
    given = [name for name in names if name in fields]
    if len(given) > 1:
        raise ValueError(f"the camera has {' and '.join(given)}, which mean the same; give one")
    return fields[given[0]] if given else None


def _scale(read: Mapping[str, Any], size: tuple[int, ...]) -> float:
    """The image's size over that of the calibration, as the file says it."""
    calibrated_size = []
    for name in ("image_height", "image_width"):
        value = read[name]
        if value is None:
            raise ValueError(
                f"the calibration lacks the field {name!r}; give the size [px] of the images that "
                "it was made with, so that another image's calibration is not taken"
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
            raise ValueError(f"{name} is {value!r}; expected a whole number of pixels")
        calibrated_size.append(int(value))
    told = read["image_scale"]
    scale = 1.0 if told is None else told
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0.01 <= scale <= 100:
        raise ValueError(f"image_scale is {scale!r}; expected a number such as 0.5")
    expected = [float(scale) * side for side in calibrated_size]
    if not np.allclose(expected, size[:2], rtol=0, atol=1e-3):
        height, width = calibrated_size
        times = "" if told is None else f" times image_scale {scale:g}"
        ratio = size[1] / width
        advice = (
            f'if the image was resized, give "image_scale": {ratio:g}'
            if np.isclose(ratio, size[0] / height, rtol=1e-6)
            else "a cropped image has another principal point: calibrate for it"
        )
        raise ValueError(
            f"the calibration is for images of {width}x{height} px{times}, this one has "
            f"{size[1]}x{size[0]} px; give the calibration of this image: {advice}"
        )
    return float(scale)


def _check_plain(read: Mapping[str, Any]) -> None:
    """Raise a ValueError for what would have to be used, and is not."""
    for name in ("binning_x", "binning_y"):
        if read[name] not in (None, 0, 1):
            raise ValueError(
                f"{name} is {read[name]!r}; expected 0 or 1: give camera_matrix and image size of "
                "the binned image"
            )
    roi = read["roi"] or {}
    names = ("x_offset", "y_offset", "height", "width", "do_rectify")
    check_fields(roi, names, "the camera's roi")
    sides = {"width": read["image_width"], "height": read["image_height"]}
    if any(roi.get(name) not in (None, 0, sides.get(name, 0)) for name in names[:4]):
        raise ValueError(
            f"the camera has the region of interest {dict(roi)}; expected the whole image: give "
            "camera_matrix and image size of the part, and leave roi out"
        )
    turn = read["rectification_matrix"]
    if turn is not None:
        turn = matrix_of(turn, (3, 3), "rectification_matrix")
        if turn.any() and not np.allclose(turn, np.eye(3), atol=1e-6):
            raise ValueError(
                "rectification_matrix turns the camera, as that of a stereo pair does; expected "
                "the identity: give the calibration of the single camera"
            )


def _camera_matrix(matrix: np.ndarray) -> np.ndarray:
    """The matrix (3, 3), if it is one of a camera."""
    if not matrix.any():
        raise ValueError("camera_matrix is all zeros: the camera is not calibrated; calibrate it")
    if np.allclose(matrix[:2, 2], 0) and matrix[2, :2].any():
        raise ValueError(
            f"camera_matrix has its principal point in its last row, {matrix[2].tolist()}: "
            "transpose it; expected [fx, 0, cx], [0, fy, cy], [0, 0, 1]"
        )
    if not np.allclose(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1], atol=1e-9):
        raise ValueError(
            f"camera_matrix is {matrix.tolist()}; expected [fx, 0, cx], [0, fy, cy], [0, 0, 1], "
            "without skew"
        )
    return matrix


def _check_middle(matrix: np.ndarray, read: Mapping[str, Any]) -> None:
    """Raise a ValueError for the camera matrix (3, 3) of an image of another size."""
    size = np.array([read["image_width"], read["image_height"]], float)
    low, high = MIDDLE[0] * size, MIDDLE[1] * size
    if np.any((matrix[:2, 2] < low) | (matrix[:2, 2] > high)):
        raise ValueError(
            f"camera_matrix has its principal point at {matrix[:2, 2].tolist()}, at the rim of an "
            f"image of {size[0]:g}x{size[1]:g} px or outside; give the calibration of this size"
        )
    # In a matrix of an image of half the size, both halves are quarters.
    x, y = matrix[:2, 2] / size
    times = round(0.5 / min(x, y))
    if times > 1 and abs(x - y) < ALIKE and abs(times * (x + y) - 1) < ALIKE * times:
        raise ValueError(
            f"camera_matrix has its principal point at {matrix[:2, 2].tolist()}, as in the middle "
            f"of an image of 1/{times} of {size[0]:g}x{size[1]:g} px; give image_width and "
            'image_height of the image that it was calibrated with, and "image_scale" if yours has '
            "another size"
        )


def _projection(value: Any) -> np.ndarray | None:
    """The pinhole camera (3, 3) of the image without distortion; None if the file has none."""
    if value is None:
        return None
    matrix = matrix_of(value, (3, 4), "projection_matrix")
    if not matrix.any():
        return None  # as drivers leave it that know none
    if matrix[:, 3].any():
        raise ValueError(
            f"projection_matrix has {matrix[:, 3].tolist()} as its last column, as the second "
            "camera of a stereo pair; expected zeros: give the calibration of the single camera"
        )
    return _camera_matrix(matrix[:, :3])


def _distortion(read: Mapping[str, Any]) -> tuple[str, np.ndarray]:
    """OpenCV's model, and its coefficients (n,)."""
    value = read["distortion_coefficients"]
    named = read["distortion_model"]
    is_fisheye = _truth(read["fisheye_model"], "fisheye_model")
    if named is not None and named not in (*MODELS, *NO_MODEL):
        raise ValueError(
            f"unknown distortion_model {named!r}; have: {', '.join(MODELS)}: undistort the image "
            "with the program that made it, and give the pinhole camera"
        )
    if value is None:
        raise ValueError(
            "the calibration says nothing of distortion; give distortion_coefficients, [] if there "
            'is none, or "rectified": true if the image has lost it'
        )
    coefficients = coefficient_row(value)
    if not coefficients.any():
        return RATIONAL, np.zeros(0)
    if named in MODELS:
        model, lengths = MODELS[named]
        if is_fisheye and model != FISHEYE:
            raise ValueError(f"fisheye_model contradicts distortion_model {named!r}; give one")
    elif is_fisheye:
        model, lengths = FISHEYE, LENGTHS[FISHEYE]
    else:
        model, lengths = RATIONAL, LENGTHS[RATIONAL][1:]
        if len(coefficients) == 4:
            raise ValueError(
                "4 distortion coefficients are k1, k2, p1, p2 of a usual lens, or k1 to k4 of a "
                'fisheye; say which: "distortion_model": "plumb_bob" or "fisheye"'
            )
    if len(coefficients) not in lengths:
        raise ValueError(
            f"got {len(coefficients)} distortion coefficients; expected "
            f"{' or '.join(map(str, lengths))} for {named or 'OpenCV'}"
        )
    return model, coefficients


def _scaled(matrix: np.ndarray, scale: float) -> np.ndarray:
    """The camera matrix (3, 3) of a resized image, whose first pixel's middle is elsewhere."""
    scaled = matrix.copy()
    scaled[:2, :2] *= scale
    scaled[:2, 2] = scale * (matrix[:2, 2] + 0.5) - 0.5
    return scaled


def _truth(value: Any, name: str) -> bool:
    if value not in (None, 0, 1):
        raise ValueError(f"{name} is {value!r}; expected true or false")
    return bool(value)
