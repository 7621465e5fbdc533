"""Cameras as fields of a file: placed, with a focal length, or a whole calibration."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vrrt_jax.core.fields import check_fields
from vrrt_jax.core.precision import single_precision
from vrrt_jax.splat.calibration import calibrated, is_calibration
from vrrt_jax.splat.camera import camera_from_matrix, look_at
from vrrt_jax.splat.extrinsics import POSES, WHAT_TO_WRITE, world_to_camera
from vrrt_jax.splat.lens import Lens
from vrrt_jax.splat.types import Camera

PLACED = ("position", "target", "fovy_deg", "up")
FOCAL = ("focal", "centre")  # beside a pose
SIZE = ("width", "height")  # of the image that the camera was calibrated for
_BARE = ("translation", "rotation", "position", "orientation", "transform", "pose")

_CENTRE = (
    'give "centre": [x, y] in pixels from the corner of the image, half a pixel more than '
    "OpenCV's cx, cy"
)
_FOCAL = 'give "focal": [fx, fy] in pixels'
_UNDISTORT = (
    "give the calibration, with camera_matrix and image size, and the image is undistorted; or "
    "undistort it before, and leave this field out"
)
ADVICE = {
    **dict.fromkeys(("cx", "cy", "principal_point", "center"), _CENTRE),
    **dict.fromkeys(("fx", "fy", "focal_length"), _FOCAL),
    "intrinsics": 'give "camera_matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]',
    **dict.fromkeys(
        ("distortion", "d", "dist", "dist_coeffs", "distortion_coefficients", "k1", "k2"),
        _UNDISTORT,
    ),
    **dict.fromkeys(
        ("cam_to_world", "c2w", "extrinsics"),
        'give it as "camera_to_world" or "world_to_camera"; x is right, y down, z forward',
    ),
    **dict.fromkeys(("fovx_deg", "fov", "fov_deg", "fovy"), 'give the vertical one as "fovy_deg"'),
}


def camera_from_dict(fields: Mapping[str, Any], size: tuple[int, ...]) -> Camera:
    """A pinhole camera from JSON, for images of a size (H, W); see :func:`camera_and_lens`.

    Raises:
        ValueError: a field is missing or unknown, or makes no sense, or the camera has distortion.
    """
    camera, lens = camera_and_lens(fields, size)
    if lens is not None:
        raise ValueError(
            "the camera has distortion, and this image has none; give distortion_coefficients as []"
        )
    return camera


@single_precision
def camera_and_lens(fields: Mapping[str, Any], size: tuple[int, ...]) -> tuple[Camera, Lens | None]:
    """A pinhole camera from JSON or YAML, for images of a size (H, W), and the lens before it.

    Either ``position``, ``target`` and ``fovy_deg`` (and ``up``); or ``camera_to_world`` or
    ``world_to_camera``, ``focal`` (a number, or fx, fy) [px] and, unless it is in the middle,
    ``centre`` [px]. Both may have ``width`` and ``height`` [px], which have to be the image's. Or a
    calibration, see :func:`~vrrt_jax.splat.calibration.calibrated`; only that may have a lens.

    Raises:
        ValueError: a field is missing or unknown, or makes no sense.
    """
    height, width = size[:2]
    if is_calibration(fields):
        return calibrated(fields, size)
    check_fields(fields, (*PLACED, *POSES, *FOCAL, *SIZE), "the camera", ADVICE)
    placed = [name for name in PLACED if name in fields]
    posed = [name for name in (*POSES, *FOCAL) if name in fields]
    if placed and posed:
        raise ValueError(
            f"the camera has {', '.join(placed)} beside {', '.join(posed)}; give position, target "
            "and fovy_deg, or world_to_camera and focal, not both"
        )
    for name, expected in (("width", width), ("height", height)):
        if fields.get(name, expected) != expected:
            raise ValueError(
                f"the camera's {name} is {fields[name]!r} px, but that of its image is {expected}; "
                "give the camera of this image: a resized image has focal and centre resized, too"
            )
    needed = ("focal",) if posed else PLACED[:3]
    if missing := [name for name in needed if name not in fields]:
        raise ValueError(
            f"the camera lacks the field {', '.join(map(repr, missing))}; give position, target "
            "and fovy_deg, or world_to_camera and focal, or a calibration with camera_matrix"
        )
    if posed:
        camera = camera_from_matrix(
            world_to_camera(fields),
            focal=fields["focal"],
            principal_point=fields.get("centre"),
            height=height,
            width=width,
        )
        return camera, None
    camera = look_at(
        fields["position"],
        fields["target"],
        fovy_deg=fields["fovy_deg"],
        up=fields.get("up", (0.0, 0.0, 1.0)),
        height=height,
        width=width,
    )
    return camera, None


def with_extrinsics(fields: Any, extrinsics: Any) -> dict[str, Any]:
    """A camera's fields with the pose that another file holds.

    Raises:
        ValueError: the other file holds something else, or the camera has a pose already.
    """
    if not isinstance(fields, Mapping):
        raise ValueError(f"the camera is a {type(fields).__name__}; expected an object with fields")
    check_fields(extrinsics, POSES, "the extrinsics", dict.fromkeys(_BARE, WHAT_TO_WRITE))
    if both := [name for name in (*POSES, *PLACED) if name in fields]:
        raise ValueError(
            f"the camera has {', '.join(both)} already; give the extrinsics there or in a file of "
            "their own, not in both"
        )
    return {**fields, **extrinsics}


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """A camera as JSON, for :func:`camera_from_dict`."""
    focal = float(camera.focal)
    return {
        "world_to_cam": np.asarray(camera.world_to_cam, float).tolist(),
        "focal": [focal * camera.aspect, focal],
        "centre": np.asarray(camera.principal_point, float).tolist(),
    }
