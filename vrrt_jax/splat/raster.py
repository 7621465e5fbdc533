"""A splat rasterizer made of matrix products.

Steps: project the splats (:mod:`projection`), sum their features over the image
(:mod:`footprints`, in :mod:`windows` on a CPU), and turn the sums into color and alpha
(:mod:`compositing`).

There is no sort, no tile and no cut-off, so every splat keeps a gradient. Occlusion is a soft
z-buffer: colors are averaged with weights that fall off with the depth behind the nearest splat. A
near splat then outshines far ones even where its own footprint is faint, and the silhouette of an
arm before its own body would grow. Links are therefore drawn in layers. One layer hides another
where it is in front, and only as far as it covers.
"""

import jax
import jax.numpy as jnp

from vrrt_jax.core.precision import single_precision
from vrrt_jax.splat.compositing import composite_layers
from vrrt_jax.splat.footprints import sum_footprints
from vrrt_jax.splat.projection import project_splats
from vrrt_jax.splat.types import Camera, SplatModel
from vrrt_jax.splat.windows import ImageLayout, Windows, place_windows


@single_precision
def render(
    model: SplatModel, poses: jax.Array, camera: Camera, windows: Windows | None = None
) -> tuple[jax.Array, jax.Array]:
    """Render a posed robot; ``vmap`` it for many.

    Args:
        model: splats bound to links.
        poses: (L, 4, 4) link-to-world transforms.
        camera: the view; its size is the image's.
        windows: from :func:`choose_windows`, for the model that came with it.

    Returns:
        rgb (H, W, 3), the robot over black, and alpha (H, W), the share of a pixel that it covers.
    """
    layout = ImageLayout((camera.height, camera.width), model.starts, windows)
    splats, depth = project_splats(model, poses, camera)
    placement = place_windows(splats, depth, model.tau, layout) if windows is not None else None
    rgb, alpha = composite_layers(sum_footprints(splats, placement, layout))
    return jnp.moveaxis(rgb, 0, -1), alpha
