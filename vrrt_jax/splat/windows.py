"""Windows: small parts of the image that hold all that a cluster of neighboring splats shows.

A sum over a window costs much less than one over the whole image. Which splats share a window, and
the windows' size, are chosen once, for a robot and a camera. Where the windows are follows from
each pose. A cluster that does not fit its window in some pose is summed over the whole image.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.types import pytree, static
from vrrt_jax.splat.projection import MIN_LOG_WEIGHT, ProjectedSplats, project_splats
from vrrt_jax.splat.types import Camera, SplatModel

FAINTEST = 1e-3  # what a splat may add to color or alpha outside its window
CLUSTER_SIZES = range(16, 97, 16)  # sizes other than multiples of 16 are slow
WINDOW_COST = 24  # a window costs as much time as this many splats in it
MAX_SHARE = 5 / 8  # of the image's side, above which windows do not pay
MIN_FITTING = 0.95  # share of the clusters that a window has to hold


@pytree
class Windows:
    """How to cut a rendering into small sums; from :func:`choose_windows`."""

    cluster_size: int = static()  # number of consecutive splats that share a window
    size_px: int = static()  # height and width of a window


class ImageLayout(NamedTuple):
    """What is the same in every lane."""

    size: tuple[int, int]  # height and width of the image [px]
    starts: tuple[int, ...]  # first splat of each layer
    windows: Windows | None


class WindowPlacement(NamedTuple):
    """Where the K windows of one image are."""

    corner: jax.Array  # (2, K) i32 left, top [px]
    fits: jax.Array  # (K,) bool, whether the window holds all that its cluster shows


def split_layers(layout: ImageLayout, of_splats: Any) -> list[Any]:
    """Cut arrays (..., G), or a tree of them, into one part for each layer."""
    ends = (*layout.starts[1:], None)
    return [
        jax.tree.map(lambda a: a[..., start:end], of_splats)  # noqa: B023 - used at once
        for start, end in zip(layout.starts, ends, strict=True)
    ]


def place_windows(
    splats: ProjectedSplats, depth: jax.Array, tau: jax.Array, layout: ImageLayout
) -> WindowPlacement:
    """Put each cluster's window where the cluster begins, or as near to it as the image allows.

    Args:
        splats: in the image, clustered by :func:`choose_windows`.
        depth: (G,) of the splats [m].
        tau: () softness of occlusion [m].
        layout: with windows.
    """
    assert layout.windows is not None
    px, (height, width) = layout.windows.size_px, layout.size
    low, high = _cluster_bounds(splats, depth, tau, layout, layout.windows.cluster_size)
    corner = jnp.minimum(low, jnp.array([[width - px], [height - px]]))
    return WindowPlacement(corner, jnp.all(high <= corner + px, axis=0))


def choose_windows(
    model: SplatModel, poses: jax.Array, camera: Camera
) -> tuple[SplatModel, Windows | None]:
    """Group splats into clusters of neighbors on one link, and find windows that hold them.

    Args:
        model: splats bound to links.
        poses: (n, L, 4, 4) link-to-world transforms of some tens of typical configurations.
        camera: the view.

    Returns:
        The same model in another order, with copies of no density that fill up the clusters, and
        the windows to render it with. The model as it was and None if no window smaller than 5/8 of
        the image holds 95 % of the clusters.
    """
    clustered, cluster_size = _cluster(model)
    needed = _needed_px(clustered, poses, camera, cluster_size)
    # Sizes in steps of 8 px.
    size_px = int(8 * np.ceil(np.quantile(needed, MIN_FITTING) / 8))
    if size_px > MAX_SHARE * min(camera.height, camera.width):
        return model, None
    return clustered, Windows(cluster_size=cluster_size, size_px=size_px)


def _cluster(model: SplatModel) -> tuple[SplatModel, int]:
    """The model's splats ordered by clusters of one size, and that size."""
    mean, link = np.asarray(model.mean), np.asarray(model.link)
    # Each link fills up its last clusters, so that small clusters waste few splats, but take more
    # windows.
    _, counts = np.unique(link, return_counts=True)
    size = min(CLUSTER_SIZES, key=lambda n: np.sum(-(-counts // n)) * (n + WINDOW_COST))
    groups = [
        group
        for value in np.unique(link)
        for group in _halve(np.flatnonzero(link == value), mean, size)
    ]
    # Groups that are too small repeat their splats; the copies get no density.
    order = np.concatenate([np.resize(group, size) for group in groups])
    is_copy = np.concatenate([np.arange(size) >= len(group) for group in groups])
    clustered = jax.tree.map(lambda a: a[order] if a.ndim else a, model)
    # Layers begin with a link, and so with a cluster.
    starts = np.searchsorted(link[order], link[list(model.starts)])
    clustered = dataclasses.replace(
        clustered,
        density=jnp.where(is_copy, 0.0, clustered.density),
        starts=tuple(starts.tolist()),
    )
    return clustered, size


def _halve(members: np.ndarray, mean: np.ndarray, most: int) -> list[np.ndarray]:
    """Cut splats across their longest side until no part has more than ``most``."""
    parts = -(-len(members) // most)
    if parts == 1:
        return [members]
    axis = np.argmax(np.ptp(mean[members], axis=0))
    members = members[np.argsort(mean[members, axis], kind="stable")]
    cut = len(members) * (parts // 2) // parts
    return _halve(members[:cut], mean, most) + _halve(members[cut:], mean, most)


@functools.partial(jax.jit, static_argnums=3)
@functools.partial(jax.vmap, in_axes=(None, 0, None, None))
def _needed_px(model: SplatModel, poses: jax.Array, camera: Camera, cluster_size: int) -> jax.Array:
    """Pixels (K,) that clusters extend over, in the longer direction."""
    layout = ImageLayout((camera.height, camera.width), model.starts, None)
    splats, depth = project_splats(model, poses, camera)
    low, high = _cluster_bounds(splats, depth, model.tau, layout, cluster_size)
    return jnp.max(high - low, axis=0)


def _cluster_bounds(
    splats: ProjectedSplats,
    depth: jax.Array,
    tau: jax.Array,
    layout: ImageLayout,
    cluster_size: int,
) -> tuple[jax.Array, jax.Array]:
    """First and last pixels (2, K) x, y that clusters reach, clipped to the image.

    A splat may outshine a splat of its layer far behind it even where its own footprint is faint.
    Its reach therefore grows with the depth behind it.
    """
    density = splats.features[-1]
    shows = density > FAINTEST
    # The farthest visible splat of the layer bounds how much a splat may outshine.
    layers = split_layers(layout, jnp.where(shows, depth, -jnp.inf))
    farthest = jnp.concatenate([jnp.full_like(layer, jnp.max(layer)) for layer in layers])
    log_outshines = jnp.minimum((farthest - depth) / tau, -MIN_LOG_WEIGHT)
    # Solve density * exp(-r^2 / 2) * outshines = FAINTEST for the radius r in deviations.
    over = jnp.log(density / FAINTEST) + log_outshines
    reach = jnp.sqrt(2.0 * jnp.maximum(over, 0.0)) / splats.inv_sigma
    height, width = layout.size
    low = jnp.where(shows, splats.pixel - reach, jnp.inf).reshape(2, -1, cluster_size)
    high = jnp.where(shows, splats.pixel + reach, -jnp.inf).reshape(2, -1, cluster_size)
    end = jnp.array([[width], [height]])
    low = jnp.clip(jnp.floor(jnp.min(low, axis=-1)), 0, end)
    return low.astype(jnp.int32), jnp.clip(jnp.max(high, axis=-1), 0, end)
