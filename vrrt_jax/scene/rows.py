"""Functions of many rows: as one batch under any number of ``vmap``, and their least."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def over_rows(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """A function of what is common and of rows; what is common may be batched too, if slowly.

    Args:
        function: of arrays that are the same for all rows, and of arrays (n, ...); its outputs lead
            with n too.
    """

    @jax.custom_batching.custom_vmap
    def apply(common: Any, rows: Any) -> Any:
        return function(common, rows)

    @apply.def_vmap
    def batch(size: int, is_batched: Any, common: Any, rows: Any) -> Any:
        common_batched, rows_batched = is_batched
        rows = jax.tree.map(
            lambda leaf, batched: leaf if batched else jnp.broadcast_to(leaf, (size, *leaf.shape)),
            rows,
            rows_batched,
        )
        if any(jax.tree.leaves(common_batched)):  # one after another

            def one(index: jax.Array) -> Any:
                own = jax.tree.map(
                    lambda leaf, batched: leaf[index] if batched else leaf, common, common_batched
                )
                return apply(own, jax.tree.map(lambda leaf: leaf[index], rows))

            outputs = jax.lax.map(one, jnp.arange(size))
        else:
            flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), rows)
            num = jax.tree.leaves(rows)[0].shape[1]
            outputs = jax.tree.map(
                lambda leaf: leaf.reshape(size, num, *leaf.shape[1:]), apply(common, flat)
            )
        return outputs, jax.tree.map(lambda leaf: True, outputs)

    return apply


def least(rows: jax.Array) -> jax.Array:
    """The minimum of k rows (k, ...) in each column, inf of no rows; NaN where one is NaN.

    Halving is elementwise, and vectorized. In reductions over an axis that is not the last one,
    XLA's CPU backend computes each element by itself, with all that leads to it.
    """
    if len(rows) == 0:
        return jnp.full(rows.shape[1:], jnp.inf, rows.dtype)
    while len(rows) > 1:
        half = len(rows) // 2
        odd = rows[2 * half :]
        rows = jnp.minimum(rows[:half], rows[half : 2 * half])
        rows = jnp.minimum(rows, odd) if len(odd) else rows
    return rows[0]
