"""The data that flows through the kernel.

Letters: ``B`` lanes (32), ``N`` node capacity, ``D`` joints. Joints in [rad] or [m].
"""

import dataclasses
import enum
import operator
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar, dataclass_transform

import jax
import numpy as np

Payload = TypeVar("Payload")
_MARK = "_is_pytree"  # attribute of the classes that :func:`pytree` has made


@dataclass_transform(kw_only_default=True, frozen_default=True)
def pytree(cls):
    """Make a frozen, keyword-only dataclass whose fields JAX can trace.

    Fields declared with :func:`static` are compile-time constants instead. A class that is one
    already, as a subclass of :class:`PytreeSubclasses`, stays as it is.
    """
    if _MARK in vars(cls):
        return cls
    cls = dataclasses.dataclass(frozen=True, kw_only=True, repr=False)(cls)
    if cls.__repr__ is object.__repr__:
        cls.__repr__ = _short_repr
    setattr(cls, _MARK, True)
    _register(cls)
    return cls


def _register(cls: type) -> None:
    """Make JAX see the fields of a dataclass.

    Not by ``jax.tree_util.register_dataclass``: there, in JAX 0.10.2, structures of different
    classes with as many fields compare equal, so that a compiled function may run the methods of
    another class.
    """
    fields = dataclasses.fields(cls)
    leaves = [field.name for field in fields if not field.metadata.get("static")]
    statics = [field.name for field in fields if field.metadata.get("static")]

    # JAX flattens arguments at every call, so that this has to be quick. Of two names or more
    # ``attrgetter`` gives a tuple.
    def tuple_of(names: list[str]) -> Callable[[Any], tuple]:
        if len(names) > 1:
            return operator.attrgetter(*names)
        return lambda thing: tuple(getattr(thing, name) for name in names)

    values_of, statics_of = tuple_of(leaves), tuple_of(statics)

    def flatten(thing: Any) -> tuple[tuple, tuple]:
        return values_of(thing), statics_of(thing)

    def flatten_with_keys(thing: Any) -> tuple[tuple, tuple]:
        values, aux = flatten(thing)
        keys = map(jax.tree_util.GetAttrKey, leaves)
        return tuple(zip(keys, values, strict=True)), aux

    def unflatten(aux: tuple, values: Any) -> Any:
        thing = object.__new__(cls)
        for name, value in zip([*leaves, *statics], [*values, *aux], strict=True):
            object.__setattr__(thing, name, value)
        return thing

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def _short_repr(thing: Any) -> str:
    """The fields of a pytree: shapes of arrays, names of classes, other values as they are."""
    parts = []
    for field in dataclasses.fields(thing):
        value = getattr(thing, field.name)
        if hasattr(value, "shape") and hasattr(value, "dtype"):
            text = f"{value.dtype}{list(value.shape)}"
        elif dataclasses.is_dataclass(value) or len(repr(value)) > 60:
            text = type(value).__name__
        else:
            text = repr(value)
        parts.append(f"{field.name}={text}")
    return f"{type(thing).__name__}({', '.join(parts)})"


class PytreeSubclasses:
    """A base whose subclasses are pytree dataclasses, with or without the decorator.

    Without it, a user's subclass of a world that forgets :func:`pytree` would fail far away, in
    the first compiled function that it is handed to.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Make the subclass a pytree."""
        super().__init_subclass__(**kwargs)
        pytree(cls)


def static(**kwargs: Any) -> Any:
    """A dataclass field that is part of the compiled program, not an array."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


class TraceIgnoredNames(tuple):
    """Names carried by a pytree for messages and look-ups on the host.

    Any two compare equal, so that renaming an obstacle never re-traces a function.
    """

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        """Equal to any other names."""
        return isinstance(other, TraceIgnoredNames)

    def __hash__(self) -> int:
        """One hash for all names."""
        return 0


class TraceIgnored:
    """Something of the host that a pytree carries, such as the robot of a world.

    Any two compare equal, as :class:`TraceIgnoredNames` do.
    """

    __slots__ = ("value",)

    def __init__(self, value: Any = None) -> None:
        """Carry a value."""
        self.value = value

    def __repr__(self) -> str:
        """The kind of what is carried."""
        return f"TraceIgnored({type(self.value).__name__})"

    def __eq__(self, other: object) -> bool:
        """Equal to any other."""
        return isinstance(other, TraceIgnored)

    def __hash__(self) -> int:
        """One hash for all."""
        return 0


class Rejection(enum.IntEnum):
    """Why a lane's child did not enter the tree; indexes ``Tree.rejected``."""

    NO_PARENT = 0  # the policy had nothing to expand in this lane
    LIMITS = 1  # clipped to the joint limits, no step was left
    BLOCKED = 2  # the edge meets an obstacle or the robot itself
    NOT_FINITE = 3  # NaN or infinity in the child, its score or its payload
    CAPACITY = 4  # the tree is full


@pytree
class Tree(Generic[Payload]):
    """A search tree of fixed capacity; slots at and beyond ``size`` are empty."""

    q: jax.Array  # (N, D) configurations
    parent: jax.Array  # (N,) i32 index of the parent, -1 for a root and in empty slots
    cost: jax.Array  # (N,) path length from the root [rad]
    score: jax.Array  # (N,) lower is better, +inf in empty slots
    size: jax.Array  # () i32 number of nodes
    iteration: jax.Array  # () i32 iterations done
    rejected: jax.Array  # (len(Rejection),) i32 lanes lost, by reason
    checked: jax.Array  # () i32 configurations checked for collision
    payload: Payload  # leaves (N, ...): what the policy keeps for each node

    @property
    def capacity(self) -> int:
        """Number of slots, N."""
        return self.parent.shape[0]


@pytree
class Proposals:
    """What a policy wants to try: one child for each lane."""

    parent: jax.Array  # (B,) i32 node to expand
    target: jax.Array  # (B, D) where to go; the kernel clips it to limits and edge length
    valid: jax.Array  # (B,) bool, False where the lane has nothing to try
    partial: jax.Array  # (B,) bool, keep the free part of a blocked edge
    aux: Any  # leaves (B, ...): handed to ``evaluate`` and ``after_insert``
    checked: Any = 0  # () i32 configurations that proposing checked for collision


@pytree
class Expansion:
    """What became of one iteration's lanes, for ``after_insert``."""

    q: jax.Array  # (B, D) the children
    node_index: jax.Array  # (B,) i32 where each went, N (out of range) if rejected
    accepted: jax.Array  # (B,) bool
    blocked: jax.Array  # (B,) bool, something lies on the edge


class Goal(Protocol):
    """Where a path should end: a pytree of traced arrays, so that a new goal never re-compiles.

    :class:`~vrrt_jax.core.goal.ConfigurationGoal` is one; a class with these two members is
    another.
    """

    @property
    def threshold(self) -> jax.Array:
        """() the goal is reached by configurations whose loss is at most this."""
        ...

    def loss(self, world: Any, q: jax.Array) -> jax.Array:
        """How far a configuration (D,) is from the goal, ()."""
        ...


class ExpansionPolicy(Protocol[Payload]):
    """A planner: a pytree whose arrays are traced, so that a new setting never re-compiles.

    The kernel calls ``propose``, ``evaluate`` and ``after_insert`` in every iteration, traced; the
    other methods run on the host, before and after the search. To a goal that is no configuration,
    such as an image, the scores have to be losses: :func:`vrrt_jax.plan` then chooses where to end
    among all nodes, and does not ask ``extract_path``.

    A policy may also say how long its best path is so far, for the history of a search:
    ``path_cost(tree, threshold)`` is a length (), inf before the first path, where ``threshold`` ()
    is the goal's. Without it that is :func:`vrrt_jax.core.tree.path_cost`. If it has
    ``after_iteration(world, goal, tree, key)``, the kernel goes on with the tree that this returns.
    """

    @property
    def edge_steps(self) -> int:
        """S, the number of collision checks along an edge (static)."""
        ...

    @property
    def lanes(self) -> int:
        """B, the number of expansions in an iteration (static)."""
        ...

    def init(self, world: Any, goal: Any, q_roots: np.ndarray, capacity: int) -> Tree[Payload]:
        """The tree before the first iteration.

        Args:
            world: robot and obstacles.
            goal: where to.
            q_roots: (R, D) the start, and other configurations that are worth starting from. No
                path to these others is known yet: their cost is
                :data:`~vrrt_jax.core.tree.UNREACHED`.
            capacity: N.
        """
        ...

    def goal_score(self, goal: Any) -> float:
        """The search ends once a node's score is this or lower; ``-inf`` to go on improving."""
        ...

    def propose(self, world: Any, goal: Any, tree: Tree[Payload], key: jax.Array) -> Proposals:
        """Choose a parent and a target for each of the B lanes."""
        ...

    def evaluate(
        self, world: Any, goal: Any, q: jax.Array, proposals: Proposals
    ) -> tuple[jax.Array, Payload]:
        """Scores (B,) and payloads (B, ...) of the children ``q`` (B, D)."""
        ...

    def after_insert(
        self,
        world: Any,
        goal: Any,
        tree: Tree[Payload],
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree[Payload]:
        """Book-keeping once the children are in: frontier flags, rewiring."""
        ...

    def extract_path(self, tree: Tree[Payload]) -> np.ndarray | None:
        """The path (P, D) from the start to the node with the best score, None if there is none."""
        ...
