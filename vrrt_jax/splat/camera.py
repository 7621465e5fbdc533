"""Cameras: from a point of view to pixels."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.rigid import rigid
from vrrt_jax.splat.types import Camera

# Of the vertical field of view [degree]. Less is an angle in radians, more a focal length in mm.
MIN_FOVY_DEG, MAX_FOVY_DEG = 4.0, 150.0
MAX_ASPECT = 2.0  # ratio of the two focal lengths
MAX_DISTANCE_M = 100.0  # from the world's origin; farther ones are in mm
_LARGEST = 1e9  # of any number of a camera
USUAL_CENTRE = 0.3, 0.7  # in units of the image; elsewhere it may be of another image


@single_precision
def look_at(
    eye: Sequence[float],
    target: Sequence[float],
    *,
    fovy_deg: float = 45.0,
    height: int = 480,
    width: int = 480,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> Camera:
    """Place a camera at ``eye`` that points at ``target``.

    Args:
        eye: camera center in the world [m].
        target: a point on the optical axis [m].
        fovy_deg: vertical field of view [degree].
        height: image height [px].
        width: image width [px].
        up: direction that points up in the image.

    Returns:
        The camera; its principal point is the middle of the image.

    Raises:
        ValueError: the eye is at the target, the view direction is parallel to ``up``, or a value
            is not finite, of another length or out of range.
    """
    eye_, target_ = _vector(eye, 3, "the camera's position"), _vector(target, 3, "its target")
    up_ = _vector(up, 3, "its direction up")
    fovy_deg = _number(fovy_deg, "fovy_deg")
    if not MIN_FOVY_DEG <= fovy_deg <= MAX_FOVY_DEG:
        raise ValueError(
            f"fovy_deg is {fovy_deg:g}; expected the vertical field of view in degrees (not in "
            f"radians), from {MIN_FOVY_DEG:g} to {MAX_FOVY_DEG:g}"
        )
    forward = target_ - eye_
    # The rows of the rotation are the camera's axes: right, down, forward.
    right = np.cross(forward, up_)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(
            f"camera at {eye_.tolist()} looking at {target_.tolist()}: the view direction is zero "
            f"or parallel to up={up_.tolist()}; move the eye or choose another up"
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    world_to_cam = np.eye(4)
    world_to_cam[:3, :3] = rotation
    world_to_cam[:3, 3] = -rotation @ eye_
    # Half the image's height spans half the field of view.
    focal = 0.5 * height / np.tan(np.radians(fovy_deg) / 2)
    return camera_from_matrix(world_to_cam, focal=float(focal), height=height, width=width)


@single_precision
def camera_from_matrix(
    world_to_cam: np.ndarray,
    *,
    focal: float | Sequence[float],
    height: int,
    width: int,
    principal_point: Sequence[float] | None = None,
) -> Camera:
    """Make a camera from its calibration. Images have no distortion: undistort them before.

    Args:
        world_to_cam: (4, 4) rigid transform; the camera points along +z, with x right and y down.
        focal: focal length [px]; or fx, fy.
        height: image height [px].
        width: image width [px].
        principal_point: x, y [px], from the corner of the image, half a pixel more than OpenCV's
            cx, cy; the middle of the image if None.

    Raises:
        ValueError: the matrix is not rigid, or a value is not finite, of another length or out of
            range.
    """
    world_to_cam = rigid(world_to_cam, "world_to_cam")
    distance = np.linalg.norm(world_to_cam[:3, 3])
    if distance > MAX_DISTANCE_M:
        raise ValueError(
            f"the camera is {distance:.0f} m away from the world's origin; expected at most "
            f"{MAX_DISTANCE_M:g}: give positions in meters, not in mm"
        )
    height, width = _size(height, "height"), _size(width, "width")
    is_pair = np.ndim(focal) == 1
    fx, fy = _vector(focal, 2, "focal") if is_pair else [_number(focal, "focal")] * 2
    if not (fx > 0 and fy > 0 and 1 / MAX_ASPECT <= fx / fy <= MAX_ASPECT):
        raise ValueError(
            f"focal is {focal}; expected a positive number of pixels, or fx, fy that are about the "
            "same"
        )
    fovy_deg = 2 * np.degrees(np.arctan(0.5 * height / fy))
    if fovy_deg > MAX_FOVY_DEG:
        raise ValueError(
            f"a focal length of {fy:g} px is a field of view of {fovy_deg:.0f} degrees on an image "
            f"of {height} px; expected at most {MAX_FOVY_DEG:g}: give it in pixels, not in mm"
        )
    middle = [width / 2, height / 2]
    point = _vector(middle if principal_point is None else principal_point, 2, "centre")
    if principal_point is not None and np.all(np.abs(point) <= 1):
        raise ValueError(
            f"the principal point (centre) is {point.tolist()}; expected pixels, about "
            f"{middle} in the middle of the image"
        )
    low, high = (share * np.array([width, height]) for share in USUAL_CENTRE)
    if np.any((point < low) | (point > high)):
        warnings.warn(
            f"the principal point (centre) is {point.tolist()}, far from the middle of an image of "
            f"{width}x{height} px, {middle}: is it of this image, and not of one of another size? "
            "Right after cropping",
            stacklevel=3,
        )
    return Camera(
        world_to_cam=jnp.asarray(world_to_cam, jnp.float32),
        focal=jnp.float32(fy),
        principal_point=jnp.asarray(point, jnp.float32),
        height=height,
        width=width,
        aspect=float(fx / fy),
    )


def _vector(values: Any, length: int, what: str) -> np.ndarray:
    """Finite numbers (length,) in float64, or a ValueError."""
    try:
        vector = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        vector = np.array(np.nan)
    if vector.shape != (length,) or not np.all(np.abs(vector) < _LARGEST):
        raise ValueError(f"{what} is {values!r}; expected {length} finite numbers")
    return vector


def _number(value: Any, what: str) -> float:
    """A finite number, or a ValueError."""
    return float(_vector([value], 1, what)[0])


def _size(value: Any, what: str) -> int:
    """A number of pixels, or a ValueError."""
    number = _number(value, what)
    if number < 1 or number != int(number):
        raise ValueError(f"{what} is {value!r}; expected a whole, positive number of pixels")
    return int(number)


@single_precision
def orbit(
    *,
    azimuth_deg: float,
    elevation_deg: float,
    distance: float,
    target: Sequence[float] = (0.0, 0.0, 0.0),
    fovy_deg: float = 45.0,
    height: int = 480,
    width: int = 480,
) -> Camera:
    """Place a camera by angles around ``target``, as MuJoCo's free camera does.

    Args:
        azimuth_deg: heading of the view direction about z [degree]; 0 is along +x.
        elevation_deg: pitch of the view direction [degree]; negative is downwards.
        distance: from the camera to the target [m].
        target: the point (3,) in the middle of the image [m].
        fovy_deg: vertical field of view [degree].
        height: image height [px].
        width: image width [px].

    Raises:
        ValueError: as of :func:`look_at`, or the distance is not positive.
    """
    distance = _number(distance, "distance")
    if distance <= 0:
        raise ValueError(f"distance is {distance:g}; expected a positive number of meters")
    azimuth = np.radians(_number(azimuth_deg, "azimuth_deg"))
    elevation = np.radians(_number(elevation_deg, "elevation_deg"))
    forward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    eye = _vector(target, 3, "its target") - distance * forward
    return look_at(eye.tolist(), target, fovy_deg=fovy_deg, height=height, width=width)


def squared(camera: Camera) -> Camera:
    """The same view with square pixels: of the same height, and less than a pixel narrower."""
    if camera.aspect == 1:
        return camera
    return dataclasses.replace(
        camera,
        principal_point=camera.principal_point / jnp.array([camera.aspect, 1.0]),
        width=int(camera.width / camera.aspect + 1e-6),
        aspect=1.0,
    )


def shrunk(camera: Camera, factor: int) -> Camera:
    """The same view with blocks of ``factor`` x ``factor`` pixels as one; rounds the size up."""
    return dataclasses.replace(
        camera,
        focal=camera.focal / factor,
        principal_point=camera.principal_point / factor,
        height=-(-camera.height // factor),
        width=-(-camera.width // factor),
    )


def cut(camera: Camera, corner: np.ndarray, height: int, width: int) -> Camera:
    """A part of the same view.

    Args:
        camera: the whole view.
        corner: (..., 2) upper left corner of the part, x, y [px].
        height: of the part [px].
        width: of the part [px].
    """
    return dataclasses.replace(
        camera, principal_point=camera.principal_point - corner, height=height, width=width
    )


@single_precision
def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """Stack V cameras of one size into one whose arrays lead with V."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)


def project(camera: Camera, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Project points to pixels.

    Points nearer than 1 cm, or behind the camera, get a pixel that is finite but meaningless. Their
    depth tells.

    Args:
        camera: the view.
        points_world: (..., 3) [m].

    Returns:
        Pixels (..., 2) x, y, and depths (...) along the optical axis [m].
    """
    points_cam = points_world @ camera.world_to_cam[:3, :3].T + camera.world_to_cam[:3, 3]
    depth = points_cam[..., 2]
    pixels = camera.focal * points_cam[..., :2] / jnp.maximum(depth, 0.01)[..., None]
    if camera.aspect != 1:
        pixels = pixels * jnp.array([camera.aspect, 1.0])
    return pixels + camera.principal_point, depth
