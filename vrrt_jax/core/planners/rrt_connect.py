"""RRT-Connect: two trees that grow towards each other."""

import dataclasses
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edge_checks import num_checks
from vrrt_jax.core.edges import Space, distance
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static

RECENT = 4  # iterations whose nodes may still be fresh
SAME = 1e-4  # [rad] configurations nearer than this are one
_TURNS = 16  # two trees, times four kinds of samples, times two centers of those around nodes


@pytree
class ConnectNode:
    """What RRT-Connect keeps for a node."""

    side: jax.Array  # (N,) i32 0 grown from the start, 1 from the goal
    fresh: jax.Array  # (N,) bool, has yet to be connected to the other tree
    meets: jax.Array  # (N,) i32 node of the other tree at the same place, -1 if none


@pytree
class ConnectLanes:
    """What the lanes of an iteration are about."""

    connects: jax.Array  # (B,) bool, drives a node towards the other tree
    nearest: jax.Array  # (B,) i32 node that the lane's aim is nearest to
    q_nearest: jax.Array  # (B, D)
    side: jax.Array  # (B,) i32 tree that the child belongs to


@pytree
class RRTConnect:
    """RRT-Connect (Kuffner and LaValle 2000): two trees in one forest of two roots.

    Half of the lanes extend either tree towards random configurations; the other half drive nodes
    that have not tried yet towards the nearest node of the other tree, as far as the way is free.
    A node that arrives scores 0.
    """

    MAX_STEP: ClassVar[float] = 2.56  # [rad] long, as edges are free in large pieces or not at all
    SCALES: ClassVar[float] = 3.0  # the margin times and over this: how far local samples are
    SLACK: ClassVar[float] = 1 / 16  # of an edge that is blocked

    margin: Any = 1.0  # how far from the ends half of the samples are drawn [rad]
    lanes: int = static(default=32)
    edge_steps: int = static(default=128)
    # Sub-steps by which a blocked edge is cut before it has to be: the last ones cost most checks.
    edge_slack: int = static(default=0)
    keep_partial: bool = static(default=True)  # the free part of a blocked edge to the other tree

    @classmethod
    def for_world(cls, world: Space, **settings: Any) -> Self:
        """The planner with steps of the same length, however fine the world's checks are.

        It saves checks next to what edges run into, as those of an arm cost most there.
        """
        steps = num_checks(world, cls.MAX_STEP)
        slack = int(cls.SLACK * steps)
        return cls(edge_steps=steps, edge_slack=slack, keep_partial=False, **settings)

    def init(
        self, world: Space, goal: ConfigurationGoal, q_roots: Any, capacity: int
    ) -> Tree[ConnectNode]:
        """The start is node 0, and the G goals are the next; other roots are not used.

        Raises:
            ValueError: there is no lane left to connect the trees.
        """
        if self.lanes < 2:
            raise ValueError(f"RRT-Connect has {self.lanes} lanes; expected 2 or more")
        q = np.vstack([np.asarray(q_roots)[0], np.asarray(goal.q)]).astype(np.float32)
        num = len(q)
        ends: dict[str, Any] = {
            "side": np.minimum(np.arange(num), 1).astype(np.int32),
            "fresh": np.full(num, True),
            "meets": np.full(num, -1, np.int32),
        }
        far = np.full(num, np.finfo(np.float32).max)
        return trees.create(q, far, ConnectNode(**ends), capacity)

    def init_from(
        self, world: Space, goal: ConfigurationGoal, tree: Tree, capacity: int
    ) -> Tree[ConnectNode]:
        """The same, but what another planner has grown from the start is in it; on the host.

        Args:
            world: robot and obstacles.
            goal: where to.
            tree: its node 0 is the start. Nodes that no path leads to from there are left out; the
                others stay in order, one slot farther back than without them.
            capacity: number of slots, more than the tree has nodes.
        """
        cost, parent, q = (np.asarray(leaf) for leaf in (tree.cost, tree.parent, tree.q))
        kept = np.flatnonzero(cost[: int(tree.size)] < trees.UNREACHED)[1:]
        num = len(kept) + 2
        slot = np.zeros(len(q), np.int32)
        slot[kept] = np.arange(2, num)

        ends = self.init(world, goal, q[:1], capacity)
        columns = {name: np.array(getattr(ends, name)) for name in ("q", "parent", "cost", "score")}
        columns["q"][2:num] = q[kept]
        columns["parent"][2:num] = slot[parent[kept]]
        columns["cost"][2:num] = cost[kept]
        columns["score"][2:num] = columns["score"][0]
        meets = np.array(ends.payload.meets)
        meets[2:num] = -1
        return dataclasses.replace(
            ends,
            **{name: jnp.asarray(column) for name, column in columns.items()},
            size=jnp.int32(num),
            payload=dataclasses.replace(ends.payload, meets=jnp.asarray(meets)),
        )

    def goal_score(self, goal: ConfigurationGoal) -> float:
        """0, which only a node has where the trees meet."""
        return 0.0

    def propose(
        self, world: Space, goal: ConfigurationGoal, tree: Tree[ConnectNode], key: jax.Array
    ) -> Proposals:
        """Connect the newest fresh nodes; extend with all other lanes."""
        lane, node = self._numbers(key), tree.payload

        # The second half of the lanes connects: one fresh node each, the newest first. Among the
        # latest nodes there are enough of them: an iteration adds more than can be connected.
        num = min(RECENT * self.lanes, tree.capacity)
        first = jnp.clip(tree.size - num, 0, tree.capacity - num)
        recent = first + jnp.arange(num, dtype=jnp.int32)
        waiting = jax.lax.dynamic_slice(node.fresh, (first,), (num,)) & (recent < tree.size)
        newest, _ = jax.lax.top_k(jnp.where(waiting, recent, -1), self.lanes // 2)
        half = self.lanes - self.lanes // 2
        connects = jnp.concatenate([jnp.zeros(half, bool), newest >= 0])
        chosen = jnp.concatenate([jnp.zeros(half, jnp.int32), newest])

        # A connecting lane goes from its node to the nearest of the other tree, an extending lane
        # from the nearest node of its own tree to its sample; these take turns between the trees.
        sample = self._samples(world, tree, key)
        aim = jnp.where(connects[:, None], tree.q[chosen], sample)
        side = jnp.where(connects, 1 - node.side[chosen], lane % 2)
        nearest = trees.nearest(world, tree, aim, label=node.side, wanted=side)
        parent = jnp.where(connects, chosen, nearest)
        return Proposals(
            parent=parent,
            target=jnp.where(connects[:, None], tree.q[nearest], aim),
            valid=jnp.ones(self.lanes, bool),
            partial=self.keep_partial | ~connects,
            aux=ConnectLanes(
                connects=connects,
                nearest=nearest,
                q_nearest=tree.q[nearest],
                side=node.side[parent],
            ),
        )

    def _numbers(self, key: jax.Array) -> jax.Array:
        """Numbers (B,) of the lanes, by which trees and kinds of samples take turns.

        They begin anywhere where there are fewer lanes that extend than turns, so that all come.
        """
        lane = jnp.arange(self.lanes)
        if self.lanes - self.lanes // 2 >= _TURNS:
            return lane
        return lane + jax.random.randint(jax.random.fold_in(key, _TURNS), (), 0, _TURNS)

    def _samples(self, world: Space, tree: Tree[ConnectNode], key: jax.Array) -> jax.Array:
        """Configurations (B, D) to extend to, of three kinds.

        Half of them are near the start and the first goal: where limits are far apart, few others
        serve. A quarter is around nodes, half of those around either root, at distances of all
        scales: these lead out of narrow places. The others are anywhere.
        """
        lane, num_joints = self._numbers(key), world.lower.shape[0]
        near, far, node, way, apart = jax.random.split(key, 5)
        q_start, q_goal = world.normalize(tree.q[:2])
        ends = jnp.stack([q_start, world.end(q_start, world.edge(q_start, q_goal))])
        lower = jnp.maximum(world.lower, jnp.min(ends, axis=0) - self.margin)
        upper = jnp.minimum(world.upper, jnp.max(ends, axis=0) + self.margin)
        shape = self.lanes, num_joints
        near_ends = jax.random.uniform(near, shape, minval=lower, maxval=upper)

        nodes = jax.random.randint(node, shape[:1], 0, tree.size)
        center = tree.q[jnp.where(lane // 8 % 2 == 0, lane % 2, nodes)]
        direction = jax.random.normal(way, shape)
        direction /= jnp.linalg.norm(direction, axis=1, keepdims=True)
        exponent = jax.random.uniform(apart, (self.lanes, 1), minval=-1.0, maxval=1.0)
        local = center + self.margin * self.SCALES**exponent * direction

        kind = (lane // 2 % 4)[:, None]
        sample = jnp.where(kind == 1, local, sample_configurations(world, far, self.lanes))
        return jnp.where(kind % 2 == 0, near_ends, sample)

    def evaluate(self, world: Space, goal: ConfigurationGoal, q: jax.Array, proposals: Proposals):
        """0 for children that arrived; the distance left, or a large number, for the others."""
        lanes: ConnectLanes = proposals.aux
        left = distance(world, q, lanes.q_nearest)
        arrived = lanes.connects & (left < SAME)
        score = jnp.where(lanes.connects, jnp.where(arrived, 0.0, left), 1e6)
        node = ConnectNode(
            side=lanes.side.astype(jnp.int32),
            fresh=~arrived,
            meets=jnp.where(arrived, lanes.nearest, -1).astype(jnp.int32),
        )
        return score, node

    def after_insert(
        self,
        world: Space,
        goal: ConfigurationGoal,
        tree: Tree[ConnectNode],
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree[ConnectNode]:
        """A node has had its try; a child that ran into something while connecting has too."""
        connects = proposals.aux.connects
        # Writes to slot N are dropped: lanes that extend change nothing.
        tried = jnp.where(connects, proposals.parent, tree.capacity)
        stuck = jnp.where(connects & expansion.blocked, expansion.node_index, tree.capacity)
        fresh = tree.payload.fresh.at[tried].set(False, mode="drop")
        fresh = fresh.at[stuck].set(False, mode="drop")
        return dataclasses.replace(tree, payload=dataclasses.replace(tree.payload, fresh=fresh))

    def extract_path(self, tree: Tree[ConnectNode]) -> np.ndarray | None:
        """The path (P, D) from start to goal through the place where the trees met, if they did."""
        halves = self.halves(tree)
        if halves is None:
            return None
        # Both halves end where the trees met: one of the nodes is left out.
        return np.asarray(tree.q)[np.concatenate([halves[0], halves[1][::-1][1:]])]

    def halves(self, tree: Tree[ConnectNode]) -> tuple[np.ndarray, np.ndarray] | None:
        """Nodes from the start, and from the goal, to where the trees met; None if they did not."""
        cost = np.asarray(_all_costs(tree))
        best = int(cost.argmin())
        if not np.isfinite(cost[best]):
            return None
        other = int(np.asarray(tree.payload.meets)[best])
        if int(np.asarray(tree.payload.side)[best]) == 1:
            best, other = other, best
        return trees.lineage(tree, best), trees.lineage(tree, other)

    def path_cost(self, tree: Tree[ConnectNode], threshold: jax.Array) -> jax.Array:
        """Length () of the shortest path through a place where the trees met, inf if none did."""
        return jnp.min(_costs(tree))


def _costs(tree: Tree[ConnectNode]) -> jax.Array:
    """Lengths (N,) of the paths through nodes where the trees met, both halves; inf elsewhere."""
    other = tree.payload.meets
    met = trees.occupied(tree) & (other >= 0)
    return jnp.where(met, tree.cost + tree.cost[jnp.maximum(other, 0)], jnp.inf)


_all_costs = jax.jit(_costs)  # for the host
