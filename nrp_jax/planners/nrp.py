"""RRT with learned waypoints: Neural Randomized Planning (Lu, Ma, Hsu and Cai) on the kernel."""

import jax
import jax.numpy as jnp

from nrp_jax.scene.world import GridWorld
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import free_prefix
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static


@pytree
class RRT:
    """Extend the nearest node as far as the way is free.

    A node's score is its distance to the goal. With ``intermediate``, every sub-step on the way
    becomes a node too (the paper's RRT-IS), with no score.
    """

    goal: jax.Array  # (D,)
    goal_bias: jax.Array  # () share of lanes that aim at the goal
    intermediate: bool = static(default=False)
    lanes: int = static(default=32)
    edge_steps: int = static(default=64)

    def root(self, world: GridWorld, q: jax.Array) -> tuple[jax.Array, None]:
        """Score of a root; there is no payload."""
        return world.distance(q, self.goal), None

    def propose(self, world: GridWorld, tree: Tree, key: jax.Array) -> Proposals:
        """Extend the nearest nodes towards random configurations, or the goal."""
        parent, aim, _ = self.aims(world, tree, key)
        everywhere = jnp.ones(self.lanes, bool)
        return Proposals(parent=parent, target=aim, valid=everywhere, partial=everywhere, aux=None)

    def evaluate(self, world: GridWorld, q: jax.Array, proposals: Proposals):
        """Distances (B,) to the goal."""
        return world.distance(q, self.goal), None

    def after_insert(
        self, world: GridWorld, tree: Tree, proposals: Proposals, expansion: Expansion
    ) -> Tree:
        """Insert the sub-steps, if they are wanted."""
        return self.with_steps(world, tree, proposals.parent, expansion.q, expansion.accepted)

    def aims(
        self, world: GridWorld, tree: Tree, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Nearest nodes (B,) to random configurations (B, D), and which (B,) are the goal."""
        key_q, key_bias = jax.random.split(key)
        aim = sample_configurations(world, key_q, self.lanes)
        at_goal = jax.random.uniform(key_bias, (self.lanes,)) < self.goal_bias
        at_goal = at_goal.at[0].set(at_goal[0] | (tree.iteration == 0))
        aim = jnp.where(at_goal[:, None], self.goal, aim)
        parent = jnp.argmin(trees.distances(world, tree, aim), axis=1)
        return parent.astype(jnp.int32), aim, at_goal

    def with_steps(
        self, world: GridWorld, tree: Tree, parent: jax.Array, q: jax.Array, ok: jax.Array
    ) -> Tree:
        """Insert the sub-steps between nodes (B,) and their children (B, D) as children too."""
        if not self.intermediate:
            return tree
        q_from = tree.q[parent]
        edge = world.edge(q_from, q)
        num_steps = self.edge_steps
        wanted = jnp.maximum(world.span(edge) / world.resolution, 1.0)
        fraction = jnp.arange(1, num_steps, dtype=q.dtype)[:, None] / wanted  # (S - 1, B)
        between = world.truncate(edge, jnp.minimum(fraction, 1.0))
        points = world.normalize(world.end(q_from, between)).reshape(-1, q.shape[-1])
        length = world.length(between)
        tree, _ = trees.insert(
            tree,
            q=points,
            parent=jnp.broadcast_to(parent, fraction.shape).reshape(-1),
            cost=(tree.cost[parent] + length).reshape(-1),
            score=jnp.full(fraction.size, jnp.inf),
            payload=None,
            ok=(ok & (fraction < 1.0)).reshape(-1),
        )
        return tree


@pytree
class NeuralRRT(RRT):
    """RRT whose expansions go by way of a proposed waypoint.

    A lane draws an aim and extends the nearest node v: straight on at a rate of ``straight_rate``,
    otherwise to the waypoint that the sampler proposes for v and the aim and, if nothing is in
    between, from there towards the aim.
    """

    sampler: object  # a pytree with ``propose(world, q_from, q_goal, key) -> (B, D)``
    straight_rate: jax.Array  # ()

    def propose(self, world: GridWorld, tree: Tree, key: jax.Array) -> Proposals:
        """Go to waypoints, or straight towards the aims."""
        key_aim, key_straight, key_sampler = jax.random.split(key, 3)
        parent, aim, _ = self.aims(world, tree, key_aim)
        straight = jax.random.uniform(key_straight, (self.lanes,)) < self.straight_rate
        straight = straight.at[0].set(straight[0] | (tree.iteration == 0))
        waypoint = self.sampler.propose(world, tree.q[parent], aim, key_sampler)
        return Proposals(
            parent=parent,
            target=jnp.where(straight[:, None], aim, waypoint),
            valid=jnp.ones(self.lanes, bool),
            partial=jnp.ones(self.lanes, bool),
            aux=(aim, straight),
        )

    def after_insert(
        self, world: GridWorld, tree: Tree, proposals: Proposals, expansion: Expansion
    ) -> Tree:
        """Go on from the waypoints that were reached towards the aims."""
        aim, straight = proposals.aux
        tree = self.with_steps(world, tree, proposals.parent, expansion.q, expansion.accepted)
        onward = expansion.accepted & ~expansion.blocked & ~straight
        edge = world.steer(expansion.q, aim, self.edge_steps)
        passed = free_prefix(world, expansion.q, edge, self.edge_steps)
        edge = world.truncate(edge, passed / self.edge_steps)
        q = world.normalize(world.end(expansion.q, edge))
        waypoint = jnp.where(onward, expansion.node_index, 0)
        score, length = world.distance(q, self.goal), world.length(edge)
        moved = onward & (passed > 0) & jnp.isfinite(score) & (length > 1e-5)
        tree, slot = trees.insert(
            tree,
            q=q,
            parent=waypoint,
            cost=tree.cost[waypoint] + length,
            score=score,
            payload=None,
            ok=moved,
        )
        return self.with_steps(world, tree, waypoint, q, slot < tree.capacity)
