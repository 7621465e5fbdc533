"""RRT, with every sub-step as a node if asked for (RRT-IS)."""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edge_checks import num_checks
from vrrt_jax.core.edges import Space
from vrrt_jax.core.goal import REACHED, ConfigurationGoal
from vrrt_jax.core.types import Expansion, Proposals, PytreeSubclasses, Tree, pytree, static


def sample_configurations(world: Space, key: jax.Array, num: int) -> jax.Array:
    """Uniform configurations (num, D) inside the limits."""
    return jax.random.uniform(
        key, (num, world.lower.shape[0]), minval=world.lower, maxval=world.upper
    )


@pytree
class RRT(PytreeSubclasses):
    """Single-tree RRT (LaValle 1998): extend the nearest node towards a random configuration.

    A node's score is its distance to the goal. The longest step is ``edge_steps`` times the world's
    resolution; :meth:`for_world` chooses ``edge_steps`` for steps of :data:`MAX_STEP`.
    """

    MAX_STEP: ClassVar[float] = 0.64  # [rad]

    goal_bias: Any = 0.1  # () share of lanes that aim at the goal
    keep_partial: bool = static(default=False)  # keep the free part of a blocked edge
    # Every sub-step of an edge becomes a node as well, without a score: RRT-IS (Lu et al. 2024).
    intermediate: bool = static(default=False)
    lanes: int = static(default=32)
    edge_steps: int = static(default=32)

    @classmethod
    def for_world(cls, world: Space, **settings: Any) -> Self:
        """The planner with steps of the same length, however fine the world's checks are."""
        return cls(edge_steps=num_checks(world, cls.MAX_STEP), **settings)

    def init(self, world: Space, goal: ConfigurationGoal, q_roots: Any, capacity: int) -> Tree:
        """A tree of the start, and a forest if there are other roots."""
        q = jnp.asarray(q_roots)
        score = jax.vmap(lambda q: goal.loss(world, q))(q)
        return trees.create(q, score, None, capacity, trees.root_costs(len(q)))

    def goal_score(self, goal: ConfigurationGoal) -> float:
        """The goal's own threshold."""
        return float(goal.threshold)

    def propose(
        self, world: Space, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> Proposals:
        """Extend the nearest nodes towards random configurations, or the goal."""
        parent, aim = self.sample_aims(world, goal, tree, key)
        return Proposals(
            parent=parent,
            target=aim,
            valid=jnp.all(jnp.isfinite(aim), axis=1),
            partial=jnp.full(self.lanes, self.keep_partial),
            aux=None,
        )

    def evaluate(self, world: Space, goal: ConfigurationGoal, q: jax.Array, proposals: Proposals):
        """Distances (B,) to the goal; there is no payload."""
        return jax.vmap(lambda q: goal.loss(world, q))(q), None

    def after_insert(
        self,
        world: Space,
        goal: ConfigurationGoal,
        tree: Tree,
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree:
        """Insert the sub-steps, if they are wanted."""
        return self.with_sub_steps(world, tree, proposals.parent, expansion.q, expansion.accepted)

    def extract_path(self, tree: Tree) -> np.ndarray | None:
        """The path (P, D) to the cheapest node at the goal, or else to the node nearest to it."""
        return trees.best_path(tree, REACHED)

    def path_cost(self, tree: Tree, threshold: jax.Array) -> jax.Array:
        """Length () of the shortest path to the goal, inf if there is none yet."""
        return trees.path_cost(tree, threshold)

    def sample(
        self, world: Space, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> jax.Array:
        """Configurations (B, D) to extend towards, NaN in lanes that have none."""
        return sample_configurations(world, key, self.lanes)

    def sample_aims(
        self, world: Space, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Random configurations (B, D) or the goal, and the nodes (B,) nearest to them.

        A lane whose aim is not finite sits the iteration out.
        """
        key_q, key_bias = jax.random.split(key)
        aim = self.sample(world, goal, tree, key_q)
        # No lane aims at a goal that is in the tree already.
        bias = jnp.where(jnp.min(tree.score) <= goal.threshold, 0.0, self.goal_bias)
        at_goal = jax.random.uniform(key_bias, (self.lanes,)) < bias
        # The first lane of all tries the straight edge from the start to the goal.
        at_goal = at_goal.at[0].set(at_goal[0] | (tree.iteration == 0))
        aim = jnp.where(at_goal[:, None], goal.q, aim)
        return trees.nearest(world, tree, aim), aim

    def with_sub_steps(
        self, world: Space, tree: Tree, parent: jax.Array, q: jax.Array, valid: jax.Array
    ) -> Tree:
        """Insert the sub-steps between nodes (B,) and their children (B, D) as children too."""
        if not self.intermediate:
            return tree
        q_from = tree.q[parent]
        edge = world.edge(q_from, q)
        # Sub-steps as long as the world's resolution; an edge has at most edge_steps of them.
        num_sub_steps = jnp.maximum(world.span(edge) / world.resolution, 1.0)
        step = jnp.arange(1, self.edge_steps, dtype=q.dtype)[:, None]
        fraction = step / num_sub_steps  # (S - 1, B), 1 and more beyond the child
        between = world.truncate(edge, jnp.minimum(fraction, 1.0))
        points = world.normalize(world.end(q_from, between)).reshape(-1, q.shape[-1])
        tree, _ = trees.insert(
            tree,
            q=points,
            parent=jnp.broadcast_to(parent, fraction.shape).reshape(-1),
            cost=(tree.cost[parent] + world.length(between)).reshape(-1),
            score=jnp.full(fraction.size, jnp.inf),
            payload=None,
            valid=(valid & (fraction < 1.0)).reshape(-1),
        )
        return tree
