"""RRT and RRT* to a joint goal, as policies of the kernel."""

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import Space, distance
from vrrt_jax.core.rewire import rewire
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static


def sample_configurations(world: Space, key: jax.Array, num: int) -> jax.Array:
    """Uniform configurations (num, D) inside the limits."""
    return jax.random.uniform(
        key, (num, world.lower.shape[0]), minval=world.lower, maxval=world.upper
    )


@pytree
class RRT:
    """Single-tree RRT (LaValle 1998); RRT* (Karaman and Frazzoli 2011) with a ``rewire_radius``.

    A node's score is its distance to the goal.
    """

    goal: jax.Array  # (D,)
    goal_bias: jax.Array  # () share of lanes that aim at the goal
    rewire_radius: jax.Array  # () [rad], used if ``star``
    star: bool = static(default=False)
    lanes: int = static(default=32)
    edge_steps: int = static(default=32)
    rewire_steps: int = static(default=96)  # longer than a step: near is far in seven dimensions

    def root(self, world: Space, q: jax.Array) -> tuple[jax.Array, None]:
        """Score of a root; there is no payload."""
        return distance(world, q, self.goal), None

    def propose(self, world: Space, tree: Tree, key: jax.Array) -> Proposals:
        """Extend the nearest nodes towards random configurations, or the goal."""
        key_q, key_bias = jax.random.split(key)
        target = sample_configurations(world, key_q, self.lanes)
        aims = jax.random.uniform(key_bias, (self.lanes, 1)) < self.goal_bias
        target = jnp.where(aims.at[0].set(tree.iteration == 0), self.goal, target)
        parent = jnp.argmin(trees.distances(world, tree, target), axis=1)
        everywhere = jnp.ones(self.lanes, bool)
        return Proposals(
            parent=parent.astype(jnp.int32),
            target=target,
            valid=everywhere,
            partial=~everywhere,
            aux=None,
        )

    def evaluate(self, world: Space, q: jax.Array, proposals: Proposals):
        """Distances (B,) to the goal."""
        return distance(world, q, self.goal), None

    def after_insert(
        self, world: Space, tree: Tree, proposals: Proposals, expansion: Expansion
    ) -> Tree:
        """Rewire, if this is RRT*."""
        if not self.star:
            return tree
        return rewire(
            world,
            tree,
            expansion,
            radius=self.rewire_radius,
            edge_steps=self.rewire_steps,
            checks=self.lanes,
        )


def tree_path(tree: Tree, index: int | None = None) -> np.ndarray:
    """The path (P, D) from the root to a node, the one with the best score by default."""
    index = int(np.argmin(tree.score)) if index is None else index
    return np.asarray(tree.q)[trees.lineage(tree, index)]
