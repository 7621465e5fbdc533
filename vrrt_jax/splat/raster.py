"""A splat rasterizer made of matrix products.

The footprint of an isotropic Gaussian is a row profile times a column profile, so the sum of all
splats' features over the image is one product of matrices, and its gradient two more. There is no
sort, no tile and no cut-off: every splat keeps a gradient. Occlusion is a soft z-buffer: colours are
averaged with weights that fall off with depth behind the nearest splat.
"""

import jax
import jax.numpy as jnp

from vrrt_jax.splat.camera import project
from vrrt_jax.splat.types import Camera, SplatModel

NEAR = 0.05  # [m] splats nearer than this to the camera plane are not drawn
PIXEL_BLUR = 0.3  # [px] a pixel's own footprint, added to every splat's


def render(model: SplatModel, poses: jax.Array, camera: Camera) -> tuple[jax.Array, jax.Array]:
    """Render a posed robot.

    Args:
        model: splats bound to links.
        poses: (L, 4, 4) link-to-world transforms.
        camera: the view; its size is the image's.

    Returns:
        rgb (H, W, 3), the robot over black, and coverage (H, W).
    """
    rotation, translation = poses[model.link, :3, :3], poses[model.link, :3, 3]
    mean = jnp.einsum("gij,gj->gi", rotation, model.mean) + translation
    pixel, depth = project(camera, mean)
    visible = depth > NEAR
    depth = jnp.where(visible, depth, 1.0)
    sigma = jnp.sqrt((camera.focal * model.radius / depth) ** 2 + PIXEL_BLUR**2)
    eye = -camera.world_to_cam[:3, :3].T @ camera.world_to_cam[:3, 3]
    to_eye = eye - mean
    to_eye = to_eye * jax.lax.rsqrt(jnp.sum(to_eye**2, -1, keepdims=True) + 1e-12)
    view = jnp.einsum("gij,gi->gj", rotation, to_eye)
    colour = model.rgb * (1.0 + jnp.sum(model.shade * view, -1, keepdims=True))
    density = jnp.where(visible, model.density, 0.0)
    nearest = jnp.min(jnp.where(visible, depth, jnp.inf))
    nearest = jax.lax.stop_gradient(jnp.where(jnp.isfinite(nearest), nearest, 1.0))
    weight = density * jnp.exp((nearest - depth) / model.tau)
    features = jnp.concatenate(
        [weight[:, None] * colour, weight[:, None], density[:, None]], axis=-1
    )
    total = splat_sum(pixel, 1.0 / sigma, features, (camera.height, camera.width))
    coverage = 1.0 - jnp.exp(-total[..., 4])
    return _ratio(total[..., :3], total[..., 3]) * coverage[..., None], coverage


def splat_sum(
    pixel: jax.Array, inv_sigma: jax.Array, features: jax.Array, size: tuple[int, int]
) -> jax.Array:
    """Sum over splats of Gaussian footprint times feature.

    Args:
        pixel: (G, 2) centres x, y [px].
        inv_sigma: (G,) one over the standard deviation [1/px].
        features: (G, C).
        size: (H, W), static.

    Returns:
        (H, W, C).
    """
    height, width = size
    gx = _profile(pixel[:, 0], inv_sigma, width)
    gy = _profile(pixel[:, 1], inv_sigma, height)
    return jnp.einsum("gh,gw,gc->hwc", gy, gx, features)


def _profile(centre: jax.Array, inv_sigma: jax.Array, n: int) -> jax.Array:
    offset = (jnp.arange(n, dtype=centre.dtype) + 0.5 - centre[:, None]) * inv_sigma[:, None]
    return jnp.exp(-0.5 * offset**2)


@jax.custom_jvp
def _ratio(colour: jax.Array, weight: jax.Array) -> jax.Array:
    """Colour / weight for weights that may be as small as 1e-30, whose square underflows."""
    return colour / (weight[..., None] + 1e-30)


@_ratio.defjvp
def _ratio_jvp(primals, tangents):
    (colour, weight), (colour_dot, weight_dot) = primals, tangents
    inverse = 1.0 / (weight[..., None] + 1e-30)
    ratio = colour * inverse
    return ratio, (colour_dot - ratio * weight_dot[..., None]) * inverse
