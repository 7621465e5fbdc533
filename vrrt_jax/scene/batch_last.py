"""Run a function for a batch with the batch as the last axis, fast inside any ``jit`` on a CPU.

``jax.vmap`` puts the batch first. MJX's arrays then end in short axes (3 coordinates, 4 corners),
over which XLA's CPU backend cannot vectorize, and its fusions recompute long chains of small
products once for every output element (thousands of times slower, with ``mjx.kinematics``). Here a
function of one configuration is traced once, and its equations are evaluated with the batch as the
last axis: every operation is a loop over the batch. Barriers keep XLA from fusing too much.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend import core

from vrrt_jax.scene.flat_program import FlatProgram

_ELEMENTWISE = frozenset(
    "abs add and atan2 ceil clamp convert_element_type copy cos div eq exp floor ge gt integer_pow "
    "is_finite le log lt max min mul ne neg not or pow rem round rsqrt select_n sign sin sqrt "
    "square sub tan tanh xor".split()
)
_REDUCTIONS = {
    "reduce_and": operator.and_,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_or": operator.or_,
    "reduce_sum": operator.add,
}
# These name axes of their operand by number, which a further axis at the end does not change.
_BY_AXIS = frozenset((*_REDUCTIONS, "cumsum", "rev", "squeeze"))
_SHORT = 8  # an axis of at most this length is unrolled
# After a gather of at least this many axes (the batch included) XLA must not fuse, or its consumers
# repeat it. The barrier that XLA's CPU backend respects is a copy: others get the one that it does
# not, which is enough to keep it from taking concatenated arrays apart again.
_MANY_AXES = 4


class Value(NamedTuple):
    """An array, and whether its last axis is the batch."""

    array: Any
    is_batched: bool


def evaluate(
    program: FlatProgram, inputs: Sequence[Value], batch: int, seed: jax.Array
) -> list[Value]:
    """The outputs of a traced function for a batch.

    Args:
        program: of a function of one element of the batch.
        inputs: of the function, flat; batched ones have the batch ``n`` as their last axis.
        batch: n.
        seed: () float32, a number that the compiler does not know.
    """
    # A square leaves 0 or 1 modulo 4, which the compiler does not know either.
    bits = lax.bitcast_convert_type(seed, jnp.uint32)
    return _Evaluation(batch, (bits * bits) % 4 != 2).run(program, inputs)


class _Evaluation:
    """One evaluation: the size of its batch, and a predicate that is true."""

    def __init__(self, batch: int, is_true: jax.Array) -> None:
        self.batch, self.is_true = batch, is_true

    def run(self, program: FlatProgram, inputs: Sequence[Value]) -> list[Value]:
        """The outputs of a program."""
        known = {v: Value(array, False) for v, array in program.constants.items()}
        known |= dict(zip(program.inputs, inputs, strict=True))

        def read(variable: Any) -> Value:
            if isinstance(variable, core.Literal):
                return Value(variable.val, False)
            return known[variable]

        for equation in program.equations:
            outputs = self.step(equation, [read(variable) for variable in equation.invars])
            known.update(zip(equation.outvars, outputs, strict=True))
        return [read(variable) for variable in program.outputs]

    def step(self, equation: core.JaxprEqn, inputs: list[Value]) -> list[Value]:
        """The outputs of one equation."""
        primitive = equation.primitive
        is_batched = any(value.is_batched for value in inputs)
        if is_batched:
            found = self.batched(equation, inputs)
        else:
            found = primitive.bind(*(value.array for value in inputs), **equation.params)
        arrays = found if primitive.multiple_results else [found]
        if is_batched and primitive.name in ("concatenate", "gather"):
            arrays = [self.barrier(array, primitive.name == "gather") for array in arrays]
        return [Value(array, is_batched) for array in arrays]

    def barrier(self, array: jax.Array, is_gather: bool) -> jax.Array:
        """The same array, behind a barrier against fusion."""
        if not jnp.issubdtype(array.dtype, jnp.floating):
            return array
        if is_gather and array.ndim >= _MANY_AXES:
            return lax.cond(self.is_true, lambda x: x, jnp.zeros_like, array)
        return lax.optimization_barrier(array)

    def wide(self, value: Value, shape: Sequence[int]) -> jax.Array:
        """A value of a shape as an array of that shape and the batch."""
        array = jnp.asarray(value.array)
        if not value.is_batched and array.ndim:
            array = array[..., None]
        return jnp.broadcast_to(array, (*shape, self.batch))

    def batched(self, equation: core.JaxprEqn, inputs: list[Value]) -> Any:
        """The outputs of an equation of which at least one input is batched."""
        primitive, params = equation.primitive, dict(equation.params)
        name, shape = primitive.name, tuple(equation.outvars[0].aval.shape)
        array = inputs[0].array
        if name in _ELEMENTWISE:
            return primitive.bind(*(self.wide(value, shape) for value in inputs), **params)
        if name in _REDUCTIONS and len(params["axes"]) == 1:
            (axis,) = params["axes"]
            if array.shape[axis] <= _SHORT:
                return functools.reduce(_REDUCTIONS[name], _rows(array, axis))
        if name in _BY_AXIS:
            return primitive.bind(array, **params)
        if name in ("argmax", "argmin"):
            return _arg(array, params["axes"][0], name == "argmax", params["index_dtype"])
        if name == "reshape":
            return lax.reshape(array, (*shape, self.batch))
        if name == "broadcast_in_dim":
            dimensions = (*params["broadcast_dimensions"], len(shape))
            return lax.broadcast_in_dim(array, (*shape, self.batch), dimensions)
        if name == "transpose":
            return lax.transpose(array, (*params["permutation"], len(shape)))
        if name == "slice":
            strides = params["strides"] or (1,) * len(shape)
            start, limit = (*params["start_indices"], 0), (*params["limit_indices"], self.batch)
            return lax.slice(array, start, limit, (*strides, 1))
        if name == "concatenate":
            parts = [
                self.wide(value, variable.aval.shape)
                for value, variable in zip(inputs, equation.invars, strict=True)
            ]
            return lax.concatenate(parts, params["dimension"])
        if name == "dot_general":
            return _dot(inputs, *params["dimension_numbers"])
        if name == "gather" and not inputs[1].is_batched:
            return self.gather(array, inputs[1].array, params, shape)
        if name == "gather" and (picked := self.pick(equation, inputs)) is not None:
            return picked
        if name == "scatter" and not inputs[1].is_batched:
            return self.scatter(equation, inputs)
        # Whatever else there is works too, if slowly.
        axes = tuple(-1 if value.is_batched else None for value in inputs)
        apply = jax.vmap(lambda *arrays: primitive.bind(*arrays, **params), axes, -1)
        return apply(*(value.array for value in inputs))

    def gather(self, array: jax.Array, indices: jax.Array, params: dict, shape: tuple) -> jax.Array:
        """Slices at places that are the same for the whole batch."""
        numbers = params["dimension_numbers"]
        numbers = numbers._replace(offset_dims=(*numbers.offset_dims, len(shape)))
        sizes = (*params["slice_sizes"], self.batch)
        kept = ("indices_are_sorted", "unique_indices", "mode", "fill_value")
        return lax.gather(array, indices, numbers, sizes, **{name: params[name] for name in kept})

    def scatter(self, equation: core.JaxprEqn, inputs: list[Value]) -> jax.Array:
        """Updates at places that are the same for the whole batch."""
        operand, updates = (self.wide(inputs[i], equation.invars[i].aval.shape) for i in (0, 2))
        params = dict(equation.params)
        numbers = params["dimension_numbers"]
        dims = (*numbers.update_window_dims, len(equation.invars[2].aval.shape))
        params["dimension_numbers"] = numbers._replace(update_window_dims=dims)
        return equation.primitive.bind(operand, inputs[1].array, updates, **params)

    def pick(self, equation: core.JaxprEqn, inputs: list[Value]) -> jax.Array | None:
        """``x[i]`` along one short axis, with another ``i`` in each element of the batch.

        Returns:
            None for a gather of another form.
        """
        numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
        of, at, out = (tuple(v.aval.shape) for v in (*equation.invars, *equation.outvars))
        lead = tuple(range(len(at) - 1))  # axes of the indices
        # Where a slice is as long as its axis, its clipped start can only be zero.
        moving = [
            (k, axis) for k, axis in enumerate(numbers.start_index_map) if sizes[axis] < of[axis]
        ]
        batching = tuple(numbers.operand_batching_dims)
        is_plain = (
            len(moving) == 1
            and sizes[moving[0][1]] == 1
            and of[moving[0][1]] <= _SHORT
            and equation.params["mode"] == lax.GatherScatterMode.CLIP
            and tuple(numbers.offset_dims) == tuple(range(len(lead), len(out)))
            and batching in ((), lead)
            and tuple(numbers.start_indices_batching_dims) == batching
        )
        if not is_plain:
            return None
        ((component, axis),) = moving
        index = lax.index_in_dim(self.wide(inputs[1], at), component, len(lead), keepdims=False)
        index = jnp.clip(index, 0, of[axis] - 1)
        index = index.reshape(*index.shape[:-1], *(1,) * (len(out) - len(lead)), self.batch)
        operand = inputs[0].array if inputs[0].is_batched else inputs[0].array[..., None]

        def row(k: int) -> jax.Array:
            slab = lax.index_in_dim(operand, k, axis)
            slab = lax.squeeze(slab, numbers.collapsed_slice_dims)
            slab = slab if batching else slab.reshape(*(1,) * len(lead), *slab.shape)
            return jnp.broadcast_to(slab, (*out, self.batch))

        found = row(0)
        for k in range(1, of[axis]):
            found = jnp.where(index == k, row(k), found)
        return found


def _rows(array: jax.Array, axis: int) -> list[jax.Array]:
    return [lax.index_in_dim(array, k, axis, keepdims=False) for k in range(array.shape[axis])]


def _arg(array: jax.Array, axis: int, largest: bool, dtype: Any) -> jax.Array:
    """The first index of the largest or smallest element along an axis."""
    best, *others = _rows(array, axis)
    index = jnp.zeros(best.shape, dtype)
    for k, row in enumerate(others, 1):
        is_better = row > best if largest else row < best
        best, index = jnp.where(is_better, row, best), jnp.where(is_better, k, index)
    return index


def _dot(inputs: list[Value], contracting: Any, batching: Any) -> jax.Array:
    """A product of small tensors as sums of products of their elements."""
    kept, operands = [], []
    for value, axes, lead in zip(inputs, contracting, batching, strict=True):
        ndim = value.array.ndim - value.is_batched
        free = [axis for axis in range(ndim) if axis not in (*axes, *lead)]
        order = (*lead, *free, *axes, *((ndim,) if value.is_batched else ()))
        operands.append(lax.transpose(value.array, order))
        kept.append(len(free))
    # Both to (batching, free of the left, free of the right, contracting, batch).
    (left, right), lead, terms = operands, len(batching[0]), len(contracting[0])
    left = left if inputs[0].is_batched else left[..., None]
    right = right if inputs[1].is_batched else right[..., None]
    at = lead + kept[0]
    left = left.reshape(*left.shape[:at], *(1,) * kept[1], *left.shape[at:])
    right = right.reshape(*right.shape[:lead], *(1,) * kept[0], *right.shape[lead:])
    axes = tuple(range(at + kept[1], at + kept[1] + terms))
    if terms == 1 and left.shape[axes[0]] <= _SHORT:
        pairs = zip(_rows(left, axes[0]), _rows(right, axes[0]), strict=True)
        return functools.reduce(operator.add, [a * b for a, b in pairs])
    return jnp.sum(left * right, axis=axes)
