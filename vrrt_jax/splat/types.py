"""Cameras, splats and goal images.

Letters: ``G`` splats, ``V`` views, ``H W`` image, ``L`` links. Images are float32 in [0, 1]. The
camera looks along its z axis, with x to the right and y down.
"""

import jax
import numpy as np

from vrrt_jax.core.types import pytree, static


@pytree
class Camera:
    """A pinhole camera."""

    world_to_cam: jax.Array  # (4, 4) rigid transform
    focal: jax.Array  # () [px], of the vertical axis
    principal_point: jax.Array  # (2,) x, y [px]; the center of pixel 0 is at 0.5
    height: int = static()  # [px]
    width: int = static()  # [px]
    # Horizontal focal length over the vertical one. Splats are drawn with square pixels alone,
    # which goal images get by `splat.images`.
    aspect: float = static(default=1.0)


@pytree
class SplatModel:
    """Isotropic splats bound rigidly to a robot's links, sorted by link."""

    mean: jax.Array  # (G, 3) center in the link's frame [m]
    radius: jax.Array  # (G,) standard deviation [m]
    density: jax.Array  # (G,) optical depth at the center; alpha = 1 - exp(-sum of all splats)
    rgb: jax.Array  # (G, 3) mean color over all directions
    # (G, 3) in the link's frame: the color is rgb * (1 + view_color_gradient . d), where d is the
    # direction from the splat to the camera.
    view_color_gradient: jax.Array
    link: jax.Array  # (G,) i32
    tau: jax.Array  # () softness of occlusion [m]: the depth over which a weight falls to 1 / e
    starts: tuple[int, ...] = static(default=(0,))  # first splat of each layer of whole links

    @property
    def num_splats(self) -> int:
        """G."""
        return self.radius.shape[0]


def layer_starts(link: np.ndarray) -> tuple[int, ...]:
    """First splats of two layers: the inner half of the links, and the outer half.

    Layers matter most where an arm is in front of its own body.

    Args:
        link: (G,) link of each splat, in rising order.

    Returns:
        (0, first splat of the outer half), or (0,) if one half has no splats.
    """
    outer = int(np.searchsorted(link, (link[-1] + 1) // 2))
    return (0, outer) if 0 < outer < len(link) else (0,)


@pytree
class GoalImage:
    """Images of the robot at the goal, in V views of one size."""

    rgb: jax.Array  # (V, H, W, 3) the robot over black
    alpha: jax.Array  # (V, H, W) share of the pixel that the robot covers
    valid: jax.Array  # (V, H, W) weight of the pixel in the loss, 0 where the image is unknown
