"""A splat rasterizer made of matrix products.

The footprint of an isotropic Gaussian is a row profile times a column profile, so the sum of all
splats' features over the image is one product of matrices, and its gradient two more. There is no
sort, no tile and no cut-off: every splat keeps a gradient. Occlusion is a soft z-buffer: colours
are averaged with weights that fall off with depth behind the nearest splat.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.splat.camera import project
from vrrt_jax.splat.types import Camera, SplatModel

NEAR = 0.05  # [m] splats nearer than this to the camera plane are not drawn
PIXEL_BLUR = 0.1  # [px] a pixel's own footprint, added to every splat's; more costs up to 3 dB
# The faintest footprint that counts in a float32 coverage, 6e-8, times exp(-66) is still a normal
# number. So a splat keeps its colour however far it is behind the nearest one.
MIN_LOG_WEIGHT = -66.0
MIN_WEIGHT = 1e-37


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
    behind = jnp.where(visible, (nearest - depth) / model.tau, 0.0)
    weight = density * jnp.exp(jnp.maximum(behind, MIN_LOG_WEIGHT))
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

    The gradient is in closed form: one product of matrices forward, two more backward.

    Args:
        pixel: (G, 2) centres x, y [px].
        inv_sigma: (G,) one over the standard deviation [1/px].
        features: (G, C).
        size: (H, W), static.

    Returns:
        (H, W, C).
    """
    height, width = size
    total = _sum(pixel, inv_sigma, features, size)
    return total.reshape(width, features.shape[1], height).transpose(2, 0, 1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _sum(pixel, inv_sigma, features, size):
    """As splat_sum, but (W, C*H): the layout in which all three products are fast."""
    return _sum_fwd(pixel, inv_sigma, features, size)[0]


def _sum_fwd(pixel, inv_sigma, features, size):
    height, width = size
    dx = _offsets(pixel[:, 0], inv_sigma, width)
    dy = _offsets(pixel[:, 1], inv_sigma, height)
    gx, gy = jnp.exp(-0.5 * dx**2), jnp.exp(-0.5 * dy**2)
    fy = (features[:, :, None] * gy[:, None]).reshape(features.shape[0], -1)
    return gx.T @ fy, (dx, dy, gx, gy, fy, inv_sigma, features)


def _sum_bwd(size, residuals, total_bar):
    dx, dy, gx, gy, fy, inv_sigma, features = residuals
    height, width = size
    channels = features.shape[1]
    # XLA's CPU loops for a product fused into a sum are ten times slower than the same sums
    # written as products with matrices of zeros and ones.
    over_rows = jnp.repeat(jnp.eye(channels, dtype=gx.dtype), height, axis=0)
    over_pixels = jnp.repeat(
        jnp.eye(2, dtype=gx.dtype), np.array([width, height]), axis=0, total_repeat_length=sum(size)
    )
    gx_bar = fy @ jax.lax.optimization_barrier(total_bar.T)
    products = (gx @ total_bar).reshape(-1, channels, height) * gy[:, None]
    products = products.reshape(-1, channels * height)
    features_bar = products @ over_rows
    along_y = sum(
        products[:, c * height : (c + 1) * height] * features[:, c : c + 1] for c in range(channels)
    )
    along = jnp.concatenate([gx_bar * gx * dx, along_y * dy], axis=1)
    pixel_bar = (along @ over_pixels) * inv_sigma[:, None]
    squares = along * jnp.concatenate([dx, dy], axis=1)
    inv_sigma_bar = -jnp.sum(squares @ over_pixels, axis=1) / inv_sigma
    return pixel_bar, inv_sigma_bar, features_bar


_sum.defvjp(_sum_fwd, _sum_bwd)


def _offsets(centre: jax.Array, inv_sigma: jax.Array, n: int) -> jax.Array:
    """Distances (G, n) of n pixels from the centres, in standard deviations."""
    return (jnp.arange(n, dtype=centre.dtype) + 0.5 - centre[:, None]) * inv_sigma[:, None]


@jax.custom_jvp
def _ratio(colour: jax.Array, weight: jax.Array) -> jax.Array:
    """Colour / weight for weights that may be so small that their square underflows."""
    return colour / (weight[..., None] + MIN_WEIGHT)


@_ratio.defjvp
def _ratio_jvp(primals, tangents):
    (colour, weight), (colour_dot, weight_dot) = primals, tangents
    inverse = 1.0 / (weight[..., None] + MIN_WEIGHT)
    ratio = colour * inverse
    return ratio, (colour_dot - ratio * weight_dot[..., None]) * inverse


def map_lanes(f, *args: jax.Array):
    """Map ``f`` over the leading axis of the arguments, a few at a time, so that caches hold."""
    return jax.lax.map(lambda lane: f(*lane), args, batch_size=4)
