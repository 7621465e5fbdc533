"""Checks of planners, goals and worlds that people bring."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

# Members that a policy of the kernel has, see vrrt_jax.core.types.ExpansionPolicy.
POLICY_MEMBERS = (
    "edge_steps",
    "lanes",
    "init",
    "goal_score",
    "propose",
    "evaluate",
    "after_insert",
    "extract_path",
)


def check_policy(policy: Any) -> None:
    """Raise a ValueError that names what an object lacks to be a policy of the kernel."""
    _check_members(policy, POLICY_MEMBERS, "planner")
    _check_pytree(policy, "planner")


def check_goal(goal: Any) -> None:
    """Raise a ValueError that names what an object lacks to be a goal of the kernel."""
    _check_members(goal, ("loss", "threshold"), "goal")
    _check_pytree(goal, "goal")


def check_extracted_path(policy: Any, path: np.ndarray | None, q_start: np.ndarray) -> None:
    """Raise a ValueError if a policy's path (P, D) does not begin at the start (D,)."""
    if path is not None and not np.allclose(path[0], q_start, atol=1e-5):
        raise ValueError(
            f"the path that {type(policy).__name__}.extract_path returned begins at {path[0]}; "
            f"expected the start, {q_start}"
        )


def overrides_is_free(world: Any) -> bool:
    """Whether a user's subclass has an ``is_free`` of its own, which the exact check ignores."""
    owner = next(kind for kind in type(world).__mro__ if "is_free" in vars(kind))
    return not owner.__module__.startswith(("vrrt_jax.", "nrp_jax."))


def _check_members(thing: Any, members: Sequence[str], what: str) -> None:
    missing = [name for name in members if not hasattr(thing, name)]
    if isinstance(thing, type) or missing:
        lacks = f"lacks {', '.join(missing)}" if missing else "is a class"
        name = thing.__name__ if isinstance(thing, type) else type(thing).__name__
        raise ValueError(f"the {what} {name} {lacks}; expected an object with {', '.join(members)}")


def _check_pytree(thing: Any, what: str) -> None:
    """JAX takes a class for a plain value unless the class itself is registered."""
    if jax.tree_util.all_leaves([thing]):
        raise ValueError(
            f"JAX does not know the class of the {what}, {type(thing).__name__}; expected a "
            "dataclass decorated with vrrt_jax.pytree"
        )
