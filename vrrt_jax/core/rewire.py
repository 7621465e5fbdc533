"""RRT*: choose the cheapest parent for new nodes, and let them adopt others.

A batch is rewired at once, on the costs before it. A parent is adopted only if that makes a node
strictly cheaper, and costs grow along every branch, so no two adoptions can close a cycle. In a
forest this also joins trees: their roots, but for the first, may be adopted like any node.
"""

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edge_checks import is_edge_free
from vrrt_jax.core.edges import Space, distance
from vrrt_jax.core.shortcut import EDGE_STEPS, best_splice
from vrrt_jax.core.types import Expansion, Tree

Payload = TypeVar("Payload")
GAIN = 1e-4  # [rad] adoptions that save less are rounding noise
BRANCH = 64  # nodes of a path, from its end on, between which shortcuts are drawn
FINER = 8  # times that checks of shortcuts are finer than those of other edges


def rewire(
    world: Space,
    tree: Tree[Payload],
    expansion: Expansion,
    *,
    radius: jax.Array,
    edge_steps: int,
    checks: int,
    neighbors: int | None = None,
    tries: int = 1,
    ancestors: int = 0,
) -> Tree[Payload]:
    """Rewire a tree around the nodes that an iteration inserted.

    Every new node may ask for the edges from its best possible parents, and then for the edges to
    the nodes that would gain most from it. Of either kind, the ``checks`` that save most are
    checked for collision, which bounds the cost of an iteration.

    Args:
        world: robot and obstacles.
        tree: the tree, with the new nodes in it; none of them has children.
        expansion: the new nodes.
        radius: of the neighborhood, in the world's metric; no more than ``edge_steps`` times the
            resolution.
        edge_steps: sub-steps of an edge check (static).
        checks: edges of either kind that are checked (static).
        neighbors: so many nearest nodes are the neighborhood; all inside ``radius`` if None
            (static).
        tries: edges of either kind that a node asks for (static).
        ancestors: of a new node's parent, so many may become its parent, however far they are
            (static).

    Returns:
        The tree with new parents, and costs that are right for all nodes.
    """
    # Old nodes (B, K) near the new ones, and how far; +inf where they are not. Rejected lanes stand
    # in at node 0. The barrier keeps XLA from computing the distances once for every use.
    radius = jnp.minimum(radius, edge_steps * world.resolution)
    apart = jax.lax.optimization_barrier(trees.distances(world, tree, expansion.q))
    is_old = jnp.arange(tree.capacity) < tree.size - jnp.sum(expansion.accepted)
    apart = jnp.where(expansion.accepted[:, None] & is_old & (apart < radius), apart, jnp.inf)
    old = jnp.broadcast_to(jnp.arange(tree.capacity), apart.shape)
    if neighbors is not None:
        nearness, old = jax.lax.top_k(-apart, neighbors)
        apart = -nearness
    new = jnp.where(expansion.accepted, expansion.node_index, 0)

    # Choose parents: what a new node (B, tries) would save with another one, for the free edges.
    saving, choice = jax.lax.top_k(tree.cost[new][:, None] - tree.cost[old] - apart, tries)
    better = jnp.take_along_axis(old, choice, axis=1)
    if ancestors:
        saving_up, up = _ancestors(world, tree, expansion, new, ancestors)
        saving, better = (
            jnp.concatenate(pair, axis=1) for pair in ((saving, saving_up), (better, up))
        )
    q_new = jnp.broadcast_to(expansion.q[:, None], (*better.shape, expansion.q.shape[1]))
    free, checked_parents = _free_gains(world, saving, tree.q[better], q_new, edge_steps, checks)
    # The free edge that saves most. Writes to slot N are dropped: lanes without one write nothing.
    free_saving = jnp.where(free, saving, 0.0)
    best, most = jnp.argmax(free_saving, axis=1), jnp.max(free_saving, axis=1)
    slot = jnp.where(most > 0, expansion.node_index, tree.capacity)
    chosen = jnp.take_along_axis(better, best[:, None], axis=1)[:, 0]
    parent = tree.parent.at[slot].set(chosen.astype(jnp.int32), mode="drop")
    cost = tree.cost.at[slot].add(-most, mode="drop")

    # Rewire: the old nodes that gain most from each new one. The main root keeps its place.
    gain = jnp.where(old > 0, cost[old] - cost[new][:, None] - apart, -jnp.inf)
    gain, choice = jax.lax.top_k(gain, tries)
    child = jnp.take_along_axis(old, choice, axis=1)
    free, checked_children = _free_gains(
        world, gain, q_new[:, :tries], tree.q[child], edge_steps, checks
    )
    wins = winners(child.reshape(-1), jnp.where(free, gain, 0.0).reshape(-1), tree.capacity)
    parent = parent.at[jnp.where(wins, child.reshape(-1), tree.capacity)].set(
        jnp.repeat(new, tries).astype(jnp.int32), mode="drop"
    )

    # An adopted node passes its gain on to its whole subtree.
    checked = tree.checked + checked_parents + checked_children
    tree = dataclasses.replace(tree, parent=parent, cost=cost, checked=checked)
    return jax.lax.cond(jnp.any(wins), lambda t: with_costs(world, t), lambda t: t, tree)


def shortcut_branch(
    world: Space, tree: Tree[None], threshold: jax.Array, key: jax.Array
) -> Tree[None]:
    """Replace a detour of the best path by a straight edge, if one of those drawn is free.

    The ends of the edge become nodes without a score, and what comes after the detour hangs on the
    second of them. So the tree keeps what shortcuts gain, and the informed set shrinks by it.

    Args:
        world: robot and obstacles.
        tree: the tree.
        threshold: () score that the end of a path has at most.
        key: random key.
    """

    def up(node: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        return jnp.where(node >= 0, tree.parent[node], -1), node

    def shorter(tree: Tree[None]) -> Tree[None]:
        # The last nodes of the path, from the root's side on, and the best straight edge.
        end = trees.best_node(tree, threshold)
        chain = jax.lax.scan(up, end, length=BRANCH)[1]
        size = jnp.sum(chain >= 0)
        nodes = chain[jnp.maximum(size - 1 - jnp.arange(BRANCH), 0)]
        splice = best_splice(world, tree.q[nodes], size, key)

        # What shortens a path all but touches what it goes around: it is checked far more finely.
        finer: Any = world  # a dataclass, which the protocol does not tell
        finer = dataclasses.replace(finer, resolution=world.resolution / FINER)
        edge = world.edge(splice.q_from[None], splice.q_to[None])
        free, checked = is_edge_free(
            finer, splice.q_from[None], edge, FINER * EDGE_STEPS, splice.found
        )

        # Its ends are a child of the node before the detour, and a child of that.
        found = free[0] & (tree.size + 2 <= tree.capacity)
        unknown = jnp.full(2, jnp.inf, tree.score.dtype)
        tree, new = trees.insert(
            tree,
            q=jnp.stack([splice.q_from, splice.q_to]),
            parent=jnp.stack([nodes[splice.first], tree.size]),
            cost=unknown,
            score=unknown,
            payload=None,
            valid=jnp.broadcast_to(found, 2),
        )
        after = jnp.where(found, nodes[splice.last + 1], tree.capacity)
        parent = tree.parent.at[after].set(new[1], mode="drop")
        checked += tree.checked + splice.checked
        tree = dataclasses.replace(tree, parent=parent, checked=checked)
        return jax.lax.cond(found, lambda t: with_costs(world, t), lambda t: t, tree)

    is_path = jnp.isfinite(trees.path_cost(tree, threshold))
    return jax.lax.cond(is_path, shorter, lambda t: t, tree)


def winners(node: jax.Array, gain: jax.Array, capacity: int) -> jax.Array:
    """Which (m,) of several offers to nodes (m,) are taken: the one that gains most, or the first.

    Args:
        node: (m,) i32.
        gain: (m,) not positive where there is no offer.
        capacity: N, of the tree.
    """
    most = jnp.zeros(capacity, gain.dtype).at[node].max(gain)
    is_best = (gain > 0) & (gain >= most[node])
    index = jnp.arange(len(node))
    first = jnp.full(capacity, len(node)).at[node].min(jnp.where(is_best, index, len(node)))
    return is_best & (first[node] == index)


def _ancestors(
    world: Space, tree: Tree, expansion: Expansion, new: jax.Array, num: int
) -> tuple[jax.Array, jax.Array]:
    """What new nodes (B, num) would save as children of their parents' ancestors, and these."""
    chain, up = [], tree.parent[new]
    for _ in range(num):
        up = jnp.where(up >= 0, tree.parent[up], -1)
        chain.append(up)
    up = jnp.stack(chain, axis=1)
    ahead = world.distance(tree.q[up], expansion.q[:, None])
    saving = tree.cost[new][:, None] - tree.cost[up] - ahead
    return jnp.where(expansion.accepted[:, None] & (up >= 0), saving, -jnp.inf), up


def _free_gains(
    world: Space, gain: jax.Array, q_from: jax.Array, q_to: jax.Array, steps: int, checks: int
) -> tuple[jax.Array, jax.Array]:
    """Which edges (B, K) are worth it and free, of the ``checks`` that gain most; and checks."""
    flat = gain.reshape(-1)
    most, index = jax.lax.top_k(flat, min(checks, len(flat)))
    q_from, q_to = (q.reshape(len(flat), -1)[index] for q in (q_from, q_to))
    edge = world.edge(q_from, q_to)
    tried = (most > GAIN) & world.is_resolved(edge, steps)
    free, checked = is_edge_free(world, q_from, edge, steps, tried)
    return jnp.zeros(len(flat), bool).at[index].set(free).reshape(gain.shape), checked


def with_costs(world: Space, tree: Tree[Payload]) -> Tree[Payload]:
    """Recompute every node's path length, by pointer doubling; roots keep the cost they have."""
    has_parent = tree.parent >= 0
    ancestor = jnp.where(has_parent, tree.parent, jnp.arange(tree.capacity))
    length = jnp.where(has_parent, distance(world, tree.q[ancestor], tree.q), 0.0)
    # After k rounds every node knows its ancestor 2^k generations up, and the length to there.
    rounds = max(tree.capacity - 1, 1).bit_length()
    length, ancestor = jax.lax.fori_loop(
        0, rounds, lambda _, way: (way[0] + way[0][way[1]], way[1][way[1]]), (length, ancestor)
    )
    return dataclasses.replace(tree, cost=tree.cost[ancestor] + length)
