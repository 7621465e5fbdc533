"""Boxes around ellipsoids, for samples of informed planners."""

from typing import Any

import jax
import jax.numpy as jnp


def half_extents(step: jax.Array, total: jax.Array) -> jax.Array:
    """Half the width (D,) of an ellipsoid: of the points with distances that sum up to ``total``.

    Args:
        step: (D,) from one of its foci to the other.
        total: () sum of the distances to the two.
    """
    return jnp.sqrt(jnp.maximum(total**2 - jnp.sum(step**2) + step**2, 0.0)) / 2


def box_inside_limits(
    world: Any, middle: jax.Array, half: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Bounds (D,) and (D,) of a box around ``middle`` (D,), inside the limits of a world.

    Joints that wrap keep their whole range.
    """
    half = jnp.where(world.is_continuous, jnp.inf, half)
    return jnp.maximum(world.lower, middle - half), jnp.minimum(world.upper, middle + half)
