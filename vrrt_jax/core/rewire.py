"""RRT*: choose the cheapest parent for new nodes, and let them adopt others.

A batch is rewired at once, on the costs before it: a parent is adopted only if that makes a node
strictly cheaper, and costs grow along every branch, so no two adoptions can close a cycle. In a
forest
this also joins trees: their roots, but for the first, may be adopted like any node.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import difference, distance, free_steps
from vrrt_jax.core.types import Expansion, Tree
from vrrt_jax.core.world import World

Payload = TypeVar("Payload")
GAIN = 1e-4  # [rad] adoptions that save less are rounding noise


def rewire(
    world: World,
    tree: Tree[Payload],
    expansion: Expansion,
    *,
    radius: jax.Array,
    edge_steps: int,
) -> Tree[Payload]:
    """Rewire a tree around the nodes that an iteration inserted.

    For every new node the edge from its best possible parent and the edge to the node that would
    gain most from it are checked; one edge each keeps the cost of an iteration bounded.

    Args:
        world: robot and obstacles.
        tree: the tree, with the new nodes in it.
        expansion: the new nodes.
        radius: of the neighbourhood [rad]; no more than ``edge_steps`` times the resolution.
        edge_steps: sub-steps of an edge check (static).

    Returns:
        The tree with new parents, and costs that are right for all nodes.
    """
    radius = jnp.minimum(radius, edge_steps * world.resolution)
    apart = trees.distances(world, tree, expansion.q)
    is_old = jnp.arange(tree.capacity) < tree.size - jnp.sum(expansion.accepted)
    near = expansion.accepted[:, None] & is_old & (apart < radius)
    new = jnp.where(expansion.accepted, expansion.slot, 0)

    via = jnp.where(near, tree.cost + apart, jnp.inf)
    best, cost_via = jnp.argmin(via, axis=1), jnp.min(via, axis=1)
    better = cost_via < tree.cost[new] - GAIN
    better &= _edge_is_free(world, tree.q[best], expansion.q, edge_steps)
    slot = jnp.where(better, expansion.slot, tree.capacity)
    parent = tree.parent.at[slot].set(best.astype(jnp.int32), mode="drop")
    cost = tree.cost.at[slot].set(cost_via, mode="drop")

    through = jnp.where(near, cost[new][:, None] + apart, jnp.inf)
    is_main_root = jnp.arange(tree.capacity) == 0
    gain = jnp.where(is_main_root, -jnp.inf, cost - through)
    child, most = jnp.argmax(gain, axis=1), jnp.max(gain, axis=1)
    same_child = child[:, None] == child
    rival = (most[None] > most[:, None]) | (
        (most[None] == most[:, None]) & (jnp.arange(len(new)) < jnp.arange(len(new))[:, None])
    )
    adopts = (most > GAIN) & ~jnp.any(same_child & rival, axis=1)
    adopts &= _edge_is_free(world, expansion.q, tree.q[child], edge_steps)
    parent = parent.at[jnp.where(adopts, child, tree.capacity)].set(
        new.astype(jnp.int32), mode="drop"
    )

    tree = dataclasses.replace(tree, parent=parent, cost=cost)
    return jax.lax.cond(jnp.any(adopts), lambda t: with_costs(world, t), lambda t: t, tree)


def with_costs(world: World, tree: Tree[Payload]) -> Tree[Payload]:
    """Recompute every node's path length, by pointer doubling; roots keep the cost they have."""
    has_parent = tree.parent >= 0
    ancestor = jnp.where(has_parent, tree.parent, jnp.arange(tree.capacity))
    length = jnp.where(has_parent, distance(world, tree.q[ancestor], tree.q), 0.0)
    for _ in range(max(tree.capacity - 1, 1).bit_length()):
        length, ancestor = length + length[ancestor], ancestor[ancestor]
    return dataclasses.replace(tree, cost=tree.cost[ancestor] + length)


def _edge_is_free(world: World, q_from: jax.Array, q_to: jax.Array, steps: int) -> jax.Array:
    return free_steps(world, q_from, difference(world, q_from, q_to), steps) == steps
