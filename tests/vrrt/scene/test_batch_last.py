"""Evaluation with the batch as the last axis does what ``vmap`` does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vrrt_jax.scene.batch_last import Value, evaluate
from vrrt_jax.scene.flat_program import flat_program

TABLE = jnp.arange(24.0).reshape(2, 3, 4)


def among(x, index):  # a slice at a place that differs, along an axis of rows
    return jax.vmap(lambda row, i: row[i])(x, jnp.array([index, 2 - index]))


FUNCTIONS = {
    "elementwise": lambda x: jnp.where(x > 0.5, jnp.sin(x) * 2 - x**2, jnp.abs(x) / 3),
    "mixed with constants": lambda x: jnp.stack([x[0, 0] * TABLE[0], TABLE[1] + x[1, 1, 0]]),
    "scalars": lambda x: jnp.maximum(x[0, 0, 0], 0.3) * jnp.where(x[0, 0, 1] > 0, x, -x),
    "reductions": lambda x: (x.sum(0), x.max(1), (x > 0).all(2), (x > 0.9).any(), x.min((0, 2))),
    "long reduction": lambda x: jnp.concatenate([x.ravel()] * 3).sum(),
    "arguments": lambda x: (x.argmax(1), x.argmin(0)),
    "shapes": lambda x: x[:, ::2].transpose(2, 0, 1).reshape(4, -1)[::-1, None],
    "products": lambda x: (x[0] @ x[1].T, TABLE[0, 0] @ x[0, 0]),
    "products of many": lambda x: jnp.einsum("ijk,ilk->ijl", x, TABLE),
    "constant gather": lambda x: x[jnp.array([1, 0, 1])][:, jnp.array([2, 2])],
    "picked row": lambda x: among(x, x[0, :, 0].argmax()),
    "picked from a table": lambda x: TABLE[0][x[:, :, 0].argmax(1)],
    "picked by hand": lambda x: lax.dynamic_index_in_dim(x, x[0, :, 0].argmin(), 1),
    "update": lambda x: x.at[:, 1].set(x[:, 0] * 2),
    "anything else": lambda x: (jnp.sort(x, axis=1), jnp.cumsum(x, 2), jnp.tanh(x) ** 1.5),
    "without the input": lambda x: (TABLE * 2, x[0]),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_same_as_vmap(name, rng):
    function = FUNCTIONS[name]
    x = jnp.asarray(rng.uniform(0.01, 1.0, (5, 2, 3, 4)), jnp.float32)
    program = flat_program(function, x[0])
    values = jax.jit(
        lambda x: [
            jnp.moveaxis(v.array, -1, 0) if v.is_batched else jnp.stack([v.array] * 5)
            for v in evaluate(program, [Value(jnp.moveaxis(x, 0, -1), True)], 5, seed=x[0, 0, 0, 0])
        ]
    )(x)
    expected = jax.tree.leaves(jax.vmap(function)(x))
    assert len(values) == len(expected)
    for ours, theirs in zip(values, expected, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_what_does_not_depend_on_the_inputs_is_found_once():
    def function(x):
        index = jnp.argsort(jnp.array([3, 1, 2])) * 2 // 2
        unused = jnp.sin(x).sum()
        return x[index] if unused is not None else unused

    names = [e.primitive.name for e in flat_program(function, jnp.zeros(3)).equations]
    assert names == ["gather"]
