"""Cameras as JSON."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vrrt_jax.core.fields import check_fields
from vrrt_jax.core.precision import single_precision
from vrrt_jax.splat.camera import camera_from_matrix, look_at
from vrrt_jax.splat.types import Camera

PLACED = ("position", "target", "fovy_deg", "up")
CALIBRATED = ("world_to_cam", "focal", "centre")
SIZE = ("width", "height")  # of the image that the camera was calibrated for

_CENTRE = (
    'give "centre": [x, y] in pixels from the corner of the image, half a pixel more than '
    "OpenCV's cx, cy"
)
_FOCAL = 'give "focal": [fx, fy] in pixels'
_UNDISTORT = (
    "images must be without distortion: undistort the goal image, give the camera of that image "
    "and leave this field out"
)
ADVICE = {
    **dict.fromkeys(("cx", "cy", "principal_point", "center"), _CENTRE),
    **dict.fromkeys(("fx", "fy", "focal_length"), _FOCAL),
    **dict.fromkeys(("k", "intrinsics", "camera_matrix"), f"{_FOCAL}, and {_CENTRE[5:]}"),
    **dict.fromkeys(
        ("distortion", "d", "dist", "dist_coeffs", "distortion_coefficients", "k1", "k2"),
        _UNDISTORT,
    ),
    **dict.fromkeys(
        ("cam_to_world", "camera_to_world", "c2w", "extrinsics"),
        'give its inverse as "world_to_cam" if it goes from the camera to the world; x is right, y '
        "down, z forward",
    ),
    **dict.fromkeys(("fovx_deg", "fov", "fov_deg", "fovy"), 'give the vertical one as "fovy_deg"'),
}


@single_precision
def camera_from_dict(fields: Mapping[str, Any], size: tuple[int, ...]) -> Camera:
    """A camera from JSON, for images of a size (H, W).

    Either ``position``, ``target`` and ``fovy_deg`` (and ``up``), or ``world_to_cam`` (4 x 4),
    ``focal`` (a number, or fx, fy) [px] and, unless it is in the middle, ``centre`` [px]. Both
    may have ``width`` and ``height`` [px], which have to be the image's.

    Raises:
        ValueError: a field is missing or unknown, or makes no sense.
    """
    height, width = size
    check_fields(fields, PLACED + CALIBRATED + SIZE, "the camera", ADVICE)
    is_calibrated = any(name in fields for name in CALIBRATED)
    own, other = (CALIBRATED, PLACED) if is_calibrated else (PLACED, CALIBRATED)
    if both := [name for name in other if name in fields]:
        raise ValueError(
            f"the camera has {', '.join(both)} beside "
            f"{', '.join(name for name in own if name in fields)}; give position, target and "
            "fovy_deg, or world_to_cam and focal, not both"
        )
    for name, expected in (("width", width), ("height", height)):
        if fields.get(name, expected) != expected:
            raise ValueError(
                f"the camera's {name} is {fields[name]!r} px, but that of its image is {expected}; "
                "give the camera of this image: a resized image has focal and centre resized, too"
            )
    if missing := [name for name in own[:-1] if name not in fields]:
        raise ValueError(
            f"the camera lacks the field {', '.join(map(repr, missing))}; give position, target "
            "and fovy_deg, or world_to_cam and focal"
        )
    if is_calibrated:
        return camera_from_matrix(
            fields["world_to_cam"],
            focal=fields["focal"],
            principal_point=fields.get("centre"),
            height=height,
            width=width,
        )
    return look_at(
        fields["position"],
        fields["target"],
        fovy_deg=fields["fovy_deg"],
        up=fields.get("up", (0.0, 0.0, 1.0)),
        height=height,
        width=width,
    )


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """A camera as JSON, for :func:`camera_from_dict`."""
    focal = float(camera.focal)
    return {
        "world_to_cam": np.asarray(camera.world_to_cam, float).tolist(),
        "focal": [focal * camera.aspect, focal],
        "centre": np.asarray(camera.principal_point, float).tolist(),
    }
