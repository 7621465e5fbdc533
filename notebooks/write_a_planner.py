"""Write a planner: expansive-space trees (Hsu, Latombe, Motwani 1997) on the kernel.

Run it with ``python notebooks/write_a_planner.py``. The kernel steers, checks edges, inserts and
verifies; a planner says which nodes to expand and where to.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

import vrrt_jax
from vrrt_jax.core import tree as trees


@vrrt_jax.pytree
class ExpansiveSpaceTree:
    """Expand nodes that have been expanded least; a node's payload counts how often that was."""

    radius: Any = 1.0  # () standard deviation of a step [rad]; a new value never re-compiles
    goal_bias: Any = 0.1  # () share of lanes that go from the best node to the goal
    lanes: int = vrrt_jax.static(default=32)  # B
    edge_steps: int = vrrt_jax.static(default=32)  # collision checks along an edge

    def init(self, world, goal, q_roots, capacity):
        """The tree before the first iteration: the start."""
        q = jnp.asarray(q_roots)[:1]
        return trees.create(q, goal.loss(world, q[0])[None], jnp.zeros(1), capacity)

    def goal_score(self, goal):
        """The score at which the search ends."""
        return float(goal.threshold)

    def propose(self, world, goal, tree, key):
        """A parent and a target for each lane."""
        key_parent, key_step, key_goal = jax.random.split(key, 3)
        weight = jnp.where(trees.occupied(tree), -3.0 * jnp.log1p(tree.payload), -jnp.inf)
        parent = jax.random.categorical(key_parent, weight, shape=(self.lanes,))
        to_goal = jax.random.uniform(key_goal, (self.lanes,)) < self.goal_bias
        parent = jnp.where(to_goal, jnp.argmin(tree.score), parent).astype(jnp.int32)
        step = self.radius * jax.random.normal(key_step, (self.lanes, tree.q.shape[1]))
        target = jnp.where(to_goal[:, None], goal.q, tree.q[parent] + step)
        yes = jnp.ones(self.lanes, bool)
        return vrrt_jax.Proposals(parent=parent, target=target, valid=yes, partial=yes, aux=None)

    def evaluate(self, world, goal, q, proposals):
        """Scores and payloads of the children (B, D): distances to the goal, no expansions yet."""
        return jax.vmap(lambda q: goal.loss(world, q))(q), jnp.zeros(self.lanes)

    def after_insert(self, world, goal, tree, proposals, expansion):
        """Count the expansions of the parents."""
        return dataclasses.replace(tree, payload=tree.payload.at[proposals.parent].add(1.0))

    def extract_path(self, tree):
        """The path (P, D) to the node nearest to the goal."""
        return trees.best_path(tree)


if __name__ == "__main__":
    problem = vrrt_jax.load_problem("panda_posts")
    result = vrrt_jax.plan(
        problem.robot,
        problem.world,
        vrrt_jax.ConfigurationGoal(q=problem.true_goal),
        problem.q_start,
        key=jax.random.key(0),
        planner=ExpansiveSpaceTree(),
    )
    print(result)
