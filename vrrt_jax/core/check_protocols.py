"""Checks of planners and goals that people bring."""

from collections.abc import Sequence
from typing import Any

import jax

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
