"""BIT*: batches of samples, joined by the most promising edges first."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import Space
from vrrt_jax.core.goal import REACHED, ConfigurationGoal
from vrrt_jax.core.informed import sample_informed
from vrrt_jax.core.rewire import GAIN, winners, with_costs
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static

TRIED = 4  # configurations that are drawn and checked for each sample of a batch


@pytree
class BatchNode:
    """What BIT* keeps for a sample, whether a path leads to it yet or not."""

    to_goal: jax.Array  # (N,) distance to the goal
    # (N, K) i32 the nearest of the samples before it, -1 if there are fewer; start and goal
    near: jax.Array
    apart: jax.Array  # (N, K) how far these are
    blocked: jax.Array  # (N, K) bool, the edge to that one is known not to be free


@pytree
class BatchLanes:
    """The edges that an iteration tries."""

    pair: jax.Array  # (B,) i32 place of the edge among all N * K
    to: jax.Array  # (B,) i32 sample that it leads to
    length: jax.Array  # (B,)
    key: jax.Array  # () of the next batch


@pytree
class BITStar:
    """BIT* (Gammell, Srinivasa and Barfoot 2015). It goes on to improve until its budget ends.

    All samples are in the tree: those that no path leads to are roots with the cost
    :data:`~vrrt_jax.core.tree.UNREACHED`. Every lane tries one edge between two samples, those
    first that promise the shortest path from start to goal. When no edge is left that could
    shorten the best path, a new batch of the informed set is drawn. A sample has edges to its
    nearest before it, to the start and to the goal, ``neighbors`` in all, which bounds the queue.
    """

    lanes: int = static(default=32)
    edge_steps: int = static(default=64)
    batch: int = static(default=128)  # samples of a batch, free ones
    # By the formula of Karaman and Frazzoli in eight dimensions, 14 of 100 nodes and 23 of 1,000.
    neighbors: int = static(default=16)

    def init(
        self, world: Space, goal: ConfigurationGoal, q_roots: Any, capacity: int
    ) -> Tree[BatchNode]:
        """The start is node 0 and the goal node 1; other roots are not used."""
        q = jnp.stack([jnp.asarray(q_roots)[0], jnp.asarray(goal.q)])
        ahead = world.distance(q[0], q[1])
        nothing = jnp.zeros((2, self.neighbors))
        node = BatchNode(
            to_goal=jnp.stack([ahead, jnp.zeros_like(ahead)]),
            near=jnp.full(nothing.shape, -1, jnp.int32).at[1, 0].set(0),
            apart=nothing.at[1, 0].set(ahead),
            blocked=jnp.zeros(nothing.shape, bool),
        )
        score = jnp.stack([ahead, jnp.asarray(jnp.inf, ahead.dtype)])
        return trees.create(q, score, node, capacity, trees.root_costs(2))

    def goal_score(self, goal: ConfigurationGoal) -> float:
        """None: a path can always be shorter."""
        return -float("inf")

    def propose(
        self, world: Space, goal: ConfigurationGoal, tree: Tree[BatchNode], key: jax.Array
    ) -> Proposals:
        """The edges that promise the shortest paths, among those that shorten one."""
        node = tree.payload
        own = jnp.broadcast_to(jnp.arange(tree.capacity)[:, None], node.near.shape)
        other = jnp.maximum(node.near, 0)
        known = trees.occupied(tree)[:, None] & (node.near >= 0) & ~node.blocked

        # An edge goes from the sample that is cheaper to reach to the other one. It has to shorten
        # the path to that, and to leave room for a shorter path to the goal.
        outward = tree.cost[own] <= tree.cost[other]
        first, last = jnp.where(outward, own, other), jnp.where(outward, other, own)
        there = tree.cost[first] + node.apart
        promised = there + node.to_goal[last]
        useful = known & (tree.cost[first] < trees.UNREACHED) & (tree.cost[last] - there > GAIN)
        useful &= promised < self.path_cost(tree, goal.threshold)
        promise, pair = jax.lax.top_k(-jnp.where(useful, promised, jnp.inf).reshape(-1), self.lanes)
        first, last, apart = (leaf.reshape(-1)[pair] for leaf in (first, last, node.apart))
        return Proposals(
            parent=first.astype(jnp.int32),
            target=tree.q[last],
            valid=jnp.isfinite(promise),
            partial=jnp.zeros(self.lanes, bool),
            aux=BatchLanes(pair=pair, to=last, length=apart, key=key),
        )

    def evaluate(self, world: Space, goal: ConfigurationGoal, q: jax.Array, proposals: Proposals):
        """Children stand where samples do, and will not stay."""
        zeros = jnp.zeros((self.lanes, self.neighbors))
        node = BatchNode(
            to_goal=zeros[:, 0],
            near=zeros.astype(jnp.int32),
            apart=zeros,
            blocked=zeros.astype(bool),
        )
        return zeros[:, 0], node

    def after_insert(
        self,
        world: Space,
        goal: ConfigurationGoal,
        tree: Tree[BatchNode],
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree[BatchNode]:
        """Samples take the places of the children; without an edge to try, there are more."""
        lanes: BatchLanes = proposals.aux
        size = tree.size - jnp.sum(expansion.accepted)
        is_full = tree.size >= tree.capacity

        # An edge that is free to its end makes its sample a child, if no other lane offers more.
        free = expansion.accepted & (world.distance(expansion.q, tree.q[lanes.to]) < REACHED)
        there = tree.cost[proposals.parent] + lanes.length
        gain = jnp.where(free, tree.cost[lanes.to] - there, 0.0)
        wins = winners(lanes.to, gain, tree.capacity)
        slot = jnp.where(wins, lanes.to, tree.capacity)
        # An edge that is not is not tried again, unless there was no room to find out.
        tried = proposals.valid & ~free & ~(is_full & ~expansion.blocked)
        blocked = tree.payload.blocked.reshape(-1)
        blocked = blocked.at[jnp.where(tried, lanes.pair, blocked.size)].set(True, mode="drop")
        kept = jnp.arange(tree.capacity) < size
        tree = dataclasses.replace(
            tree,
            size=size,
            parent=jnp.where(kept, tree.parent, -1).at[slot].set(proposals.parent, mode="drop"),
            payload=dataclasses.replace(
                tree.payload, blocked=blocked.reshape(tree.payload.blocked.shape)
            ),
        )
        tree = jax.lax.cond(jnp.any(wins), lambda t: with_costs(world, t), lambda t: t, tree)

        is_idle = ~jnp.any(proposals.valid)
        more = lambda t: self._with_batch(world, goal, t, lanes.key)  # noqa: E731
        tree = jax.lax.cond(is_idle, more, lambda t: t, tree)
        reached = trees.occupied(tree) & (tree.cost < trees.UNREACHED)
        score = jnp.where(reached, tree.payload.to_goal, jnp.inf)
        return dataclasses.replace(tree, score=score)

    def extract_path(self, tree: Tree[BatchNode]) -> np.ndarray | None:
        """The path (P, D) to the goal, or else to the sample nearest to it that a path leads to."""
        return trees.best_path(tree, REACHED)

    def path_cost(self, tree: Tree[BatchNode], threshold: jax.Array) -> jax.Array:
        """Length () of the shortest path to the goal, inf if there is none yet."""
        return trees.path_cost(tree, threshold)

    def _with_batch(
        self, world: Space, goal: ConfigurationGoal, tree: Tree[BatchNode], key: jax.Array
    ) -> Tree[BatchNode]:
        """The tree with another batch of free samples that could shorten the best path."""
        cost = self.path_cost(tree, goal.threshold)
        num = TRIED * self.batch
        q, valid = sample_informed(world, (tree.q[0], tree.q[1]), cost, key, num)
        free = valid & jax.vmap(world.is_free)(q)
        chosen = jnp.flatnonzero(free, size=self.batch, fill_value=num)
        valid, q = chosen < num, q[jnp.minimum(chosen, num - 1)]

        # Their nearest samples, of the older ones and of those before them in the batch.
        own = jnp.where(valid, tree.size + jnp.arange(self.batch), 0)
        slots = jnp.where(valid, own, tree.capacity)
        nodes = dataclasses.replace(tree, q=tree.q.at[slots].set(q, mode="drop"))
        nodes = dataclasses.replace(nodes, size=tree.size + jnp.sum(valid))
        earlier = jnp.arange(tree.capacity) < own[:, None]
        nearness, near = jax.lax.top_k(
            -trees.distances(world, nodes, q, earlier), self.neighbors - 2
        )
        # The start and the goal are near to all: in many dimensions they are hardly ever among the
        # nearest, and the ends of the best path would stay as they are.
        to_goal = jax.vmap(lambda q: goal.loss(world, q))(q)
        from_start = world.distance(jnp.broadcast_to(tree.q[0], q.shape), q)
        near = jnp.concatenate([near, jnp.broadcast_to(jnp.arange(2), (self.batch, 2))], axis=1)
        apart = jnp.concatenate([-nearness, from_start[:, None], to_goal[:, None]], axis=1)
        found = jnp.isfinite(apart)
        tree, _ = trees.insert(
            tree,
            q=q,
            parent=jnp.full(self.batch, -1),
            cost=jnp.full(self.batch, trees.UNREACHED),
            score=to_goal,
            payload=BatchNode(
                to_goal=to_goal,
                near=jnp.where(found, near, -1),
                apart=jnp.where(found, apart, 0.0),
                blocked=jnp.zeros(near.shape, bool),
            ),
            valid=valid,
        )
        return dataclasses.replace(tree, checked=tree.checked + num)
