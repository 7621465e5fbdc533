"""The tree: allocation, insertion, nearest neighbors and the way back to the root."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.edges import Space
from vrrt_jax.core.types import Rejection, Tree

Payload = TypeVar("Payload")
Array = jax.Array | np.ndarray


UNREACHED = 1e3  # [rad] cost of a root that is not known to be reachable from the first


@partial(jax.jit, static_argnames="capacity")
def create(
    q: Array,
    score: Array,
    payload: Payload,
    capacity: int,
    cost: Array | float = 0.0,
) -> Tree[Payload]:
    """A tree, or a forest of R roots.

    Args:
        q: (R, D) root configurations.
        score: (R,) their scores.
        payload: their payloads, leaves (R, ...).
        capacity: number of slots N, at least R.
        cost: (R,) costs of the roots; :data:`UNREACHED` for those no path is known to.
    """
    roots = q.shape[0]

    def padded(leaf: Any, fill: float) -> jax.Array:
        leaf = jnp.asarray(leaf)
        return jnp.full((capacity, *leaf.shape[1:]), fill, leaf.dtype).at[:roots].set(leaf)

    return Tree(
        q=padded(q, 0),
        parent=jnp.full(capacity, -1, jnp.int32),
        cost=padded(jnp.broadcast_to(jnp.asarray(cost, q.dtype), roots), 0),
        score=padded(score, jnp.inf),
        size=jnp.int32(roots),
        iteration=jnp.int32(0),
        rejected=jnp.zeros(len(Rejection), jnp.int32),
        checked=jnp.int32(0),
        payload=jax.tree.map(lambda leaf: padded(leaf, 0), payload),
    )


def root_costs(num: int) -> np.ndarray:
    """Costs (num,) of roots: 0 for the start, :data:`UNREACHED` for the others."""
    return np.where(np.arange(num) == 0, 0.0, UNREACHED).astype(np.float32)


def insert(
    tree: Tree[Payload],
    *,
    q: jax.Array,
    parent: jax.Array,
    cost: jax.Array,
    score: jax.Array,
    payload: Payload,
    valid: jax.Array,
) -> tuple[Tree[Payload], jax.Array]:
    """Append the valid children, in lane order, as far as there is room.

    Args:
        tree: the tree.
        q: (B, D) children.
        parent: (B,) their parents.
        cost: (B,) their path lengths from the root.
        score: (B,) their scores.
        payload: leaves (B, ...).
        valid: (B,) which to insert.

    Returns:
        The new tree, and the slot (B,) of each child; N where it was not inserted.
    """
    # Every valid child gets the next empty slot. Slot N is out of range: writes to it are dropped.
    wanted = tree.size + jnp.cumsum(valid) - 1
    slot = jnp.where(valid & (wanted < tree.capacity), wanted, tree.capacity).astype(jnp.int32)

    def put(column: jax.Array, rows: jax.Array) -> jax.Array:
        return column.at[slot].set(rows.astype(column.dtype), mode="drop")

    grown = dataclasses.replace(
        tree,
        q=put(tree.q, q),
        parent=put(tree.parent, parent),
        cost=put(tree.cost, cost),
        score=put(tree.score, score),
        size=jnp.minimum(tree.size + jnp.sum(valid), tree.capacity).astype(jnp.int32),
        payload=jax.tree.map(put, tree.payload, payload),
    )
    return grown, slot


def occupied(tree: Tree) -> jax.Array:
    """(N,) bool, the slots that hold a node."""
    return jnp.arange(tree.capacity) < tree.size


def distances(world: Space, tree: Tree, q: jax.Array, among: jax.Array | bool = True) -> jax.Array:
    """Distances (B, N) from configurations (B, D) to nodes.

    They are +inf to empty slots, to nodes that ``among`` (B, N) leaves out, and to those that a
    world with a costly metric rules out from afar.
    """
    return world.distances(tree.q, q, occupied(tree) & among)


def nearest(
    world: Space,
    tree: Tree,
    q: jax.Array,
    label: jax.Array | None = None,
    wanted: jax.Array | None = None,
) -> jax.Array:
    """The nearest node (B,) i32 to each configuration (B, D), 0 if there is none.

    Nodes are looked at block by block, so that empty slots cost nothing.

    Args:
        world: whose metric it is.
        tree: the tree.
        q: (B, D).
        label: (N,) something about each node; all nodes count without it.
        wanted: (B,) the label that the nearest node must have.
    """
    size = min(world.node_block, tree.capacity)

    def look(state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        block, best, index = state
        # The last block begins early enough to be a whole one; looking twice does no harm.
        first = jnp.minimum(block * size, tree.capacity - size)
        among = (first + jnp.arange(size) < tree.size)[None]
        if label is not None and wanted is not None:
            among &= jax.lax.dynamic_slice(label, (first,), (size,)) == wanted[:, None]
        nodes = jax.lax.dynamic_slice_in_dim(tree.q, first, size)
        apart = world.distances(nodes, q, jnp.broadcast_to(among, (q.shape[0], size)))
        here, found = jnp.argmin(apart, axis=1), jnp.min(apart, axis=1)
        return (
            block + 1,
            jnp.minimum(best, found),
            jnp.where(found < best, first + here, index).astype(jnp.int32),
        )

    nothing = jnp.full(q.shape[0], jnp.inf, q.dtype), jnp.zeros(q.shape[0], jnp.int32)
    start = (jnp.int32(0), *nothing)
    return jax.lax.while_loop(lambda state: state[0] * size < tree.size, look, start)[2]


def with_capacity(tree: Tree[Payload], capacity: int) -> Tree[Payload]:
    """The same tree with room for more nodes; of a batch, every tree.

    Args:
        tree: of capacity N; leaves may lead with an axis of problems.
        capacity: number of slots, at least N.
    """
    axis = tree.parent.ndim - 1
    more = capacity - tree.parent.shape[axis]

    def padded(leaf: jax.Array, fill: Any = 0) -> jax.Array:
        width = [(0, more if k == axis else 0) for k in range(leaf.ndim)]
        return jnp.pad(leaf, width, constant_values=fill)

    return dataclasses.replace(
        tree,
        q=padded(tree.q),
        parent=padded(tree.parent, -1),
        cost=padded(tree.cost),
        score=padded(tree.score, jnp.inf),
        payload=jax.tree.map(padded, tree.payload),
    )


def joined(grown: Sequence[Tree[Payload]], roots: int) -> Tree[Payload]:
    """One tree of several of the same capacity that grew from the same roots; on the host.

    Args:
        grown: the trees.
        roots: how many of their first nodes are their roots.
    """
    first = grown[0]
    sizes = [int(tree.size) for tree in grown]
    more = [size - roots for size in sizes]  # nodes besides the roots
    begin = roots + np.cumsum([0, *more[:-1]])  # where those of each tree go
    capacity = first.capacity * len(grown)

    def joined_column(*columns: Array, fill: Any = 0) -> jax.Array:
        rows = [np.asarray(columns[0])[:roots]]
        rows += [
            np.asarray(column)[roots:size] for column, size in zip(columns, sizes, strict=True)
        ]
        return _padded_on_host(np.concatenate(rows), capacity, fill)

    parents = [
        np.where(np.asarray(tree.parent) < roots, tree.parent, tree.parent - roots + place)
        for tree, place in zip(grown, begin, strict=True)
    ]
    return dataclasses.replace(
        first,
        q=joined_column(*(tree.q for tree in grown)),
        parent=joined_column(*parents, fill=-1),
        cost=joined_column(*(tree.cost for tree in grown)),
        score=joined_column(*(tree.score for tree in grown), fill=np.inf),
        size=jnp.int32(roots + sum(more)),
        iteration=sum(tree.iteration for tree in grown),
        rejected=sum(tree.rejected for tree in grown),
        checked=sum(tree.checked for tree in grown),
        payload=jax.tree.map(joined_column, *(tree.payload for tree in grown)),
    )


def without(tree: Tree[Payload], nodes: Sequence[int]) -> Tree[Payload]:
    """The tree without some nodes and all that hangs on them; on the host.

    Payloads must tell of their own nodes alone, not of others by their numbers.
    """
    size, parent = int(tree.size), np.asarray(tree.parent)
    kept = np.ones(size, bool)
    kept[list(nodes)] = False
    has_parent = parent[:size] >= 0
    above = np.where(has_parent, parent[:size], 0)
    while np.any(lost := kept & has_parent & ~kept[above]):
        kept &= ~lost
    rows = np.flatnonzero(kept)
    number = (np.cumsum(kept) - 1).astype(parent.dtype)  # that a node has from now on

    def compact(column: Array, fill: Any = 0) -> jax.Array:
        return _padded_on_host(np.asarray(column)[rows], tree.capacity, fill)

    return dataclasses.replace(
        tree,
        q=compact(tree.q),
        parent=compact(np.where(parent >= 0, number[np.maximum(parent, 0)], -1), -1),
        cost=compact(tree.cost),
        score=compact(tree.score, np.inf),
        size=jnp.int32(len(rows)),
        payload=jax.tree.map(compact, tree.payload),
    )


def _padded_on_host(rows: np.ndarray, capacity: int, fill: Any) -> jax.Array:
    """A column of so many slots; on the host, so that no number of rows compiles anything."""
    width = [(0, capacity - len(rows)), *[(0, 0)] * (rows.ndim - 1)]
    return jnp.asarray(np.pad(rows, width, constant_values=fill))


def branch_path(tree: Tree, index: int) -> np.ndarray:
    """The path (P, D) to a node from the root that it hangs on."""
    return np.asarray(tree.q)[lineage(tree, index)]


def best_node(tree: Tree, threshold: Array | float = 0.0) -> jax.Array:
    """The cheapest node () i32 with a score of at most ``threshold``, or that of the best score."""
    enough = jnp.maximum(jnp.min(tree.score), threshold)
    return jnp.argmin(jnp.where(tree.score <= enough, tree.cost, jnp.inf)).astype(jnp.int32)


def path_cost(tree: Tree, threshold: Array | float) -> jax.Array:
    """Length () of the path to :func:`best_node`; inf if its score is higher or no path is."""
    best = best_node(tree, threshold)
    reached = (tree.score[best] <= threshold) & (tree.cost[best] < UNREACHED)
    return jnp.where(reached, tree.cost[best], jnp.inf)


def best_path(tree: Tree, threshold: float = 0.0) -> np.ndarray | None:
    """The path (P, D) from the start, node 0, to :func:`best_node`; None if no edges join them."""
    best = int(best_node(tree, threshold))
    return branch_path(tree, best) if lineage(tree, best)[0] == 0 else None


def lineage(tree: Tree, index: int) -> np.ndarray:
    """Indices from the root down to a node, on the host.

    Raises:
        ValueError: the index is not a node.
    """
    parent, size = np.asarray(tree.parent), int(tree.size)
    if not 0 <= index < size:
        raise ValueError(f"node {index} is not in the tree; it has nodes 0 to {size - 1}")
    chain = [index]
    while parent[chain[-1]] >= 0:
        chain.append(int(parent[chain[-1]]))
    return np.array(chain[::-1])
