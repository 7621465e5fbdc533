"""A function as a flat list of equations: calls inlined, dead code and constants taken out."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
from jax.extend import core

_CALLS = frozenset(("closed_call", "custom_jvp_call", "jit", "pjit"))


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
    given = dict(zip(flat.jaxpr.constvars, flat.consts, strict=True))
    wanted = [v for v in read if v not in depends and v not in given]
    with jax.ensure_compile_time_eval():  # also inside somebody's jit
        found = jax.jit(lambda: _values(known, given, wanted))()
    return FlatProgram(
        inputs=flat.jaxpr.invars,
        outputs=flat.jaxpr.outvars,
        equations=equations,
        constants=given | dict(zip(wanted, found, strict=True)),
    )


def _inlined(program: core.ClosedJaxpr, arrays: Sequence[Any]) -> list[Any]:
    """The outputs of a program, without calls of other programs."""
    known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
    known |= dict(zip(program.jaxpr.invars, arrays, strict=True))
    return _values(program.jaxpr.eqns, known, program.jaxpr.outvars)


def _values(
    equations: Sequence[core.JaxprEqn], given: Mapping[Any, Any], wanted: Sequence[Any]
) -> list[Any]:
    """Values of variables after some equations."""
    known = dict(given)

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, core.Literal) else known[variable]

    for equation in equations:
        primitive, params = equation.primitive, equation.params
        arrays = [read(variable) for variable in equation.invars]
        if primitive.name in _CALLS:
            found = _inlined(params.get("jaxpr") or params["call_jaxpr"], arrays)
        else:
            found = primitive.bind(*arrays, **params)
            found = found if primitive.multiple_results else [found]
        known.update(zip(equation.outvars, found, strict=True))
    return [read(variable) for variable in wanted]


def _variables(atoms: Sequence[Any]) -> list[Any]:
    return [atom for atom in atoms if not isinstance(atom, core.Literal)]
