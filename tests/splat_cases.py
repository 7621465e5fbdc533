"""Small splats and cameras that several tests of the renderers share."""

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.splat.camera import look_at
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.types import SplatModel

# One compiled renderer, so that tests whose arguments have the same shapes share programs.
render_jit = jax.jit(render)
IDENTITY = jnp.eye(4)[None]  # poses of one link that stays where the world is


def splats(mean, rgb=None, *, radius=0.02, density=2.0, shade=0.1, tau=0.03, starts=(0,)):
    """Splats (G, 3) on one link; ``shade`` fills the gradients of color by view."""
    mean = jnp.asarray(mean)
    num = len(mean)
    return SplatModel(
        mean=mean,
        radius=jnp.broadcast_to(jnp.asarray(radius, mean.dtype), num),
        density=jnp.broadcast_to(jnp.asarray(density, mean.dtype), num),
        rgb=jnp.full((num, 3), 0.5, mean.dtype) if rgb is None else jnp.asarray(rgb, mean.dtype),
        view_color_gradient=jnp.full((num, 3), shade, mean.dtype),
        link=jnp.zeros(num, jnp.int32),
        tau=jnp.asarray(tau, mean.dtype),
        starts=starts,
    )


def camera_ahead(height=48, width=40):
    """A camera at the origin that looks along x; y points left and z up in the image."""
    return look_at((0, 0, 0), (1, 0, 0), height=height, width=width)


def agree(a, b):
    """Cosine and relative distance of two gradients."""
    a, b = np.ravel(a), np.ravel(b)
    cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
    return cosine, np.linalg.norm(a - b) / np.linalg.norm(b)


def squares(image):
    """Mean of the squares of the color's and alpha's values."""
    return sum(jnp.mean(channel**2) for channel in image)


def slopes(loss, x, rng):
    """For each entry of a dict: its slope along a random direction, and that of the gradient.

    By finite differences of a compiled loss; call it in float64.
    """
    loss = jax.jit(jax.value_and_grad(loss))
    _, gradient = loss(x)
    for name, value in x.items():
        direction = jnp.asarray(rng.normal(size=value.shape))
        high, low = (loss({**x, name: value + s * direction})[0] for s in (1e-6, -1e-6))
        yield name, (high - low) / 2e-6, jnp.sum(gradient[name] * direction)
