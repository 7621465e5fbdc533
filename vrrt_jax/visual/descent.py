"""Adam on a loss over configurations, inside the joint limits."""

from collections.abc import Callable
from typing import Any

import jax
import optax

from vrrt_jax.core.edges import StraightLineEdges, enforce_bounds


def adam_descent(
    world: StraightLineEdges,
    gradient: Callable[[jax.Array], tuple[jax.Array, Any]],
    q: jax.Array,
    *,
    steps: Any,
    step_size: Callable[[jax.Array], Any],
    beta1: Any,
    beta2: Any,
    observe: Callable[[Any, jax.Array, jax.Array, Any], Any] = lambda seen, i, q, aux: seen,
    seen: Any = None,
) -> tuple[jax.Array, Any]:
    """Follow a gradient by Adam.

    Args:
        world: whose limits are kept.
        gradient: of configurations ``q`` (..., D): the gradient (..., D), and anything else.
        q: (..., D) where to begin.
        steps: () how many.
        step_size: length [rad] of step i.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        observe: what to remember of step i: ``observe(seen, i, q, anything else)``.
        seen: what is remembered before the first step.

    Returns:
        Where it ended (..., D), and what was remembered.
    """
    adam = optax.scale_by_adam(b1=beta1, b2=beta2, eps=1e-8)

    def step(i, carry):
        q, moments, seen = carry
        slope, aux = gradient(q)
        seen = observe(seen, i, q, aux)
        direction, moments = adam.update(slope, moments)
        return enforce_bounds(world, q - step_size(i) * direction), moments, seen

    q, _, seen = jax.lax.fori_loop(0, steps, step, (q, adam.init(q), seen))
    return q, seen
