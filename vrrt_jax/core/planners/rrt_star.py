"""RRT*: RRT whose tree is rewired, so that paths get shorter as long as it runs."""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.edge_checks import num_checks
from vrrt_jax.core.edges import Space
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.rrt import RRT
from vrrt_jax.core.rewire import rewire, shortcut_branch
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static


@pytree
class RRTStar(RRT):
    """RRT* (Karaman and Frazzoli 2011). It goes on to improve until its budget ends."""

    MAX_REWIRED_EDGE: ClassVar[float] = 1.92  # [rad] longest edge that rewiring checks

    # Nodes of a sparse tree in seven dimensions lie that far apart.
    rewire_radius: Any = 1.9  # () [rad]
    rewire_steps: int = static(default=96)  # sub-steps of an edge that rewiring checks
    # Nearest nodes that rewiring looks at, all inside the radius if None; how many edges to them a
    # new node asks for; how many ancestors of its parent it tries as parents.
    neighbors: int | None = static(default=None)
    tries: int = static(default=1)
    ancestors: int = static(default=0)
    shortcuts: int = static(default=0)  # rounds of shortcuts of the best path in an iteration
    # Rewiring finds no first path, and takes most of an iteration: it may begin once there is one.
    rewires_early: bool = static(default=True)

    @classmethod
    def for_world(cls, world: Space, **settings: Any) -> Self:
        """See :meth:`RRT.for_world`."""
        rewire_steps = num_checks(world, cls.MAX_REWIRED_EDGE)
        return super().for_world(world, rewire_steps=rewire_steps, **settings)

    def init(
        self, world: Space, goal: ConfigurationGoal, q_roots: np.ndarray, capacity: int
    ) -> Tree:
        """See :meth:`RRT.init`.

        Raises:
            ValueError: sub-steps are asked for, which rewiring would leave behind.
        """
        if self.intermediate:
            raise ValueError("RRT* keeps no sub-steps as nodes; expected intermediate=False")
        return super().init(world, goal, q_roots, capacity)

    def goal_score(self, goal: ConfigurationGoal) -> float:
        """None: a path can always be shorter."""
        return -float("inf")

    def after_insert(
        self,
        world: Space,
        goal: ConfigurationGoal,
        tree: Tree,
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree:
        """Rewire."""

        def rewired(tree: Tree) -> Tree:
            return rewire(
                world,
                tree,
                expansion,
                radius=jnp.float32(self.rewire_radius),
                edge_steps=self.rewire_steps,
                checks=self.tries * self.lanes,
                neighbors=self.neighbors,
                tries=self.tries,
                ancestors=self.ancestors,
            )

        if self.rewires_early:
            return rewired(tree)
        is_path = jnp.isfinite(self.path_cost(tree, goal.threshold))
        return jax.lax.cond(is_path, rewired, lambda tree: tree, tree)

    def after_iteration(
        self, world: Space, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> Tree:
        """Shorten the best path."""
        for turn in range(self.shortcuts):
            again = jax.random.fold_in(key, turn)
            tree = shortcut_branch(world, tree, goal.threshold, again)
        return tree
