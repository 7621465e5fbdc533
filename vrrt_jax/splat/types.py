"""Cameras, splats and goal images.

Letters: ``G`` splats, ``V`` views, ``H W`` image. Images are float32 in [0, 1]; the camera looks
along its z axis, x to the right and y down.
"""

import jax

from vrrt_jax.core.types import pytree, static


@pytree
class Camera:
    """A pinhole camera."""

    world_to_cam: jax.Array  # (4, 4) rigid transform
    focal: jax.Array  # () [px], square pixels
    centre: jax.Array  # (2,) principal point x, y [px]; the centre of pixel 0 is at 0.5
    height: int = static()  # [px]
    width: int = static()  # [px]


@pytree
class SplatModel:
    """Isotropic splats bound rigidly to a robot's links, sorted by link."""

    mean: jax.Array  # (G, 3) centre in the link's frame [m]
    radius: jax.Array  # (G,) standard deviation [m]
    density: jax.Array  # (G,) optical depth at the centre; coverage = 1 - exp(-sum)
    rgb: jax.Array  # (G, 3) colour seen from nowhere in particular
    shade: jax.Array  # (G, 3) colour factor = 1 + shade . direction to the camera, in link frame
    link: jax.Array  # (G,) i32
    tau: jax.Array  # () softness of occlusion [m]

    @property
    def num_splats(self) -> int:
        """G."""
        return self.radius.shape[0]


@pytree
class GoalImage:
    """What the robot should look like, in V views of one size."""

    rgb: jax.Array  # (V, H, W, 3) the robot over black
    coverage: jax.Array  # (V, H, W) share of the pixel that the robot covers
    valid: jax.Array  # (V, H, W) weight of the pixel in the loss, 0 where unknown
