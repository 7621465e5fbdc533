"""CVAE-RRT and CVAE-IRRT*: planners whose samples are those of a network that sees the whole map.

The baselines of the Neural Randomized Planner's paper (Lu et al. 2024, section VI), after Ichter,
Harrison and Pavone 2018.
"""

from typing import Any

import jax
import jax.numpy as jnp

from vrrt_jax.core.edges import Space
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.informed_rrt_star import InformedRRTStar
from vrrt_jax.core.planners.rrt import RRT
from vrrt_jax.core.types import Tree, pytree


@pytree
class CVAERRT(RRT):
    """RRT that draws a share of its samples from a learned distribution.

    The sampler is told the start of the tree and the goal. Uniform samples make up the rest, so
    that the tree can still grow wherever the network never points.
    """

    sampler: Any  # a pytree with ``draw(world, q_start, q_goal, num, key) -> (num, D)``
    uniform_share: Any = 0.5  # () share of uniform samples

    def sample(
        self, world: Space, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> jax.Array:
        """Learned and uniform samples (B, D).

        A learned sample which no path passes that is shorter than the best so far gives way to one
        of the planner below: for Informed RRT* that is one of the informed set.
        """
        key_share, key_learned, key_uniform = jax.random.split(key, 3)
        uniform = super().sample(world, goal, tree, key_uniform)
        ends = tree.q[0], jnp.asarray(goal.q)
        learned = self.sampler.draw(world, *ends, self.lanes, key_learned)
        start, end = (jnp.broadcast_to(q, learned.shape) for q in ends)
        through = world.distance(start, learned) + world.distance(learned, end)
        chosen = jax.random.uniform(key_share, (self.lanes,)) >= self.uniform_share
        chosen &= through < self.path_cost(tree, goal.threshold)
        return jnp.where(chosen[:, None], learned, uniform)


@pytree
class CVAEInformedRRTStar(CVAERRT, InformedRRTStar):
    """CVAE-IRRT*: Informed RRT* with the samples of CVAE-RRT."""
