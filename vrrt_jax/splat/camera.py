"""Cameras: from a point of view to pixels."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.precision import single_precision
from vrrt_jax.splat.types import Camera


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
        ValueError: the eye is at the target, or the view direction is parallel to ``up``.
    """
    eye_, target_, up_ = (np.asarray(v, np.float64) for v in (eye, target, up))
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
    focal: float,
    height: int,
    width: int,
    principal_point: Sequence[float] | None = None,
) -> Camera:
    """Make a camera from its calibration.

    Args:
        world_to_cam: (4, 4) rigid transform; the camera points along +z, with x right and y down.
        focal: focal length [px].
        height: image height [px].
        width: image width [px].
        principal_point: x, y [px]; the middle of the image if None.

    Raises:
        ValueError: the matrix is not rigid, or a size is not positive.
    """
    world_to_cam = np.asarray(world_to_cam, np.float64)
    rotation = world_to_cam[:3, :3] if world_to_cam.shape == (4, 4) else np.zeros((3, 3))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError(
            "world_to_cam is not a rigid (4, 4) transform; its upper left 3 x 3 block must be a "
            "rotation"
        )
    if not (focal > 0 and height > 0 and width > 0):
        raise ValueError(f"focal={focal}, height={height}, width={width}; all must be positive")
    if principal_point is None:
        principal_point = (width / 2, height / 2)
    return Camera(
        world_to_cam=jnp.asarray(world_to_cam, jnp.float32),
        focal=jnp.float32(focal),
        principal_point=jnp.asarray(principal_point, jnp.float32),
        height=int(height),
        width=int(width),
    )


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
    """
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    forward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    eye = np.asarray(target, np.float64) - distance * forward
    return look_at(eye.tolist(), target, fovy_deg=fovy_deg, height=height, width=width)


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
    return pixels + camera.principal_point, depth
