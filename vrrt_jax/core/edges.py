"""Steering and edges: differences that respect wrapping joints, and collision along an edge."""

import jax
import jax.numpy as jnp

from vrrt_jax.core.world import World, is_free


def difference(world: World, q_from: jax.Array, q_to: jax.Array) -> jax.Array:
    """The step (..., D) from one configuration to another, the short way round."""
    step = q_to - q_from
    turns = jnp.where(world.wraps, jnp.round(step / (2 * jnp.pi)), 0.0)
    return step - 2 * jnp.pi * turns


def distance(world: World, q_a: jax.Array, q_b: jax.Array) -> jax.Array:
    """Length (...) of the straight edge between configurations (..., D) [rad]."""
    return jnp.sqrt(jnp.sum(difference(world, q_a, q_b) ** 2, axis=-1))


def normalise(world: World, q: jax.Array) -> jax.Array:
    """Bring wrapping joints of (..., D) back to [-pi, pi)."""
    turns = jnp.where(world.wraps, jnp.floor((q + jnp.pi) / (2 * jnp.pi)), 0.0)
    return q - 2 * jnp.pi * turns


def into_limits(world: World, q: jax.Array) -> jax.Array:
    """The nearest configurations (..., D) inside the limits."""
    return jnp.where(world.wraps, normalise(world, q), jnp.clip(q, world.lower, world.upper))


def steer(world: World, q_from: jax.Array, target: jax.Array, max_length: jax.Array) -> jax.Array:
    """The step (..., D) towards a target, inside the limits and no longer than ``max_length``.

    Limits clip each joint by itself, so that a step into a limit slides along it.
    """
    step = difference(world, q_from, target)
    inside = jnp.clip(q_from + step, world.lower, world.upper) - q_from
    step = jnp.where(world.wraps, step, inside)
    length = jnp.sqrt(jnp.sum(step**2, axis=-1, keepdims=True))
    return step * jnp.minimum(1.0, max_length / jnp.maximum(length, 1e-12))


def free_steps(world: World, q_from: jax.Array, step: jax.Array, num_steps: int) -> jax.Array:
    """How far one can go along edges before something is touched.

    Args:
        world: what to collide with.
        q_from: (B, D) starts, taken to be free.
        step: (B, D) edges.
        num_steps: S sub-steps along each edge, checked at their far ends.

    Returns:
        (B,) i32 number of leading sub-steps that are free; S where the whole edge is.
    """
    fraction = jnp.arange(1, num_steps + 1, dtype=step.dtype) / num_steps
    points = q_from[:, None] + fraction[:, None] * step[:, None]
    free = jax.vmap(is_free, (None, 0))(world, points.reshape(-1, step.shape[-1]))
    return jnp.sum(jnp.cumprod(free.reshape(points.shape[:2]), axis=1), axis=1)
