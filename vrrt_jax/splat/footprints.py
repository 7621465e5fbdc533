"""Sums over splats of Gaussian footprint times feature, as products of matrices.

The footprint of an isotropic Gaussian is a row profile times a column profile. The sum over all
splats is therefore one product of matrices, and its gradient two more. The gradient is written out,
because automatic differentiation would keep every product's inputs and reduce them slowly.

Letters: ``L`` layers, ``C`` features, ``K`` clusters, ``g`` splats of a cluster, ``h w`` window.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vrrt_jax.core.precision import single_precision
from vrrt_jax.splat.lanes import each_lane
from vrrt_jax.splat.projection import ProjectedSplats
from vrrt_jax.splat.windows import ImageLayout, WindowPlacement, split_layers


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def sum_footprints(
    splats: ProjectedSplats, placement: WindowPlacement | None, layout: ImageLayout
) -> jax.Array:
    """Sum footprint times feature over each layer's splats.

    Args:
        splats: in the image.
        placement: of the windows, if the layout has windows.
        layout: size of the image, layers and windows.

    Returns:
        (L, C, H, W).
    """
    return _sum_fwd(splats, placement, layout)[0]


def _sum_fwd(splats, placement, layout):
    # Windows save multiplications on a CPU. Elsewhere, one large product is faster.
    whole = functools.partial(_sum_whole, layout)
    cut = whole if placement is None else functools.partial(_sum_windows, layout)
    return each_lane(cut, whole)(splats, placement), (splats, placement)


def _sum_bwd(layout, residuals, image_grad):
    splats, placement = residuals
    whole = functools.partial(_sum_whole_vjp, layout)
    cut = whole if placement is None else functools.partial(_sum_windows_vjp, layout)
    return each_lane(cut, whole)(splats, placement, image_grad), None


# JAX calls these rules itself, in the precision that the user has set.
sum_footprints.defvjp(single_precision(_sum_fwd), single_precision(_sum_bwd))


def _sum_whole(layout, splats, placement=None):
    return jnp.stack([_sum_layer(layout.size, layer) for layer in split_layers(layout, splats)])


def _sum_whole_vjp(layout, splats, placement, image_grad):
    layers = split_layers(layout, splats)
    grads = [_sum_layer_vjp(layer, g) for layer, g in zip(layers, image_grad, strict=True)]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), *grads)


def _sum_layer(size, splats):
    """Sum (C, H, W) of one layer's splats: one cluster, whose window is the image."""
    return _products(_to_clusters(splats, 1), jnp.zeros((2, 1), jnp.int32), size)[0]


def _sum_layer_vjp(splats, image_grad):
    corner = jnp.zeros((2, 1), jnp.int32)
    grads = _products_vjp(_to_clusters(splats, 1), corner, image_grad[None])
    return jax.tree.map(lambda grad: grad[0], grads)


def _sum_windows(layout, splats, placement):
    windows, num = layout.windows, len(placement.fits)
    clusters, layer = _to_clusters(splats, num), _cluster_layers(layout, num)

    # Sum all clusters over their windows. Those that do not fit add nothing here.
    inside = jnp.where(placement.fits[:, None, None], clusters.features, 0.0)
    window = (windows.size_px, windows.size_px)
    sums = _products(clusters._replace(features=inside), placement.corner, window)

    def add_at(image, start, part):
        old = lax.dynamic_slice(image, start, part.shape)
        return lax.dynamic_update_slice(image, old + part, start)

    def add_window(k, image):
        left, top = placement.corner[:, k]
        return add_at(image, (layer[k], 0, top, left), sums[k][None])

    image = jnp.zeros((len(layout.starts), sums.shape[1], *layout.size), sums.dtype)
    image = lax.fori_loop(0, num, add_window, image)

    # Sum the few clusters that do not fit over the whole image. They come first in this order.
    order = jnp.argsort(placement.fits)

    def add_whole(i, image):
        k = order[i]
        own = _sum_layer(layout.size, jax.tree.map(lambda a: a[k], clusters))
        return add_at(image, (layer[k], 0, 0, 0), own[None])

    return lax.fori_loop(0, jnp.sum(~placement.fits), add_whole, image)


def _sum_windows_vjp(layout, splats, placement, image_grad):
    windows, num = layout.windows, len(placement.fits)
    clusters, layer = _to_clusters(splats, num), _cluster_layers(layout, num)

    # Cut each window out of the image's gradient, and take all clusters at once.
    window = (1, image_grad.shape[1], windows.size_px, windows.size_px)
    left, top = placement.corner
    sums_grad = jax.vmap(lambda k, x, y: lax.dynamic_slice(image_grad, (k, 0, y, x), window)[0])(
        layer, left, top
    )
    grads = _products_vjp(clusters, placement.corner, sums_grad)

    # Replace the gradients of the few clusters that do not fit. They come first in this order.
    order = jnp.argsort(placement.fits)

    def replace(i, grads):
        k = order[i]
        grad = _sum_layer_vjp(jax.tree.map(lambda a: a[k], clusters), image_grad[layer[k]])
        return jax.tree.map(lambda all, one: all.at[k].set(one), grads, grad)

    grads = lax.fori_loop(0, jnp.sum(~placement.fits), replace, grads)
    return jax.tree.map(lambda a, grad: jnp.moveaxis(grad, 0, -2).reshape(a.shape), splats, grads)


def _cluster_layers(layout: ImageLayout, num: int) -> jax.Array:
    """Layers (K,) that the clusters belong to."""
    assert layout.windows is not None
    first = layout.windows.cluster_size * np.arange(num)
    return jnp.asarray(np.searchsorted(layout.starts, first, side="right") - 1)


def _to_clusters(splats: ProjectedSplats, num: int) -> ProjectedSplats:
    """From (..., G) to (num, ..., G / num)."""
    return jax.tree.map(lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], num, -1), -2, 0), splats)


def _products(clusters: ProjectedSplats, corner: jax.Array, window: tuple[int, int]) -> jax.Array:
    """Sums (K, C, h, w) over each cluster's splats, in its window."""
    (_, gx), (_, gy) = _profiles(clusters, corner, window)
    # Rows (K, C h, g) times columns (K, g, w).
    rows = (clusters.features[:, :, None] * gy[:, None]).reshape(len(gy), -1, gy.shape[-1])
    return (rows @ jnp.swapaxes(gx, 1, 2)).reshape(len(gy), -1, *window)


def _products_vjp(
    clusters: ProjectedSplats, corner: jax.Array, sums_grad: jax.Array
) -> ProjectedSplats:
    """Gradient of the clusters' splats from the gradient (K, C, h, w) of :func:`_products`."""
    num, channels, height, width = sums_grad.shape
    features = clusters.features
    (dx, gx), (dy, gy) = _profiles(clusters, corner, (height, width))

    # Through the product, to the profiles of columns and rows.
    rows = (features[:, :, None] * gy[:, None]).reshape(num, channels * height, -1)
    sums_grad = sums_grad.reshape(num, channels * height, width)
    gx_grad = jnp.swapaxes(sums_grad, 1, 2) @ rows
    rows_grad = (sums_grad @ gx).reshape(num, channels, height, -1)
    gy_grad = sum(rows_grad[:, c] * features[:, c, None] for c in range(channels))

    # Through the profiles exp(-offset^2 / 2), to centers and deviations.
    along_x, along_y = gx_grad * gx, gy_grad * gy
    pixel_grad = jnp.stack([_over_pixels(along_x, dx), _over_pixels(along_y, dy)], axis=1)
    squares = _over_pixels(along_x, dx * dx) + _over_pixels(along_y, dy * dy)
    scale = clusters.inv_sigma
    features_grad = _over_pixels(rows_grad, gy[:, None])
    return ProjectedSplats(pixel_grad * scale[:, None], -squares / scale, features_grad)


def _profiles(clusters: ProjectedSplats, corner: jax.Array, window: tuple[int, int]):
    """For x and y: offsets (K, n, g) of n pixels from the centers in deviations, and profiles."""
    profiles = []
    for axis, n in ((0, window[1]), (1, window[0])):
        center = clusters.pixel[:, axis] - corner[axis][:, None]
        pixel = jnp.arange(n, dtype=center.dtype)[:, None] + 0.5
        offset = (pixel - center[:, None]) * clusters.inv_sigma[:, None]
        profiles.append((offset, jnp.exp(-0.5 * offset**2)))
    return profiles


def _over_pixels(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sum of a * b over the last axis but one.

    By halves, because XLA's CPU loop for the sum of a product takes ten times as long as additions.
    """
    total = a * b
    while (num := total.shape[-2]) % 2 == 0:
        total = total[..., : num // 2, :] + total[..., num // 2 :, :]
    return functools.reduce(jnp.add, jnp.unstack(total, axis=-2))
