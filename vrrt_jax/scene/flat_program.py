"""A function as a flat list of equations: calls inlined, dead code and constants taken out."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

_CALLS = frozenset(("closed_call", "custom_jvp_call", "jit", "pjit"))


def _broadcast(params: Mapping[str, Any], array: np.ndarray) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], array.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(array.reshape(shape), params["shape"])


def _slice(params: Mapping[str, Any], array: np.ndarray) -> np.ndarray:
    strides = params["strides"] or (1,) * array.ndim
    limits = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return array[tuple(slice(*limit) for limit in limits)]


# Most constants are indices. NumPy finds them at once; XLA would have to compile every operation.
_ON_HOST: Mapping[str, Callable[..., Any]] = {
    "add": lambda params, a, b: a + b,
    "and": lambda params, a, b: a & b,
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *parts: np.concatenate(parts, params["dimension"]),
    "convert_element_type": lambda params, a: a.astype(params["new_dtype"]),
    "eq": lambda params, a, b: a == b,
    "lt": lambda params, a, b: a < b,
    "max": lambda params, a, b: np.maximum(a, b),
    "min": lambda params, a, b: np.minimum(a, b),
    "mul": lambda params, a, b: a * b,
    "ne": lambda params, a, b: a != b,
    "rem": lambda params, a, b: np.fmod(a, b),
    "reshape": lambda params, a: a.reshape(params["new_sizes"]),
    "select_n": lambda params, which, *cases: np.choose(which, cases),
    "slice": _slice,
    "squeeze": lambda params, a: np.squeeze(a, params["dimensions"]),
    "sub": lambda params, a, b: a - b,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlatProgram:
    """What a function computes."""

    inputs: Sequence[Any]  # variables
    outputs: Sequence[Any]  # variables or literals
    equations: Sequence[core.JaxprEqn]  # those that depend on the inputs
    constants: Mapping[Any, jax.Array]  # values of all other variables that they read


def flat_program(function: Callable[..., Any], *inputs: Any) -> FlatProgram:
    """Trace a function.

    Args:
        function: of pytrees of arrays.
        inputs: arrays, or shapes and dtypes, as :func:`jax.eval_shape` takes them.
    """
    nested = jax.make_jaxpr(function)(*inputs)
    avals = [variable.aval for variable in nested.jaxpr.invars]
    flat = jax.make_jaxpr(lambda *arrays: _inlined(nested, arrays))(*avals)
    # From the end: equations whose outputs are read.
    read, live = set(_variables(flat.jaxpr.outvars)), []
    for equation in reversed(flat.jaxpr.eqns):
        if not read.isdisjoint(equation.outvars):
            live.append(equation)
            read |= set(_variables(equation.invars))
    # From the start: what depends on an input. The rest is computed here, once.
    depends, equations, known = set(flat.jaxpr.invars), [], []
    for equation in reversed(live):
        if depends.isdisjoint(_variables(equation.invars)):
            known.append(equation)
        else:
            equations.append(equation)
            depends |= set(equation.outvars)
    constants = dict(zip(flat.jaxpr.constvars, flat.consts, strict=True))
    with jax.ensure_compile_time_eval():  # also inside somebody's jit
        constants = _values(known, constants, _ON_HOST)
    return FlatProgram(
        inputs=flat.jaxpr.invars,
        outputs=flat.jaxpr.outvars,
        equations=equations,
        constants={v: value for v, value in constants.items() if v in read},
    )


def _inlined(program: core.ClosedJaxpr, arrays: Sequence[Any]) -> list[Any]:
    """The outputs of a program, without calls of other programs."""
    known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
    known |= dict(zip(program.jaxpr.invars, arrays, strict=True))
    known = _values(program.jaxpr.eqns, known, {})
    return [_read(atom, known) for atom in program.jaxpr.outvars]


def _values(
    equations: Sequence[core.JaxprEqn],
    given: Mapping[Any, Any],
    evaluators: Mapping[str, Callable[..., Any]],
) -> dict[Any, Any]:
    """Values of all variables of some equations; by evaluators for the primitives that have one."""
    known = dict(given)
    for equation in equations:
        primitive, params = equation.primitive, equation.params
        arrays = [_read(atom, known) for atom in equation.invars]
        if primitive.name in _CALLS:
            found = _inlined(params.get("jaxpr") or params["call_jaxpr"], arrays)
        elif primitive.name in evaluators:
            value = evaluators[primitive.name](params, *map(np.asarray, arrays))
            found = [value.astype(equation.outvars[0].aval.dtype)]
        else:
            found = primitive.bind(*arrays, **params)
            found = found if primitive.multiple_results else [found]
        known.update(zip(equation.outvars, found, strict=True))
    return known


def _read(atom: Any, known: Mapping[Any, Any]) -> Any:
    return atom.val if isinstance(atom, core.Literal) else known[atom]


def _variables(atoms: Sequence[Any]) -> list[Any]:
    return [atom for atom in atoms if not isinstance(atom, core.Literal)]
