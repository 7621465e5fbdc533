"""One iteration: B expansions of a tree, for every planner."""

import dataclasses

import jax
import jax.numpy as jnp

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import Space, free_prefix
from vrrt_jax.core.types import Expansion, ExpansionPolicy, Payload, Rejection, Tree

SHORTEST_EDGE = 1e-5  # [rad] a shorter step would only duplicate its parent


def expand(
    world: Space, policy: ExpansionPolicy[Payload], tree: Tree[Payload], key: jax.Array
) -> Tree[Payload]:
    """Propose, steer, check edges, filter, evaluate, insert, and let the policy follow up.

    Args:
        world: robot and obstacles.
        policy: the planner.
        tree: the tree to grow.
        key: the search's key; the iteration's own is folded in here, so that results do not depend
            on how iterations are grouped into chunks.
    """
    proposals = policy.propose(world, tree, jax.random.fold_in(key, tree.iteration))
    parent = jnp.where(proposals.valid, proposals.parent, 0)
    q_from = tree.q[parent]
    edge = world.steer(q_from, proposals.target, policy.edge_steps)

    passed = free_prefix(world, q_from, edge, policy.edge_steps)
    free = (passed == policy.edge_steps) | (proposals.partial & (passed > 0))
    edge = world.truncate(edge, passed / policy.edge_steps)
    length = world.length(edge)
    q = world.normalize(world.end(q_from, edge))

    # A NaN target gives a NaN length: caught as not finite, before it can look like a limit.
    finite = jnp.isfinite(length)
    candidate = proposals.valid & finite & free & (length > SHORTEST_EDGE)
    score, payload = policy.evaluate(world, jnp.where(candidate[:, None], q, q_from), proposals)
    finite &= jnp.isfinite(score)
    for leaf in jax.tree.leaves(payload):
        finite &= jnp.all(jnp.isfinite(leaf.reshape(leaf.shape[0], -1)), axis=1)

    tree_before = tree
    tree, slot = trees.insert(
        tree,
        q=q,
        parent=parent,
        cost=tree.cost[parent] + length,
        score=score,
        payload=payload,
        ok=candidate & finite,
    )
    accepted = slot < tree.capacity
    reasons = (  # the first that holds, in the order of Rejection
        ~proposals.valid,
        finite & free & (length <= SHORTEST_EDGE),
        finite & ~free,
        ~finite,
        ~accepted,
    )
    rejected = jnp.zeros_like(tree.rejected)
    counted = jnp.zeros_like(accepted)
    for reason, lanes in zip(Rejection, reasons, strict=True):
        rejected = rejected.at[reason].set(jnp.sum(lanes & ~counted))
        counted |= lanes
    tree = dataclasses.replace(
        tree, iteration=tree_before.iteration + 1, rejected=tree_before.rejected + rejected
    )
    expansion = Expansion(
        q=q, node_index=slot, accepted=accepted, blocked=passed < policy.edge_steps
    )
    return policy.after_insert(world, tree, proposals, expansion)
