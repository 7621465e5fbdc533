"""The plain compositor of 3D Gaussian splatting: sorted, dense over pixels, in a few lines.

Occlusion is true here, not soft. The memory is that of as many images as there are splats. The fast
rasterizer is tested and timed against this one.
"""

import jax
import jax.numpy as jnp

from vrrt_jax.splat.camera import project
from vrrt_jax.splat.projection import NEAR, PIXEL_BLUR
from vrrt_jax.splat.types import Camera, SplatModel


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
