"""Informed samples: only those that can be on a path shorter than the best one so far."""

import jax
import jax.numpy as jnp

from vrrt_jax.core.edges import Space

DRAWN = 16  # configurations that are drawn for each that is wanted


def sample_informed(
    world: Space, ends: tuple[jax.Array, jax.Array], cost: jax.Array, key: jax.Array, num: int
) -> tuple[jax.Array, jax.Array]:
    """Uniform samples of the informed set: configurations on paths shorter than ``cost``.

    They are drawn from a box around the set, and those outside of it are dropped. The set is that
    of the world's own metric: the distances to both ends sum up to less than ``cost``.

    Args:
        world: whose limits and metric.
        ends: the start (D,) and the goal (D,).
        cost: () length of the best path, inf if there is none: then all configurations will do.
        key: random key.
        num: samples that are wanted (static).

    Returns:
        (num, D) samples, and (num,) bool which of them are any: a small set may yield fewer.
    """
    lower, upper = world.informed_box(*ends, cost)
    shape = (DRAWN * num, lower.shape[0])
    q = jax.random.uniform(key, shape, minval=lower, maxval=jnp.maximum(lower, upper))
    start, goal = (jnp.broadcast_to(end, shape) for end in ends)
    inside = world.distance(start, q) + world.distance(q, goal) < cost
    chosen = jnp.flatnonzero(inside, size=num, fill_value=len(q))
    return q[jnp.minimum(chosen, len(q) - 1)], chosen < len(q)
