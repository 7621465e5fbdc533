"""All that is computed here is in float32, also where JAX is set to 64 bit."""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp

Inputs = ParamSpec("Inputs")
Output = TypeVar("Output")

_rounds = contextvars.ContextVar("_rounds", default=True)
_HALF = {"float64": jnp.float32, "int64": jnp.int32, "uint64": jnp.uint32}


def single_precision(function: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """Run a function as with JAX's default precision, whatever ``jax_enable_x64`` says.

    It may be called inside a user's ``jit`` too. JAX arrays of 64 bit that it is given are rounded.
    """
    apply: Any = function

    @functools.wraps(function)
    def run(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Output:
        if not _rounds.get() or jax.dtypes.canonicalize_dtype("float64") == "float32":
            return function(*args, **kwargs)
        rounded: Any = [_rounded(value) for value in args]
        named: Any = {name: _rounded(value) for name, value in kwargs.items()}
        with jax.enable_x64(False):
            return apply(*rounded, **named)

    return run


@contextlib.contextmanager
def double_precision() -> Iterator[None]:
    """Round nothing meanwhile, and set JAX to 64 bit: to compare derivatives with differences."""
    token = _rounds.set(False)
    try:
        with jax.enable_x64(True):
            yield
    finally:
        _rounds.reset(token)


def _rounded(tree: Any) -> Any:
    """The same object if there is nothing to round in it."""
    if not any(_is_wide(leaf) for leaf in jax.tree.leaves(tree)):
        return tree
    return jax.tree.map(
        lambda leaf: leaf.astype(_HALF[str(leaf.dtype)]) if _is_wide(leaf) else leaf, tree
    )


def _is_wide(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and str(leaf.dtype) in _HALF
