"""From sums over splats to an image: color and alpha of each layer, and layers over each other.

The gradients are written out. Automatic differentiation of a division squares the divisor, here a
weight, and the square underflows for splats far behind the nearest one.
"""

import jax
import jax.numpy as jnp
from jax import lax

from vrrt_jax.core.precision import single_precision

MIN_WEIGHT = 1e-37  # added to weights before a division


@jax.custom_vjp
def composite_layers(sums: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draw layers of splats over each other.

    Args:
        sums: (L, 5, H, W) sums over each layer's splats of footprint times feature. The channels
            are weighted rgb, weight and density.

    Returns:
        rgb (3, H, W) over black, and alpha (H, W).
    """
    return _composite_fwd(sums)[0]


def _composite_fwd(sums):
    # Color is a weighted mean. Alpha follows from the optical depth, the sum of densities.
    inverse = 1.0 / (sums[:, 3] + MIN_WEIGHT)
    alpha = 1.0 - jnp.exp(-sums[:, 4])
    color = sums[:, :3] * inverse[:, None]
    rgb = color * alpha[:, None]
    # Merge one layer after the other. The images before each merge are kept for the gradient.
    merged, before = (rgb[0], alpha[0], sums[0, 3]), []
    for layer in range(1, len(sums)):
        before.append(merged)
        merged = _merge(merged, (rgb[layer], alpha[layer], sums[layer, 3]))
    return merged[:2], (color, rgb, alpha, inverse, before, sums[:, 3])


def _composite_bwd(residuals, image_grad):
    color, rgb, alpha, inverse, before, weight = residuals
    # Undo the merges from the last to the first. The final image does not show its weight.
    merged_grad, later_grads = (*image_grad, jnp.zeros_like(image_grad[1])), []
    for layer in range(len(before), 0, -1):
        own = (rgb[layer], alpha[layer], weight[layer])
        merged_grad, layer_grad = _merge_vjp(before[layer - 1], own, merged_grad)
        later_grads.insert(0, layer_grad)
    # From each layer's color and alpha to its sums.
    sums_grad = []
    for layer, (rgb_grad, alpha_grad, weight_grad) in enumerate([merged_grad, *later_grads]):
        along_color = sum(rgb_grad[c] * color[layer, c] for c in range(3))
        scale = alpha[layer] * inverse[layer]
        density_grad = (alpha_grad + along_color) * (1.0 - alpha[layer])
        sums_grad += [
            rgb_grad * scale,
            (weight_grad - along_color * scale)[None],
            density_grad[None],
        ]
    # The barrier keeps XLA from fusing the shared terms into each of their uses.
    sums_grad = lax.optimization_barrier(sums_grad)
    return (jnp.concatenate(sums_grad).reshape(len(weight), 5, *weight.shape[1:]),)


# JAX calls these rules itself, in the precision that the user has set.
composite_layers.defvjp(single_precision(_composite_fwd), single_precision(_composite_bwd))


def _merge(a, b):
    """Two layers as one: each hides the other where it is in front, and as far as it covers.

    A layer is rgb (3, H, W), alpha (H, W) and weight (H, W).
    """
    (rgb_a, alpha_a, weight_a), (rgb_b, alpha_b, weight_b) = a, b
    weight = weight_a + weight_b
    # The nearer layer has the larger weight.
    b_in_front = weight_b / (weight + MIN_WEIGHT)
    rgb = rgb_a * (1.0 - alpha_b * b_in_front) + rgb_b * (1.0 - alpha_a * (1.0 - b_in_front))
    return rgb, alpha_a + alpha_b - alpha_a * alpha_b, weight


def _merge_vjp(a, b, merged_grad):
    """Gradients of both layers from the gradient of the merged one."""
    (rgb_a, alpha_a, weight_a), (rgb_b, alpha_b, weight_b) = a, b
    rgb_grad, alpha_grad, weight_grad = merged_grad
    inverse = 1.0 / (weight_a + weight_b + MIN_WEIGHT)
    b_in_front = weight_b * inverse
    a_in_front = 1.0 - b_in_front
    # What it costs to hide a layer's color, and from it the gradient of being in front.
    hidden_a = sum(rgb_grad[c] * rgb_a[c] for c in range(3))
    hidden_b = sum(rgb_grad[c] * rgb_b[c] for c in range(3))
    front_grad = (alpha_a * hidden_b - alpha_b * hidden_a) * inverse
    a_grad = (
        rgb_grad * (1.0 - alpha_b * b_in_front),
        alpha_grad * (1.0 - alpha_b) - a_in_front * hidden_b,
        weight_grad - front_grad * b_in_front,
    )
    b_grad = (
        rgb_grad * (1.0 - alpha_a * a_in_front),
        alpha_grad * (1.0 - alpha_a) - b_in_front * hidden_a,
        weight_grad + front_grad * a_in_front,
    )
    return lax.optimization_barrier((a_grad, b_grad))
