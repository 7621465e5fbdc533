"""Informed RRT*: RRT* whose samples can be on a path shorter than the best one so far."""

import jax
import jax.numpy as jnp

from vrrt_jax.core.edges import Space
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.informed import sample_informed
from vrrt_jax.core.planners.rrt_star import RRTStar
from vrrt_jax.core.types import Tree, pytree


@pytree
class InformedRRTStar(RRTStar):
    """Informed RRT* (Gammell, Srinivasa and Barfoot 2014); RRT* until it has found a path."""

    def sample(
        self, world: Space, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> jax.Array:
        """Samples (B, D) of the informed set, NaN where none was found."""
        cost = self.path_cost(tree, goal.threshold)
        ends = tree.q[0], jnp.asarray(goal.q)
        q, found = sample_informed(world, ends, cost, key, self.lanes)
        return jnp.where(found[:, None], q, jnp.nan)
