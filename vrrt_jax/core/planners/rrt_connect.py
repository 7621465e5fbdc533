"""RRT-Connect: two trees that grow towards each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import Space, distance
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static

SAME = 1e-4  # [rad] configurations nearer than this are one


@pytree
class ConnectNode:
    """What RRT-Connect keeps for a node."""

    side: jax.Array  # (N,) i32 0 grown from the start, 1 from the goal
    fresh: jax.Array  # (N,) bool, has yet to be connected to the other tree
    meets: jax.Array  # (N,) i32 node of the other tree at the same place, -1 if none


@pytree
class RRTConnect:
    """RRT-Connect (Kuffner and LaValle 2000): two trees in one forest of two roots.

    Half of the lanes extend either tree towards random configurations; the other half drive nodes
    that have not tried yet towards the nearest node of the other tree, as far as the way is free.
    A node that arrives scores 0.
    """

    margin: float = 1.0  # how far from the ends half of the samples are drawn [rad]
    lanes: int = static(default=32)
    edge_steps: int = static(default=32)

    def forest(self, q_start: jax.Array, q_goal: jax.Array, capacity: int) -> Tree[ConnectNode]:
        """The two trees before the first iteration."""
        ends = ConnectNode(
            side=jnp.array([0, 1], jnp.int32),
            fresh=jnp.array([True, True]),
            meets=jnp.array([-1, -1], jnp.int32),
        )
        far = jnp.full(2, jnp.finfo(jnp.float32).max)
        return trees.create(jnp.stack([q_start, q_goal]), far, ends, capacity)

    def propose(self, world: Space, tree: Tree[ConnectNode], key: jax.Array) -> Proposals:
        """Connect the newest fresh nodes; extend with all other lanes."""
        lane = jnp.arange(self.lanes)
        index = jnp.arange(tree.capacity)
        node = tree.payload
        waiting = node.fresh & trees.occupied(tree)
        newest, chosen = jax.lax.top_k(jnp.where(waiting, index, -1), self.lanes // 2)
        half = self.lanes - self.lanes // 2
        connects = jnp.concatenate([jnp.zeros(half, bool), newest >= 0])
        chosen = jnp.concatenate([jnp.zeros(half, jnp.int32), chosen.astype(jnp.int32)])

        # Half of the samples near the two ends: where limits are far apart, few others serve.
        q_start, q_goal = tree.q[:2]
        ends = jnp.stack([q_start, world.end(q_start, world.edge(q_start, q_goal))])
        lower = jnp.maximum(world.lower, jnp.min(ends, axis=0) - self.margin)
        upper = jnp.minimum(world.upper, jnp.max(ends, axis=0) + self.margin)
        key_near, key_far = jax.random.split(key)
        aim_shape = (self.lanes, lower.shape[0])
        sample = jnp.where(
            (lane // 2 % 2 == 0)[:, None],
            jax.random.uniform(key_near, aim_shape, minval=lower, maxval=upper),
            sample_configurations(world, key_far, self.lanes),
        )
        aim = jnp.where(connects[:, None], tree.q[chosen], sample)
        side = jnp.where(connects, 1 - node.side[chosen], lane % 2)
        apart = trees.distances(world, tree, aim, among=node.side == side[:, None])
        nearest = jnp.argmin(apart, axis=1).astype(jnp.int32)
        return Proposals(
            parent=jnp.where(connects, chosen, nearest),
            target=jnp.where(connects[:, None], tree.q[nearest], aim),
            valid=jnp.ones(self.lanes, bool),
            partial=jnp.ones(self.lanes, bool),
            aux=(
                connects,
                nearest,
                tree.q[nearest],
                node.side[jnp.where(connects, chosen, nearest)],
            ),
        )

    def evaluate(self, world: Space, q: jax.Array, proposals: Proposals):
        """0 for children that arrived; the way left, or a large number, for the others."""
        connects, nearest, target, side = proposals.aux
        left = distance(world, q, target)
        arrived = connects & (left < SAME)
        score = jnp.where(connects, jnp.where(arrived, 0.0, left), 1e6)
        node = ConnectNode(
            side=side.astype(jnp.int32),
            fresh=~arrived,
            meets=jnp.where(arrived, nearest, -1).astype(jnp.int32),
        )
        return score, node

    def after_insert(
        self,
        world: Space,
        tree: Tree[ConnectNode],
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree[ConnectNode]:
        """A node has had its try; a child that ran into something while connecting has too."""
        connects = proposals.aux[0]
        tried = jnp.where(connects, proposals.parent, tree.capacity)
        stuck = jnp.where(connects & expansion.blocked, expansion.node_index, tree.capacity)
        fresh = tree.payload.fresh.at[tried].set(False, mode="drop")
        fresh = fresh.at[stuck].set(False, mode="drop")
        return dataclasses.replace(tree, payload=dataclasses.replace(tree.payload, fresh=fresh))


def connection_path(tree: Tree[ConnectNode]) -> np.ndarray | None:
    """The path (P, D) from start to goal through the place where the trees met, if they did."""
    best = int(np.argmin(tree.score))
    other = int(tree.payload.meets[best])
    if other < 0:
        return None
    halves = [trees.lineage(tree, best), trees.lineage(tree, other)]
    if int(tree.payload.side[best]) == 1:
        halves.reverse()
    q = np.asarray(tree.q)
    return np.concatenate([q[halves[0]], q[halves[1][::-1]][1:]])
