"""The loss of a rendered robot against a goal image, in whatever light that was taken.

A self-model is trained under one lamp, and nobody knows the lamp of a goal image. Each color
channel of a render is therefore scaled by the gain that suits the goal best, in closed form, and
what would be brighter than white is white. Shading remains: a lamp from the side darkens the other
side. Colors therefore count less than coverage, which no lamp changes: a little where poses are
compared with each other, and next to nothing where it is judged whether a pose matches at all.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.robots.kinematics import Chain, link_poses
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.types import Camera, GoalImage, SplatModel
from vrrt_jax.splat.windows import Windows

# Weights of a squared color error, relative to the goal's brightness, beside coverage. Only colors
# tell an arm in front of its own body.
COLOR_WEIGHT = 0.1
# Here another lamp raises the loss at a right pose by half, and there up to four times.
MATCH_COLOR_WEIGHT = 0.01
OVEREXPOSED = 0.97  # from which on a pixel may have been brighter than the image can say
FEW_PIXELS = 1e-4  # share of an image that tells no gain; without more, the gain is near 1
DARKEST = 0.02  # mean brightness of a robot, below which its noise is not scaled up any more


def image_loss(
    rgb: jax.Array,
    alpha: jax.Array,
    goal_rgb: jax.Array,
    goal_alpha: jax.Array,
    valid: jax.Array,
) -> jax.Array:
    """Mean squared error of one view in the light of training, over the four channels.

    Args:
        rgb: (H, W, 3) the rendered robot over black.
        alpha: (H, W) of the rendered robot.
        goal_rgb: (H, W, 3) the goal over black.
        goal_alpha: (H, W) of the goal.
        valid: (H, W) weights of the pixels.

    Returns:
        ().
    """
    error = jnp.sum((rgb - goal_rgb) ** 2, axis=-1) + (alpha - goal_alpha) ** 2
    return jnp.sum(valid * error) / (4.0 * jnp.maximum(jnp.sum(valid), 1.0))


def relit(
    rgb: jax.Array,
    alpha: jax.Array,
    goal_rgb: jax.Array,
    goal_alpha: jax.Array,
    valid: jax.Array,
) -> jax.Array:
    """A render in the light of the goal: one gain for each color channel.

    The gains are those of least squares over pixels that both cover and that are not overexposed in
    the goal. They move with the render, and gradients go through them. Arguments are those of
    :func:`image_loss`.

    Returns:
        (H, W, 3) the rendered robot over black.
    """
    exposed = goal_rgb < OVEREXPOSED * goal_alpha[..., None]
    weight = jnp.where(exposed, (valid * alpha * goal_alpha)[..., None], 0.0)
    few = FEW_PIXELS * alpha.size
    across = jnp.sum(weight * rgb * goal_rgb, axis=(0, 1)) + few
    gain = across / (jnp.sum(weight * rgb**2, axis=(0, 1)) + few)
    return jnp.minimum(gain * rgb, alpha[..., None])


def _render_views(
    chain: Chain, splats: SplatModel, cameras: Camera, q: jax.Array, windows: Windows | None
) -> list[tuple[jax.Array, jax.Array]]:
    """Color and alpha in each of the V views."""
    poses = link_poses(chain, q)
    each = [jax.tree.map(lambda leaf: leaf[v], cameras) for v in range(len(cameras.focal))]  # noqa: B023
    return [render(splats, poses, camera, windows) for camera in each]


def weighted_image(
    chain: Chain,
    splats: SplatModel,
    cameras: Camera,
    goal: GoalImage,
    q: jax.Array,
    windows: Windows | None = None,
    color_weight: float | jax.Array = COLOR_WEIGHT,
) -> jax.Array:
    """The image of a configuration, as a vector for least squares.

    The squared distance between this vector and :func:`weighted_goal` is the loss: weighted squared
    errors of color and alpha, the mean over V views.

    Args:
        chain: the robot's kinematics.
        splats: the robot's splats.
        cameras: V cameras.
        goal: V images.
        q: (D,) the configuration [rad] or [m].
        windows: to render with, if any.
        color_weight: () of colors.

    Returns:
        (V * H * W * 4,), see :func:`weighted`.
    """
    views = _render_views(chain, splats, cameras, q, windows)
    rgb, alpha = (jnp.stack(channels) for channels in zip(*views, strict=True))
    return weighted(rgb, alpha, goal, color_weight)


def weighted(
    rgb: jax.Array,
    alpha: jax.Array,
    goal: GoalImage,
    color_weight: float | jax.Array = COLOR_WEIGHT,
) -> jax.Array:
    """Images as a vector for least squares, in the light of the goal.

    Args:
        rgb: (V, H, W, 3) the robot over black.
        alpha: (V, H, W).
        goal: V images.
        color_weight: () of colors.

    Returns:
        (V * H * W * 4,) colors and alphas, times the root of each one's weight.
    """
    rgb = jax.vmap(relit)(rgb, alpha, goal.rgb, goal.alpha, goal.valid)
    image = jnp.concatenate([rgb, alpha[..., None]], axis=-1)
    return (image * _root_weight(goal, color_weight)).ravel()


def weighted_goal(goal: GoalImage, color_weight: float | jax.Array = COLOR_WEIGHT) -> jax.Array:
    """The goal as a vector (V * H * W * 4,), see :func:`weighted_image`."""
    image = jnp.concatenate([goal.rgb, goal.alpha[..., None]], axis=-1)
    return (image * _root_weight(goal, color_weight)).ravel()


def _root_weight(goal: GoalImage, color_weight: float | jax.Array) -> jax.Array:
    """(V, H, W, 4) root of each number's weight in the mean over views.

    Errors of color are relative to the robot's mean brightness in each view.
    """
    num_valid = jnp.maximum(jnp.sum(goal.valid, axis=(1, 2)), 1.0)
    covered = jnp.maximum(jnp.sum(goal.valid * goal.alpha, axis=(1, 2)), 1e-6)
    brightness = jnp.sum(goal.valid[..., None] * goal.rgb, axis=(1, 2, 3)) / (3.0 * covered)
    color = color_weight / jnp.maximum(brightness, DARKEST) ** 2
    channels = jnp.stack([color, color, color, jnp.ones_like(color)], axis=-1)
    pixel = goal.valid / (4.0 * len(goal.valid) * num_valid[:, None, None])
    return jnp.sqrt(pixel[..., None] * channels[:, None, None])


def block_means(image: jax.Array, blocks: Sequence[int]) -> jax.Array:
    """What is left of a weighted image if one looks at it through half-closed eyes.

    Errors of pixels tell nothing about an arm that is elsewhere by more than its width. Means over
    blocks do, and so lead from farther away. Neighboring blocks overlap by half.

    Args:
        image: (V * H * W * 4,) see :func:`weighted`, as (V, H, W, 4).
        blocks: heights and widths of blocks [px], even numbers.

    Returns:
        A vector whose squared length is that of the image, where the image is smooth.
    """
    means = []
    for block in blocks:
        # Sums of half a block, of which two by two neighbors make a block.
        half = block // 2
        padded = jnp.pad(image, [(0, 0), *((0, -size % half) for size in image.shape[1:3]), (0, 0)])
        views, rows, columns, channels = padded.shape
        cells = padded.reshape(views, rows // half, half, columns // half, half, channels)
        sums = jnp.pad(jnp.sum(cells, axis=(2, 4)), [(0, 0), (1, 1), (1, 1), (0, 0)])
        sums = sums[:, 1:] + sums[:, :-1]
        sums = sums[:, :, 1:] + sums[:, :, :-1]
        means.append(sums.ravel() / (2 * block))  # every pixel is in four blocks
    return jnp.concatenate(means) / np.sqrt(len(blocks))


def psnr_db(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio of images in [0, 1] [dB]."""
    return float(-10.0 * jnp.log10(mean_squared_error))
