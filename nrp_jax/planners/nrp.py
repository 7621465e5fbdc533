"""RRT with learned waypoints: Neural Randomized Planning (Lu, Ma, Hsu and Cai) on the kernel."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from nrp_jax.samplers import proposed
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edge_checks import free_prefix
from vrrt_jax.core.expand import SHORTEST_EDGE
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.rrt import RRT
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree


@pytree
class WaypointLanes:
    """What the lanes of an iteration are about."""

    aim: jax.Array  # (B, D) where they go by way of their waypoints
    straight: jax.Array  # (B,) bool, the waypoint is left out


@pytree
class NeuralRRT(RRT):
    """RRT whose expansions go by way of a proposed waypoint.

    A lane draws an aim and extends the nearest node v: straight on at a rate of ``straight_rate``,
    otherwise to the waypoint that the sampler proposes for v and the aim and, if nothing is in
    between, from there towards the aim.
    """

    sampler: Any  # a pytree with ``propose(world, q_from, q_goal, key) -> (B, D)``
    straight_rate: Any = 0.2  # () share of lanes
    floor: Any = None  # FloorWays, over which the nearest node is looked for; a departure

    def propose(
        self, world: GridWorld, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> Proposals:
        """Go to waypoints, or straight towards the aims."""
        key_aim, key_straight, key_sampler = jax.random.split(key, 3)
        parent, aim = self.sample_aims(world, goal, tree, key_aim)
        if self.floor is not None:
            apart = self.floor.between(aim[:, None], tree.q[None])
            apart = jnp.where(trees.occupied(tree), apart, jnp.inf)
            parent = jnp.argmin(apart, axis=1).astype(parent.dtype)
        straight = jax.random.uniform(key_straight, (self.lanes,)) < self.straight_rate
        straight = straight.at[0].set(straight[0] | (tree.iteration == 0))
        waypoint, checked = proposed(self.sampler, world, tree.q[parent], aim, key_sampler)
        return Proposals(
            parent=parent,
            target=jnp.where(straight[:, None], aim, waypoint),
            valid=jnp.all(jnp.isfinite(aim), axis=1),
            partial=jnp.ones(self.lanes, bool),
            aux=WaypointLanes(aim=aim, straight=straight),
            checked=checked,
        )

    def after_insert(
        self,
        world: GridWorld,
        goal: ConfigurationGoal,
        tree: Tree,
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree:
        """Go on from the waypoints that were reached towards the aims.

        What the planner below this one does with new nodes, it does with both.
        """
        lanes: WaypointLanes = proposals.aux
        tree = super().after_insert(world, goal, tree, proposals, expansion)

        # From every waypoint that was reached, as far towards the aim as the edge is free.
        onward = expansion.accepted & ~expansion.blocked & ~lanes.straight
        edge = world.steer(expansion.q, lanes.aim, self.edge_steps)
        num_free, checked = free_prefix(world, expansion.q, edge, self.edge_steps, tried=onward)
        tree = dataclasses.replace(tree, checked=tree.checked + checked)
        edge = world.truncate(edge, num_free / self.edge_steps)
        q, length = world.normalize(world.end(expansion.q, edge)), world.length(edge)

        # Insert what moved at all, as children of the waypoints.
        waypoint = jnp.where(onward, expansion.node_index, 0)
        score, _ = self.evaluate(world, goal, q, proposals)
        moved = onward & (num_free > 0) & jnp.isfinite(score) & (length > SHORTEST_EDGE)
        tree, node_index = trees.insert(
            tree,
            q=q,
            parent=waypoint,
            cost=tree.cost[waypoint] + length,
            score=score,
            payload=None,
            valid=moved,
        )
        proposals = dataclasses.replace(proposals, parent=waypoint)
        expansion = Expansion(
            q=q,
            node_index=node_index,
            accepted=node_index < tree.capacity,
            blocked=num_free < self.edge_steps,
        )
        return super().after_insert(world, goal, tree, proposals, expansion)
