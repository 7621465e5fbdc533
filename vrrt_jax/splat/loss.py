"""How far a rendered robot is from a goal image."""

import jax
import jax.numpy as jnp

from vrrt_jax.robots.kinematics import Chain, link_poses
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.types import Camera, GoalImage, SplatModel
from vrrt_jax.splat.windows import Windows


def image_loss(
    rgb: jax.Array,
    alpha: jax.Array,
    goal_rgb: jax.Array,
    goal_alpha: jax.Array,
    valid: jax.Array,
) -> jax.Array:
    """Mean squared error () over the valid pixels and the four channels of one view."""
    error = jnp.sum((rgb - goal_rgb) ** 2, axis=-1) + (alpha - goal_alpha) ** 2
    return jnp.sum(valid * error) / (4.0 * jnp.maximum(jnp.sum(valid), 1.0))


def goal_loss(
    chain: Chain,
    splats: SplatModel,
    cameras: Camera,
    goal: GoalImage,
    q: jax.Array,
    windows: Windows | None = None,
) -> jax.Array:
    """Loss () of a configuration (D,): the mean over the V views."""
    views = _views(chain, splats, cameras, q, windows)
    losses = [
        image_loss(rgb, alpha, goal.rgb[view], goal.alpha[view], goal.valid[view])
        for view, (rgb, alpha) in enumerate(views)
    ]
    return jnp.mean(jnp.stack(losses))


def _views(
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
) -> jax.Array:
    """The image of a configuration (D,) as a vector (V * H * W * 4,).

    Its squared distance from :func:`weighted_goal` is the :func:`goal_loss`.
    """
    views = [
        jnp.concatenate([rgb, alpha[..., None]], axis=-1)
        for rgb, alpha in _views(chain, splats, cameras, q, windows)
    ]
    return (jnp.stack(views) * _root_weight(goal)).ravel()


def weighted_goal(goal: GoalImage) -> jax.Array:
    """The goal as a vector (V * H * W * 4,), see :func:`weighted_image`."""
    image = jnp.concatenate([goal.rgb, goal.alpha[..., None]], axis=-1)
    return (image * _root_weight(goal)).ravel()


def _root_weight(goal: GoalImage) -> jax.Array:
    """(V, H, W, 1), whose squares are what a pixel counts in the mean over views."""
    num_valid = jnp.maximum(jnp.sum(goal.valid, axis=(1, 2), keepdims=True), 1.0)
    return jnp.sqrt(goal.valid / (4.0 * num_valid * len(goal.valid)))[..., None]


def psnr_db(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio of images in [0, 1] [dB]."""
    return float(-10.0 * jnp.log10(mean_squared_error))
