"""Rendering many images at once: how the lanes of a batch share time and memory."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

LANES = 32  # number of images that are rendered at once


def map_lanes(f: Callable, *args: Any) -> Any:
    """Map a function that renders over the leading axis of all arguments' leaves.

    The result is that of ``vmap``. The memory is that of :data:`LANES` lanes, however many there
    are.

    Args:
        f: a function of one lane.
        *args: trees of arrays (n, ...), for n lanes.

    Returns:
        What ``f`` returns, with a leading axis of n.
    """
    return lax.map(lambda lane: f(*lane), args, batch_size=LANES)


def each_lane(on_cpu: Callable, elsewhere: Callable) -> Callable:
    """A function of one lane that runs batches in the order that suits the machine.

    A CPU computes one lane after the other, because its caches hold no more than one. Other devices
    compute all lanes at once.

    Args:
        on_cpu: the function of one lane that is used on a CPU.
        elsewhere: a function with the same result that is used on other devices.

    Returns:
        A function of one lane. All ``vmap`` around it become one leading axis.
    """

    @custom_vmap
    def lanes(*args):
        if jax.default_backend() == "cpu":
            return _in_turn(on_cpu, *args)
        return jax.vmap(elsewhere)(*args)

    @lanes.def_vmap
    def _merge_axes(num, batched, *args):
        # The new axis joins the lanes' axis, so that nested maps become one longer batch.
        def merge(array, is_batched):
            array = array if is_batched else jnp.broadcast_to(array, (num, *array.shape))
            return array.reshape(-1, *array.shape[2:])

        out = lanes(*jax.tree.map(merge, args, tuple(batched)))
        out = jax.tree.map(lambda a: a.reshape(num, -1, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    def one(*args):
        return jax.tree.map(lambda a: a[0], lanes(*jax.tree.map(lambda a: a[None], args)))

    return one


def one_of(is_first: jax.Array, first: Callable, second: Callable, *args: Any) -> Any:
    """What one of two functions that render returns.

    Only that one is computed, but under ``vmap`` both are: there :func:`jax.lax.cond` would batch
    what :func:`each_lane` cannot.

    Args:
        is_first: () bool.
        first: a function of ``args`` that closes over no arrays.
        second: another one, whose results have the same shapes.
        *args: trees of arrays.
    """

    @custom_vmap
    def choose(is_first, *args):
        return lax.cond(is_first, first, second, *args)

    @choose.def_vmap
    def _both(num, batched, is_first, *args):
        def both(is_first, *args):
            pairs = first(*args), second(*args)
            return jax.tree.map(lambda a, b: jnp.where(is_first, a, b), *pairs)

        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
        out = jax.vmap(both, axes, axis_size=num)(is_first, *args)
        return out, jax.tree.map(lambda _: True, out)

    return choose(is_first, *args)


def _in_turn(function: Callable, *args: Any) -> Any:
    """Like ``lax.map``, but copies each lane's inputs before they are used.

    Without the copy XLA fuses the slicing of a lane into each of its uses, and repeats the slicing
    for each output element.
    """
    num = len(jax.tree.leaves(args)[0])

    def lane(i):
        return jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, i, keepdims=False), args)

    # Each turn computes the lane that the turn before has copied, and copies the next one.
    def turn(current, i):
        return lane(jnp.minimum(i + 1, num - 1)), function(*current)

    return lax.scan(turn, lane(0), jnp.arange(num))[1]
