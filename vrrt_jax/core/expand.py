"""One iteration: B expansions of a tree, for every planner."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edge_checks import free_prefix
from vrrt_jax.core.edges import Space
from vrrt_jax.core.types import Expansion, ExpansionPolicy, Payload, Rejection, Tree

SHORTEST_EDGE = 1e-5  # [rad] a shorter step would only duplicate its parent
AFTER = 1 << 30  # folded into an iteration's key for what comes after it


def expand(
    world: Space, goal: Any, policy: ExpansionPolicy[Payload], tree: Tree[Payload], key: jax.Array
) -> Tree[Payload]:
    """Propose, steer, check edges, filter, evaluate, insert, and let the policy follow up.

    Args:
        world: robot and obstacles.
        goal: where to; handed to the policy.
        policy: the planner.
        tree: the tree to grow.
        key: the search's key; the iteration's own is folded in here, so that results do not depend
            on how iterations are grouped into chunks.
    """
    # Propose: a parent and a target for every lane. Lanes without either stand in at node 0.
    key = jax.random.fold_in(key, tree.iteration)
    proposals = policy.propose(world, goal, tree, key)
    parent = jnp.where(proposals.valid, proposals.parent, 0)
    q_from = tree.q[parent]

    # Steer: the edge towards the target, inside the limits and short enough to be checked.
    edge = world.steer(q_from, proposals.target, policy.edge_steps)

    # Check edges: how many leading sub-steps are free. A blocked edge is cut there, or given up.
    asked = proposals.valid, proposals.partial, getattr(policy, "edge_slack", 0)
    num_free, checked = free_prefix(world, q_from, edge, policy.edge_steps, *asked)
    free = (num_free == policy.edge_steps) | (proposals.partial & (num_free > 0))
    edge = world.truncate(edge, num_free / policy.edge_steps)
    length = world.length(edge)
    q = world.normalize(world.end(q_from, edge))

    # Filter and evaluate. A NaN target gives a NaN length: it is caught as not finite, before it
    # can look like a limit. Rejected lanes are evaluated at their parents, where nothing is NaN.
    finite = jnp.isfinite(length)
    candidate = proposals.valid & finite & free & (length > SHORTEST_EDGE)
    q_evaluated = jnp.where(candidate[:, None], q, q_from)
    score, payload = policy.evaluate(world, goal, q_evaluated, proposals)
    finite &= jnp.isfinite(score)
    for leaf in jax.tree.leaves(payload):
        finite &= jnp.all(jnp.isfinite(leaf.reshape(leaf.shape[0], -1)), axis=1)

    # Insert, and count the lanes that were lost.
    tree_before = tree
    tree, node_index = trees.insert(
        tree,
        q=q,
        parent=parent,
        cost=tree.cost[parent] + length,
        score=score,
        payload=payload,
        valid=candidate & finite,
    )
    accepted = node_index < tree.capacity
    rejected = _count_reasons(  # in the order of Rejection
        ~proposals.valid,
        finite & free & (length <= SHORTEST_EDGE),
        finite & ~free,
        ~finite,
        ~accepted,
    )
    tree = dataclasses.replace(
        tree,
        iteration=tree_before.iteration + 1,
        rejected=tree_before.rejected + rejected,
        checked=tree_before.checked + proposals.checked + checked,
    )

    # Follow up: the policy's own book-keeping, with all children in the tree.
    expansion = Expansion(
        q=q, node_index=node_index, accepted=accepted, blocked=num_free < policy.edge_steps
    )
    tree = policy.after_insert(world, goal, tree, proposals, expansion)
    after = getattr(policy, "after_iteration", None)
    return after(world, goal, tree, jax.random.fold_in(key, AFTER)) if after else tree


def _count_reasons(*reasons: jax.Array) -> jax.Array:
    """Lanes (len(Rejection),) i32 by the first of the reasons (B,) that holds for them."""
    counts = jnp.zeros(len(Rejection), jnp.int32)
    counted = jnp.zeros_like(reasons[0])
    for reason, lanes in zip(Rejection, reasons, strict=True):
        counts = counts.at[reason].set(jnp.sum(lanes & ~counted))
        counted |= lanes
    return counts
