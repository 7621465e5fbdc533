"""Cameras, splats and goal images.

Letters: ``G`` splats, ``V`` views, ``H W`` image. Images are float32 in [0, 1]; the camera looks
along its z axis, x to the right and y down.
"""

import jax
import numpy as np

from vrrt_jax.core.types import pytree, static


@pytree
class Camera:
    """A pinhole camera."""

    world_to_cam: jax.Array  # (4, 4) rigid transform
    focal: jax.Array  # () [px], square pixels
    principal_point: jax.Array  # (2,) x, y [px]; the center of pixel 0 is at 0.5
    height: int = static()  # [px]
    width: int = static()  # [px]


@pytree
class SplatModel:
    """Isotropic splats bound rigidly to a robot's links, sorted by link."""

    mean: jax.Array  # (G, 3) center in the link's frame [m]
    radius: jax.Array  # (G,) standard deviation [m]
    density: jax.Array  # (G,) optical depth at the center; alpha = 1 - exp(-sum)
    rgb: jax.Array  # (G, 3) color seen from nowhere in particular
    view_color_gradient: (
        jax.Array
    )  # (G, 3) color factor = 1 + view_color_gradient . direction to the camera, in link frame
    link: jax.Array  # (G,) i32
    tau: jax.Array  # () softness of occlusion [m]
    starts: tuple[int, ...] = static(default=(0,))  # first splat of each layer of whole links

    @property
    def num_splats(self) -> int:
        """G."""
        return self.radius.shape[0]


def layer_starts(link: np.ndarray) -> tuple[int, ...]:
    """First splats of two layers, of the inner and the outer half of the links.

    An arm before its own body needs them most.

    Args:
        link: (G,) of each splat, rising.
    """
    outer = int(np.searchsorted(link, (link[-1] + 1) // 2))
    return (0, outer) if 0 < outer < len(link) else (0,)


@pytree
class GoalImage:
    """What the robot should look like, in V views of one size."""

    rgb: jax.Array  # (V, H, W, 3) the robot over black
    alpha: jax.Array  # (V, H, W) share of the pixel that the robot covers
    valid: jax.Array  # (V, H, W) weight of the pixel in the loss, 0 where unknown
