"""A splat rasterizer made of matrix products.

The footprint of an isotropic Gaussian is a row profile times a column profile, so the sum of all
splats' features over the image is one product of matrices, and its gradient two more. There is no
sort, no tile and no cut-off: every splat keeps a gradient. Occlusion is a soft z-buffer: colors
are averaged with weights that fall off with depth behind the nearest splat. As a near splat then
outshines far ones even where it is faint, silhouettes before the robot's own body would grow. So
links are drawn in layers, an arm apart from its base, say, and a layer hides another where it is
in front and only as far as it covers.

On a CPU most of those products multiply by zero. With :func:`choose_windows` neighbouring splats
are summed over a small window of the image, and the windows are added. Neighbours that do not fit
their window in some pose are summed over the whole image, so that the picture stays the same.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from vrrt_jax.core.types import pytree, static
from vrrt_jax.splat.types import Camera, SplatModel

LANES = 32  # that are rendered at once
NEAR = 0.05  # [m] splats nearer than this to the camera plane are not drawn
PIXEL_BLUR = 0.1  # [px] a pixel's own footprint, added to every splat's; more costs up to 3 dB
# The faintest footprint that counts in a float32 alpha, 6e-8, times exp(-66) is still a normal
# number. So a splat keeps its color however far it is behind the nearest one.
MIN_LOG_WEIGHT = -66.0
MIN_WEIGHT = 1e-37
FAINTEST = 1e-3  # what a splat may add to color or alpha outside its window


@pytree
class Windows:
    """How to cut a rendering into small products; from :func:`choose_windows`."""

    cluster: int = static()  # every so many consecutive splats share a window
    px: int = static()  # height and width of a window


class _Splats(NamedTuple):
    """Splats in the image; the gradient has the same form."""

    pixel: jax.Array  # (2, G) x, y [px]
    inv_sigma: jax.Array  # (G,) [1/px]
    features: jax.Array  # (C, G)


class _Layout(NamedTuple):
    """What is the same in every lane."""

    size: tuple[int, int]  # height and width of the image
    starts: tuple[int, ...]  # first splat of each layer
    windows: Windows | None


class _Places(NamedTuple):
    """Where the windows of an image are."""

    corner: jax.Array  # (2, K) i32 left, top [px]
    fits: jax.Array  # (K,) bool, all that the cluster shows is in its window


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
        rgb (H, W, 3), the robot over black, and alpha (H, W).
    """
    layout = _Layout((camera.height, camera.width), model.starts, windows)
    splats, depth = _project(model, poses, camera)
    places = None
    if windows is not None:
        low, high = _extents(splats, depth, model.tau, layout, windows.cluster)
        room = jnp.array([[camera.width - windows.px], [camera.height - windows.px]])
        corner = jnp.minimum(low, room)
        places = _Places(corner, jnp.all(high <= corner + windows.px, axis=0))
    rgb, alpha = _composite(_image(splats, places, layout))
    return jnp.moveaxis(rgb, 0, -1), alpha


def map_lanes(f: Callable, *args: Any) -> Any:
    """Map ``f``, which renders, over the leading axis of all arguments' leaves.

    Like ``vmap``, but with the memory of :data:`LANES` lanes however many there are.
    """
    return lax.map(lambda lane: f(*lane), args, batch_size=LANES)


def splat_sum(
    pixel: jax.Array, inv_sigma: jax.Array, features: jax.Array, size: tuple[int, int]
) -> jax.Array:
    """Sum over splats of Gaussian footprint times feature.

    Args:
        pixel: (G, 2) centers x, y [px].
        inv_sigma: (G,) one over the standard deviation [1/px].
        features: (G, C).
        size: (H, W), static.

    Returns:
        (H, W, C).
    """
    splats = _Splats(pixel.T, inv_sigma, features.T)
    return jnp.moveaxis(_image(splats, None, _Layout(size, (0,), None)), 1, -1)[0]


def _project(model: SplatModel, poses: jax.Array, camera: Camera) -> tuple[_Splats, jax.Array]:
    """Splats with features weighted rgb, weight, density; and depths (G,) [m]."""
    # Small products in place of a gather of poses, whose gradient is a slow scatter.
    link_to_cam = jnp.matmul(camera.world_to_cam, poses, precision="highest")[:, :3]
    of_link = jax.nn.one_hot(model.link, len(poses), dtype=poses.dtype, axis=0)
    mean = jnp.concatenate([model.mean.T, jnp.ones_like(model.radius)[None]])
    point = _by_link(link_to_cam, of_link, mean)
    view_color_gradient = _by_link(link_to_cam[:, :, :3], of_link, model.view_color_gradient.T)
    visible = point[2] > NEAR
    depth = jnp.where(visible, point[2], 1.0)
    away = lax.rsqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2 + 1e-12) * point
    lit = 1.0 - (
        away[0] * view_color_gradient[0]
        + away[1] * view_color_gradient[1]
        + away[2] * view_color_gradient[2]
    )
    density = jnp.where(visible, model.density, 0.0)
    nearest = jnp.min(jnp.where(visible, depth, jnp.inf))
    nearest = lax.stop_gradient(jnp.where(jnp.isfinite(nearest), nearest, 1.0))
    behind = jnp.where(visible, (nearest - depth) / model.tau, 0.0)
    weight = density * jnp.exp(jnp.maximum(behind, MIN_LOG_WEIGHT))
    splats = _Splats(
        pixel=camera.focal * point[:2] / depth + camera.principal_point[:, None],
        inv_sigma=lax.rsqrt((camera.focal * model.radius / depth) ** 2 + PIXEL_BLUR**2),
        features=jnp.concatenate([model.rgb.T * (weight * lit), weight[None], density[None]]),
    )
    return splats, depth


def _by_link(matrices: jax.Array, of_link: jax.Array, vectors: jax.Array) -> jax.Array:
    """Matrices (L, 3, n) of links times vectors (n, G) of splats, bound by ``of_link`` (L, G)."""
    bound = (of_link[:, None] * vectors).reshape(-1, vectors.shape[1])
    side_by_side = jnp.moveaxis(matrices, 0, 1).reshape(3, -1)
    return jnp.dot(side_by_side, bound, precision="highest")


@jax.custom_vjp
def _composite(total: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Color (3, H, W) and alpha (H, W) from sums (L, 5, H, W) of the layers.

    The channels are weighted rgb, weight and density.
    """
    return _composite_fwd(total)[0]


def _composite_fwd(total):
    # Weights may be so small that their square, which automatic derivatives take, underflows.
    inverse = 1.0 / (total[:, 3] + MIN_WEIGHT)
    alpha = 1.0 - jnp.exp(-total[:, 4])
    color = total[:, :3] * inverse[:, None]
    rgb = color * alpha[:, None]
    over, merges = (rgb[0], alpha[0], total[0, 3]), []
    for layer in range(1, len(total)):
        merges.append(over)
        over = _merge(over, (rgb[layer], alpha[layer], total[layer, 3]))
    return over[:2], (color, rgb, alpha, inverse, merges, total[:, 3])


def _merge(a, b):
    """Two layers as one: each hides the other where it is in front and as far as it covers."""
    (rgb_a, alpha_a, weight_a), (rgb_b, alpha_b, weight_b) = a, b
    weight = weight_a + weight_b
    b_in_front = weight_b / (weight + MIN_WEIGHT)
    rgb = rgb_a * (1.0 - alpha_b * b_in_front) + rgb_b * (1.0 - alpha_a * (1.0 - b_in_front))
    return rgb, alpha_a + alpha_b - alpha_a * alpha_b, weight


def _merge_bar(a, b, bars):
    (rgb_a, alpha_a, weight_a), (rgb_b, alpha_b, weight_b) = a, b
    rgb_bar, alpha_bar, weight_bar = bars
    inverse = 1.0 / (weight_a + weight_b + MIN_WEIGHT)
    b_in_front = weight_b * inverse
    a_in_front = 1.0 - b_in_front
    hidden_a = sum(rgb_bar[c] * rgb_a[c] for c in range(3))
    hidden_b = sum(rgb_bar[c] * rgb_b[c] for c in range(3))
    front_bar = (alpha_a * hidden_b - alpha_b * hidden_a) * inverse
    a_bar = (
        rgb_bar * (1.0 - alpha_b * b_in_front),
        alpha_bar * (1.0 - alpha_b) - a_in_front * hidden_b,
        weight_bar - front_bar * b_in_front,
    )
    b_bar = (
        rgb_bar * (1.0 - alpha_a * a_in_front),
        alpha_bar * (1.0 - alpha_a) - b_in_front * hidden_a,
        weight_bar + front_bar * a_in_front,
    )
    return lax.optimization_barrier((a_bar, b_bar))


def _composite_bwd(residuals, bars):
    color, rgb, alpha, inverse, merges, weight = residuals
    bars, layer_bars = (*bars, jnp.zeros_like(bars[1])), []
    for layer in range(len(merges), 0, -1):
        own = (rgb[layer], alpha[layer], weight[layer])
        bars, own_bars = _merge_bar(merges[layer - 1], own, bars)
        layer_bars.insert(0, own_bars)
    total_bars = []
    for layer, (rgb_bar, alpha_bar, weight_bar) in enumerate([bars, *layer_bars]):
        along = sum(rgb_bar[c] * color[layer, c] for c in range(3))
        scale = alpha[layer] * inverse[layer]
        density_bar = (alpha_bar + along) * (1.0 - alpha[layer])
        total_bars += [rgb_bar * scale, (weight_bar - along * scale)[None], density_bar[None]]
    total_bars = lax.optimization_barrier(total_bars)
    return (jnp.concatenate(total_bars).reshape(len(weight), 5, *weight.shape[1:]),)


_composite.defvjp(_composite_fwd, _composite_bwd)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _image(splats: _Splats, places: _Places | None, layout: _Layout) -> jax.Array:
    """Sums (L, C, H, W) over each layer's splats of footprint times feature."""
    return _image_fwd(splats, places, layout)[0]


def _image_fwd(splats, places, layout):
    whole = functools.partial(_sum_whole, layout)
    cut = whole if places is None else functools.partial(_sum_windows, layout)
    return _each_lane(cut, whole)(splats, places), (splats, places)


def _image_bwd(layout, residuals, image_bar):
    splats, places = residuals
    whole = functools.partial(_sum_whole_bar, layout)
    cut = whole if places is None else functools.partial(_sum_windows_bar, layout)
    return _each_lane(cut, whole)(splats, places, image_bar), None


_image.defvjp(_image_fwd, _image_bwd)


def _layers(layout: _Layout, of_splats: Any) -> list[Any]:
    """Arrays (..., G), or a tree of them, of each layer's splats."""
    ends = (*layout.starts[1:], None)
    return [
        jax.tree.map(lambda a: a[..., start:end], of_splats)  # noqa: B023 - used at once
        for start, end in zip(layout.starts, ends, strict=True)
    ]


def _sum_whole(layout, splats, places=None):
    return jnp.stack([_sum(layout.size, layer) for layer in _layers(layout, splats)])


def _sum_whole_bar(layout, splats, places, image_bar):
    layers = _layers(layout, splats)
    bars = [_sum_bar(layer, bar) for layer, bar in zip(layers, image_bar, strict=True)]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), *bars)


def _sum(size, splats):
    """Sum (C, H, W) of all splats over the whole image."""
    return _products(_clusters(splats, 1), jnp.zeros((2, 1), jnp.int32), size)[0]


def _sum_bar(splats, image_bar):
    corner = jnp.zeros((2, 1), jnp.int32)
    bars = _products_bar(_clusters(splats, 1), corner, image_bar[None])
    return jax.tree.map(lambda bar: bar[0], bars)


def _cluster_layers(layout: _Layout, num: int, cluster: int) -> jax.Array:
    """Layers (K,) of the clusters."""
    first = cluster * np.arange(num)
    return jnp.asarray(np.searchsorted(layout.starts, first, side="right") - 1)


def _sum_windows(layout, splats, places):
    windows, num = layout.windows, len(places.fits)
    clusters, layer = _clusters(splats, num), _cluster_layers(layout, num, windows.cluster)
    inside = jnp.where(places.fits[:, None, None], clusters.features, 0.0)
    window = (windows.px, windows.px)
    sums = _products(clusters._replace(features=inside), places.corner, window)
    order = jnp.argsort(places.fits)

    def add_at(image, start, part):
        old = lax.dynamic_slice(image, start, part.shape)
        return lax.dynamic_update_slice(image, old + part, start)

    def add(k, image):
        left, top = places.corner[:, k]
        return add_at(image, (layer[k], 0, top, left), sums[k][None])

    def add_outside(i, image):
        k = order[i]
        own = _sum(layout.size, jax.tree.map(lambda a: a[k], clusters))
        return add_at(image, (layer[k], 0, 0, 0), own[None])

    image = jnp.zeros((len(layout.starts), sums.shape[1], *layout.size), sums.dtype)
    image = lax.fori_loop(0, num, add, image)
    return lax.fori_loop(0, jnp.sum(~places.fits), add_outside, image)


def _sum_windows_bar(layout, splats, places, image_bar):
    windows, num = layout.windows, len(places.fits)
    clusters, layer = _clusters(splats, num), _cluster_layers(layout, num, windows.cluster)
    window = (1, image_bar.shape[1], windows.px, windows.px)
    left, top = places.corner
    sums_bar = jax.vmap(lambda k, x, y: lax.dynamic_slice(image_bar, (k, 0, y, x), window)[0])(
        layer, left, top
    )
    bars = _products_bar(clusters, places.corner, sums_bar)
    order = jnp.argsort(places.fits)

    def replace(i, bars):
        k = order[i]
        bar = _sum_bar(jax.tree.map(lambda a: a[k], clusters), image_bar[layer[k]])
        return jax.tree.map(lambda all, one: all.at[k].set(one), bars, bar)

    bars = lax.fori_loop(0, jnp.sum(~places.fits), replace, bars)
    return jax.tree.map(lambda a, bar: jnp.moveaxis(bar, 0, -2).reshape(a.shape), splats, bars)


def _clusters(splats: _Splats, num: int) -> _Splats:
    """From (..., G) to (num, ..., G / num)."""
    return jax.tree.map(lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], num, -1), -2, 0), splats)


def _products(clusters: _Splats, corner: jax.Array, window: tuple[int, int]) -> jax.Array:
    """Sums (K, C, h, w) over each cluster's splats, in its window."""
    (_, gx), (_, gy) = _profiles(clusters, corner, window)
    rows = (clusters.features[:, :, None] * gy[:, None]).reshape(len(gy), -1, gy.shape[-1])
    return (rows @ jnp.swapaxes(gx, 1, 2)).reshape(len(gy), -1, *window)


def _products_bar(clusters: _Splats, corner: jax.Array, sums_bar: jax.Array) -> _Splats:
    num, channels, height, width = sums_bar.shape
    features = clusters.features
    (dx, gx), (dy, gy) = _profiles(clusters, corner, (height, width))
    rows = (features[:, :, None] * gy[:, None]).reshape(num, channels * height, -1)
    sums_bar = sums_bar.reshape(num, channels * height, width)
    gx_bar = jnp.swapaxes(sums_bar, 1, 2) @ rows
    rows_bar = (sums_bar @ gx).reshape(num, channels, height, -1)
    gy_bar = sum(rows_bar[:, c] * features[:, c, None] for c in range(channels))
    along_x, along_y = gx_bar * gx, gy_bar * gy
    pixel_bar = jnp.stack([_over_pixels(along_x, dx), _over_pixels(along_y, dy)], axis=1)
    squares = _over_pixels(along_x, dx * dx) + _over_pixels(along_y, dy * dy)
    scale = clusters.inv_sigma
    features_bar = _over_pixels(rows_bar, gy[:, None])
    return _Splats(pixel_bar * scale[:, None], -squares / scale, features_bar)


def _over_pixels(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sum of a * b over the last axis but one.

    By halves, as XLA's CPU loops for the sum of a product are ten times slower than additions.
    """
    total = a * b
    while (num := total.shape[-2]) % 2 == 0:
        total = total[..., : num // 2, :] + total[..., num // 2 :, :]
    return functools.reduce(jnp.add, jnp.unstack(total, axis=-2))


def _profiles(clusters: _Splats, corner: jax.Array, window: tuple[int, int]):
    """For x and y: offsets (K, n, g) of n pixels in standard deviations, and footprints."""
    profiles = []
    for axis, n in ((0, window[1]), (1, window[0])):
        center = clusters.pixel[:, axis] - corner[axis][:, None]
        pixel = jnp.arange(n, dtype=center.dtype)[:, None] + 0.5
        offset = (pixel - center[:, None]) * clusters.inv_sigma[:, None]
        profiles.append((offset, jnp.exp(-0.5 * offset**2)))
    return profiles


def _each_lane(on_cpu: Callable, elsewhere: Callable) -> Callable:
    """One lane after the other on a CPU, whose caches hold no more; all at once elsewhere.

    Both functions take and give one lane. All ``vmap`` around the result become one leading axis.
    """

    @custom_vmap
    def lanes(*args):
        if jax.default_backend() == "cpu":
            return _in_turn(on_cpu, *args)
        return jax.vmap(elsewhere)(*args)

    @lanes.def_vmap
    def _merge(num, batched, *args):
        def merge(array, is_batched):
            array = array if is_batched else jnp.broadcast_to(array, (num, *array.shape))
            return array.reshape(-1, *array.shape[2:])

        out = lanes(*jax.tree.map(merge, args, tuple(batched)))
        out = jax.tree.map(lambda a: a.reshape(num, -1, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    def one(*args):
        return jax.tree.map(lambda a: a[0], lanes(*jax.tree.map(lambda a: a[None], args)))

    return one


def _in_turn(function: Callable, *args: Any) -> Any:
    """Like ``lax.map``, but copies each lane's inputs before they are used.

    XLA would fuse their slicing into every use and repeat it for each output element; passing them
    on from the turn before prevents that.
    """
    num = len(jax.tree.leaves(args)[0])

    def lane(i):
        return jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, i, keepdims=False), args)

    def turn(current, i):
        return lane(jnp.minimum(i + 1, num - 1)), function(*current)

    return lax.scan(turn, lane(0), jnp.arange(num))[1]


def _extents(
    splats: _Splats, depth: jax.Array, tau: jax.Array, layout: _Layout, cluster: int
) -> tuple[jax.Array, jax.Array]:
    """First and last pixels (2, K) x, y that clusters reach.

    A splat may outshine one of its layer far behind it even where its own footprint is faint, so
    that its reach grows with the depth behind it.
    """
    density = splats.features[-1]
    shows = density > FAINTEST
    layers = _layers(layout, jnp.where(shows, depth, -jnp.inf))
    farthest = jnp.concatenate([jnp.full_like(layer, jnp.max(layer)) for layer in layers])
    over = jnp.log(density / FAINTEST) + jnp.minimum((farthest - depth) / tau, -MIN_LOG_WEIGHT)
    reach = jnp.sqrt(2.0 * jnp.maximum(over, 0.0)) / splats.inv_sigma
    height, width = layout.size
    low = jnp.where(shows, splats.pixel - reach, jnp.inf).reshape(2, -1, cluster)
    high = jnp.where(shows, splats.pixel + reach, -jnp.inf).reshape(2, -1, cluster)
    end = jnp.array([[width], [height]])
    low = jnp.clip(jnp.floor(jnp.min(low, axis=-1)), 0, end)
    return low.astype(jnp.int32), jnp.clip(jnp.max(high, axis=-1), 0, end)


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
        the windows to :func:`render` it with. The model as it was and None if no window smaller
        than 5/8 of the image holds 95 % of the clusters.
    """
    mean, link = np.asarray(model.mean), np.asarray(model.link)
    _, counts = np.unique(link, return_counts=True)
    # A window costs as much as 24 splats in it. Other sizes than multiples of 16 are slow.
    cluster = min(range(16, 97, 16), key=lambda c: np.sum(-(-counts // c)) * (c + 24))
    groups = [
        group
        for value in np.unique(link)
        for group in _halve(np.flatnonzero(link == value), mean, cluster)
    ]
    order = np.concatenate([np.resize(group, cluster) for group in groups])
    spare = np.concatenate([np.arange(cluster) >= len(group) for group in groups])
    clustered = jax.tree.map(lambda a: a[order] if a.ndim else a, model)
    # Layers begin with a link, and so with a cluster.
    first = np.searchsorted(link[order], link[list(model.starts)])
    clustered = dataclasses.replace(
        clustered,
        density=jnp.where(spare, 0.0, clustered.density),
        starts=tuple(first.tolist()),
    )
    needed = _needed(clustered, poses, camera, cluster)
    px = int(8 * np.ceil(np.quantile(needed, 0.95) / 8))
    if px > 5 * min(camera.height, camera.width) // 8:
        return model, None
    return clustered, Windows(cluster=cluster, px=px)


@functools.partial(jax.jit, static_argnums=3)
@functools.partial(jax.vmap, in_axes=(None, 0, None, None))
def _needed(model: SplatModel, poses: jax.Array, camera: Camera, cluster: int) -> jax.Array:
    """Pixels (K,) that clusters reach over, in the longer direction."""
    layout = _Layout((camera.height, camera.width), model.starts, None)
    low, high = _extents(*_project(model, poses, camera), model.tau, layout, cluster)
    return jnp.max(high - low, axis=0)


def _halve(members: np.ndarray, mean: np.ndarray, most: int) -> list[np.ndarray]:
    """Cut splats across their longest side until no part has more than ``most``."""
    parts = -(-len(members) // most)
    if parts == 1:
        return [members]
    axis = np.argmax(np.ptp(mean[members], axis=0))
    members = members[np.argsort(mean[members, axis], kind="stable")]
    cut = len(members) * (parts // 2) // parts
    return _halve(members[:cut], mean, most) + _halve(members[cut:], mean, most)
