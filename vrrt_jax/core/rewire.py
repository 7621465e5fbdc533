"""RRT*: choose the cheapest parent for new nodes, and let them adopt others.

A batch is rewired at once, on the costs before it. A parent is adopted only if that makes a node
strictly cheaper, and costs grow along every branch, so no two adoptions can close a cycle. In a
forest this also joins trees: their roots, but for the first, may be adopted like any node.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import Space, distance, is_edge_free
from vrrt_jax.core.types import Expansion, Tree

Payload = TypeVar("Payload")
GAIN = 1e-4  # [rad] adoptions that save less are rounding noise


def rewire(
    world: Space,
    tree: Tree[Payload],
    expansion: Expansion,
    *,
    radius: jax.Array,
    edge_steps: int,
    checks: int,
) -> Tree[Payload]:
    """Rewire a tree around the nodes that an iteration inserted.

    Every new node may ask for the edge from its best possible parent, and then for the edge to the
    node that would gain most from it. Of either kind, the ``checks`` that save most are checked for
    collision, which bounds the cost of an iteration.

    Args:
        world: robot and obstacles.
        tree: the tree, with the new nodes in it.
        expansion: the new nodes.
        radius: of the neighborhood [rad]; no more than ``edge_steps`` times the resolution.
        edge_steps: sub-steps of an edge check (static).
        checks: edges of either kind that are checked (static).

    Returns:
        The tree with new parents, and costs that are right for all nodes.
    """
    # Which old nodes (B, N) are near which new ones. Rejected lanes stand in at node 0.
    radius = jnp.minimum(radius, edge_steps * world.resolution)
    distances = trees.distances(world, tree, expansion.q)
    is_old = jnp.arange(tree.capacity) < tree.size - jnp.sum(expansion.accepted)
    near = expansion.accepted[:, None] & is_old & (distances < radius)
    new = jnp.where(expansion.accepted, expansion.node_index, 0)

    # Choose parents: the old node through which a new one costs least, if the edge is free.
    # Writes to slot N are dropped: that is how lanes without a better parent write nothing.
    cost_through_old = jnp.where(near, tree.cost + distances, jnp.inf)
    best, cost_via = jnp.argmin(cost_through_old, axis=1), jnp.min(cost_through_old, axis=1)
    lane, better = _largest(tree.cost[new] - cost_via, checks)
    free, checked_parents = _edge_is_free(world, tree.q[best[lane]], expansion.q[lane], edge_steps)
    better &= free
    slot = jnp.where(better, expansion.node_index[lane], tree.capacity)
    parent = tree.parent.at[slot].set(best[lane].astype(jnp.int32), mode="drop")
    cost = tree.cost.at[slot].set(cost_via[lane], mode="drop")

    # Rewire: the old node that gains most from each new one. The main root keeps its place.
    cost_through_new = jnp.where(near, cost[new][:, None] + distances, jnp.inf)
    is_main_root = jnp.arange(tree.capacity) == 0
    gain = jnp.where(is_main_root, -jnp.inf, cost - cost_through_new)
    child, most = jnp.argmax(gain, axis=1), jnp.max(gain, axis=1)

    # Two new nodes may want the same child: the one that offers more gets it, or the first.
    same_child = child[:, None] == child
    rival = (most[None] > most[:, None]) | (
        (most[None] == most[:, None]) & (jnp.arange(len(new)) < jnp.arange(len(new))[:, None])
    )
    lane, adopts = _largest(jnp.where(jnp.any(same_child & rival, axis=1), 0.0, most), checks)
    free, checked_children = _edge_is_free(
        world, expansion.q[lane], tree.q[child[lane]], edge_steps
    )
    adopts &= free
    parent = parent.at[jnp.where(adopts, child[lane], tree.capacity)].set(
        new[lane].astype(jnp.int32), mode="drop"
    )

    # An adopted node passes its gain on to its whole subtree.
    checked = tree.checked + checked_parents + checked_children
    tree = dataclasses.replace(tree, parent=parent, cost=cost, checked=checked)
    return jax.lax.cond(jnp.any(adopts), lambda t: with_costs(world, t), lambda t: t, tree)


def _largest(gain: jax.Array, num: int) -> tuple[jax.Array, jax.Array]:
    """Lanes (num,) that gain most, and whether that is more than nothing."""
    gain, lane = jax.lax.top_k(gain, min(num, len(gain)))
    return lane, gain > GAIN


def with_costs(world: Space, tree: Tree[Payload]) -> Tree[Payload]:
    """Recompute every node's path length, by pointer doubling; roots keep the cost they have."""
    has_parent = tree.parent >= 0
    ancestor = jnp.where(has_parent, tree.parent, jnp.arange(tree.capacity))
    length = jnp.where(has_parent, distance(world, tree.q[ancestor], tree.q), 0.0)
    # After k rounds every node knows its ancestor 2^k generations up, and the length to there.
    for _ in range(max(tree.capacity - 1, 1).bit_length()):
        length, ancestor = length + length[ancestor], ancestor[ancestor]
    return dataclasses.replace(tree, cost=tree.cost[ancestor] + length)


def _edge_is_free(
    world: Space, q_from: jax.Array, q_to: jax.Array, steps: int
) -> tuple[jax.Array, jax.Array]:
    edge = world.edge(q_from, q_to)
    free, checked = is_edge_free(world, q_from, edge, steps)
    return world.is_resolved(edge, steps) & free, checked
