"""The plain compositor of 3D Gaussian splatting: sorted, dense over pixels, in a few lines.

It is the oracle for the fast rasterizer, and the choice where fidelity counts more than time: it
knows anisotropic splats and true occlusion. It holds as many images as there are splats.
"""

import jax
import jax.numpy as jnp

from vrrt_jax.core.types import pytree
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.raster import NEAR, PIXEL_BLUR
from vrrt_jax.splat.types import Camera, SplatModel


@pytree
class Gaussians:
    """Anisotropic splats in the world."""

    mean: jax.Array  # (G, 3) [m]
    quaternion: jax.Array  # (G, 4) wxyz, principal axes to world; need not have length 1
    scale: jax.Array  # (G, 3) standard deviations along the principal axes [m]
    density: jax.Array  # (G,) optical depth at the center
    rgb: jax.Array  # (G, 3) color towards the camera


def composite(
    pixel: jax.Array,
    covariance: jax.Array,
    depth: jax.Array,
    density: jax.Array,
    rgb: jax.Array,
    size: tuple[int, int],
) -> tuple[jax.Array, jax.Array]:
    """Draw splats front to back, each with opacity ``1 - exp(-density * footprint)``.

    Args:
        pixel: (G, 2) centers x, y [px].
        covariance: (G, 2, 2) of the footprints [px^2]; not singular.
        depth: (G,) for the order only.
        density: (G,) optical depth at the center.
        rgb: (G, 3).
        size: (H, W), static.

    Returns:
        rgb (H, W, 3) over black, and alpha (H, W).
    """
    order = jnp.argsort(depth)
    y, x = (jnp.arange(n, dtype=pixel.dtype) + 0.5 for n in size)

    def optical_depth(center, covariance, density):
        dx, dy = x[None] - center[0], y[:, None] - center[1]
        (xx, xy), (_, yy) = covariance
        squared = (yy * dx**2 - 2.0 * xy * dx * dy + xx * dy**2) / (xx * yy - xy**2)
        return density * jnp.exp(-0.5 * squared)

    depths = jax.vmap(optical_depth)(pixel[order], covariance[order], density[order])
    alpha = -jnp.expm1(-depths)
    passed = jnp.cumprod(1.0 - alpha, axis=0)
    arriving = jnp.concatenate([jnp.ones_like(passed[:1]), passed[:-1]])
    return jnp.einsum("ghw,gc->hwc", arriving * alpha, rgb[order]), 1.0 - passed[-1]


def render_gaussians(gaussians: Gaussians, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Render anisotropic splats.

    Args:
        gaussians: in any order.
        camera: the view; its size is the image's.

    Returns:
        rgb (H, W, 3) over black, and alpha (H, W).
    """
    pixel, depth = project(camera, gaussians.mean)
    visible = depth > NEAR
    footprint = _projected_covariance(gaussians, camera, jnp.where(visible, depth, 1.0))
    density = jnp.where(visible, gaussians.density, 0.0)
    size = (camera.height, camera.width)
    return composite(pixel, footprint, depth, density, gaussians.rgb, size)


def _projected_covariance(gaussians: Gaussians, camera: Camera, depth: jax.Array) -> jax.Array:
    """Covariances (G, 2, 2) after the projection's affine approximation at each mean (EWA)."""
    rotation, translation = camera.world_to_cam[:3, :3], camera.world_to_cam[:3, 3]
    slope = (gaussians.mean @ rotation.T + translation)[:, :2] / depth[:, None]
    # Far outside the image the approximation explodes.
    size = jnp.array([camera.width, camera.height], slope.dtype)
    limit = 1.3 * jnp.maximum(camera.principal_point, size - camera.principal_point) / camera.focal
    slope = jnp.clip(slope, -limit, limit)
    jacobian = jnp.concatenate(
        [jnp.broadcast_to(jnp.eye(2), (len(slope), 2, 2)), -slope[:, :, None]], axis=2
    )
    axes = _rotations(gaussians.quaternion) * gaussians.scale[:, None]
    spread = jnp.einsum("gij,jk,gkl->gil", jacobian, rotation, axes)
    spread = spread * (camera.focal / depth)[:, None, None]
    return spread @ jnp.swapaxes(spread, 1, 2) + PIXEL_BLUR**2 * jnp.eye(2)


def _rotations(quaternion: jax.Array) -> jax.Array:
    """Matrices (G, 3, 3)."""
    squared = jnp.sum(quaternion**2, axis=1, keepdims=True)
    w, x, y, z = (quaternion * jax.lax.rsqrt(squared)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.moveaxis(jnp.array(rows), -1, 0)


def render_reference(
    model: SplatModel, poses: jax.Array, camera: Camera
) -> tuple[jax.Array, jax.Array]:
    """Like :func:`vrrt_jax.splat.raster.render`, but with true occlusion, and slow.

    Args:
        model: splats bound to links.
        poses: (L, 4, 4) link-to-world transforms.
        camera: the view; its size is the image's.

    Returns:
        rgb (H, W, 3), the robot over black, and alpha (H, W).
    """
    rotation, translation = poses[model.link, :3, :3], poses[model.link, :3, 3]
    mean = jnp.einsum("gij,gj->gi", rotation, model.mean) + translation
    pixel, depth = project(camera, mean)
    visible = depth > NEAR
    radius = camera.focal * model.radius / jnp.where(visible, depth, 1.0)
    covariance = (radius**2 + PIXEL_BLUR**2)[:, None, None] * jnp.eye(2)
    eye = -camera.world_to_cam[:3, :3].T @ camera.world_to_cam[:3, 3]
    to_eye = eye - mean
    to_eye = to_eye * jax.lax.rsqrt(jnp.sum(to_eye**2, axis=-1, keepdims=True) + 1e-12)
    view = jnp.einsum("gij,gi->gj", rotation, to_eye)
    rgb = model.rgb * (1.0 + jnp.sum(model.view_color_gradient * view, axis=-1, keepdims=True))
    density = jnp.where(visible, model.density, 0.0)
    return composite(pixel, covariance, depth, density, rgb, (camera.height, camera.width))
