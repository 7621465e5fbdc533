"""Splats seen by a camera: where they are in the image, and what they add to it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from vrrt_jax.splat.types import Camera, SplatModel

NEAR = 0.05  # [m] splats nearer than this to the camera plane are not drawn
PIXEL_BLUR = 0.1  # [px] a pixel's own footprint, added to every splat's; more costs up to 3 dB
# The faintest footprint that changes a float32 alpha is 6e-8. Times exp(-66) it is still a normal
# number, so that a splat keeps its color however far it is behind the nearest splat.
MIN_LOG_WEIGHT = -66.0


class ProjectedSplats(NamedTuple):
    """Splats in the image. Their gradient has the same form."""

    pixel: jax.Array  # (2, G) centers x, y [px]
    inv_sigma: jax.Array  # (G,) one over the standard deviation [1/px]
    features: jax.Array  # (C, G) what is summed: weighted rgb, weight, density


def project_splats(
    model: SplatModel, poses: jax.Array, camera: Camera
) -> tuple[ProjectedSplats, jax.Array]:
    """Project a posed robot's splats.

    Args:
        model: splats bound to links.
        poses: (L, 4, 4) link-to-world transforms.
        camera: the view.

    Returns:
        The splats with C = 5 features: weighted rgb, weight and density. And the depths (G,) [m],
        1 for splats that are not drawn.

    Raises:
        ValueError: the camera's pixels are not square.
    """
    if camera.aspect != 1:
        raise ValueError(
            f"the camera's focal lengths differ by a factor of {camera.aspect:.4g}; splats are "
            "drawn with square pixels: draw them with splat.camera.squared(camera)"
        )
    # Splats take their link's pose by small matrix products. A gather of poses would do the same,
    # but its gradient is a slow scatter.
    link_to_cam = jnp.matmul(camera.world_to_cam, poses, precision="highest")[:, :3]
    of_link = jax.nn.one_hot(model.link, len(poses), dtype=poses.dtype, axis=0)
    mean = jnp.concatenate([model.mean.T, jnp.ones_like(model.radius)[None]])
    point = _transform_by_link(link_to_cam, of_link, mean)
    view_color_gradient = _transform_by_link(
        link_to_cam[:, :, :3], of_link, model.view_color_gradient.T
    )

    # Splats behind the camera get a harmless depth, and below no density.
    visible = point[2] > NEAR
    depth = jnp.where(visible, point[2], 1.0)

    # The brightness is linear in the direction from the splat to the camera.
    from_camera = lax.rsqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2 + 1e-12) * point
    brightness = 1.0 - (
        from_camera[0] * view_color_gradient[0]
        + from_camera[1] * view_color_gradient[1]
        + from_camera[2] * view_color_gradient[2]
    )

    # Soft z-buffer: the weight falls off exponentially with the depth behind the nearest splat.
    # The nearest depth cancels out of the weighted mean, so it needs no gradient.
    density = jnp.where(visible, model.density, 0.0)
    nearest = jnp.min(jnp.where(visible, depth, jnp.inf))
    nearest = lax.stop_gradient(jnp.where(jnp.isfinite(nearest), nearest, 1.0))
    behind = jnp.where(visible, (nearest - depth) / model.tau, 0.0)
    weight = density * jnp.exp(jnp.maximum(behind, MIN_LOG_WEIGHT))

    splats = ProjectedSplats(
        pixel=camera.focal * point[:2] / depth + camera.principal_point[:, None],
        inv_sigma=lax.rsqrt((camera.focal * model.radius / depth) ** 2 + PIXEL_BLUR**2),
        features=jnp.concatenate(
            [model.rgb.T * (weight * brightness), weight[None], density[None]]
        ),
    )
    return splats, depth


def _transform_by_link(matrices: jax.Array, of_link: jax.Array, vectors: jax.Array) -> jax.Array:
    """Matrices (L, 3, n) of links times vectors (n, G) of splats.

    ``of_link`` (L, G) is 1 where a splat is bound to a link, and 0 elsewhere.
    """
    bound = (of_link[:, None] * vectors).reshape(-1, vectors.shape[1])
    side_by_side = jnp.moveaxis(matrices, 0, 1).reshape(3, -1)
    return jnp.dot(side_by_side, bound, precision="highest")
