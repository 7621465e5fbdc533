"""Gradients of many configurations, and Adam, whose moments every node of a tree keeps."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from vrrt_jax.core.edges import StraightLineEdges
from vrrt_jax.core.types import Goal
from vrrt_jax.splat.lanes import map_lanes


def losses_and_gradients(world: Any, goal: Goal, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Losses (n,) of configurations (n, D), and their gradients (n, D)."""
    return map_lanes(jax.value_and_grad(lambda q: goal.loss(world, q)), q)


def fresh_moments(num: int, joints: int) -> optax.ScaleByAdamState:
    """Moments of ``num`` nodes that have taken no step: count (n,), mu (n, D), nu (n, D)."""
    zero = jnp.zeros((num, joints))
    return optax.ScaleByAdamState(count=jnp.zeros(num, jnp.int32), mu=zero, nu=zero)


def adam_step(
    world: StraightLineEdges,
    q: jax.Array,
    grad: jax.Array,
    moments: optax.ScaleByAdamState,
    alpha: jax.Array,
    beta1: Any,
    beta2: Any,
) -> tuple[jax.Array, optax.ScaleByAdamState]:
    """Steps (B, D) down a loss, and the moments after them.

    Args:
        world: whose limits are kept.
        q: (B, D) where the steps begin.
        grad: (B, D) of the loss there.
        moments: count (B,), mu (B, D), nu (B, D).
        alpha: (B,) lengths of the steps of a joint [rad].
        beta1: () decay of the first moment.
        beta2: () decay of the second moment.
    """
    adam = optax.scale_by_adam(b1=beta1, b2=beta2, eps=1e-8)
    direction, state = jax.vmap(adam.update)(grad, moments)
    step = -alpha[:, None] * jnp.asarray(direction)
    # Momentum into a limit would only hold the joint there.
    beyond = (q + step < world.lower) | (q + step > world.upper)
    stuck = ~world.is_continuous & beyond
    return step, state._replace(mu=jnp.where(stuck, 0.0, state.mu))
