"""NEXT: a tree that grows where a learned value and the nodes' density promise most.

After Chen, Dai, Lin, Ye, Liu and Song, "Learning to Plan in High Dimensions via Neural
Exploration-Exploitation Trees" (ICLR 2020), with the numbers that the Neural Randomized Planner's
authors compared with. Letters: ``B`` lanes, ``C`` candidates of a lane, ``N`` nodes, ``D`` joints.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from nrp_jax.scene.grid_world import GridWorld
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.rrt_star import RRTStar
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static

BLOCK = 512  # nodes that are looked at together


@pytree
class GuidedNode:
    """What NEXT keeps for each node."""

    action: jax.Array  # (N, D) the step that the guide would take
    value: jax.Array  # (N,) minus the length that is left, as the guide has it [m]
    # (N,) how many children were tried around it, by a Gaussian kernel; those that failed count too
    density: jax.Array


@pytree
class NEXTPlanner(RRTStar):
    """RRT* most of whose expansions follow a guide.

    A lane chooses the node with the highest upper confidence bound: its value and, the more the
    fewer nodes are around it, a bonus. It draws candidates around the step that the guide takes
    from there, and goes to the one whose bound is highest. Lanes choose one after the other, as if
    the children of those before were there. The other lanes are those of RRT*.
    """

    guide: Any  # of a query, see :mod:`nrp_jax.guides`
    explored_share: Any = (
        0.1  # () share of lanes that are RRT*'s, beside those that aim at the goal
    )
    bonus: Any = 10.0  # () weight of the density's part of the bound [m]
    radius: Any = 2.0  # () longest edge [m]
    width: Any = 0.5  # () of the kernel [m]
    candidates: int = static(default=10)  # C

    def init(self, world: GridWorld, goal: ConfigurationGoal, q_roots: Any, capacity: int) -> Tree:
        """See :meth:`RRTStar.init`."""
        tree = super().init(world, goal, q_roots, capacity)
        action, value = _predict(self.guide, world, tree.q[: len(q_roots)])
        nodes = GuidedNode(action=action, value=value, density=jnp.ones(len(q_roots)))
        return trees.create(
            tree.q[: len(q_roots)],
            tree.score[: len(q_roots)],
            nodes,
            capacity,
            tree.cost[: len(q_roots)],
        )

    def propose(
        self, world: GridWorld, goal: ConfigurationGoal, tree: Tree, key: jax.Array
    ) -> Proposals:
        """Extend chosen nodes by the guide's steps, and others as RRT* does."""
        key_aim, key_share, key_draw = jax.random.split(key, 3)
        nearest, aim = self.sample_aims(world, goal, tree, key_aim)
        explores = jax.random.uniform(key_share, (self.lanes,)) < self.explored_share
        explores |= jnp.all(aim == goal.q, axis=1)
        # The best of the candidates around the guide's steps.
        chosen = self._selected(world, goal, tree)
        q = tree.q[chosen]
        drawn = self.guide.draw(world, q, tree.payload.action[chosen], self.candidates, key_draw)
        drawn = enforce_bounds(world, drawn)
        flat = drawn.reshape(-1, q.shape[1])
        _, value = self.guide.predict(world, flat)
        # A candidate counts itself, as the node that it would become.
        density = 1.0 + self._density(world, tree, flat)
        bound = value + self.bonus * _uncertainty(tree, density)
        best = jnp.argmax(bound.reshape(self.lanes, -1), axis=1)
        step_to = jnp.take_along_axis(drawn, best[:, None, None], axis=1)[:, 0]
        parent = jnp.where(explores, nearest, chosen)
        target = jnp.where(explores[:, None], aim, step_to)
        return Proposals(
            parent=parent,
            target=self._within_radius(world, tree.q[parent], target),
            valid=jnp.ones(self.lanes, bool),
            partial=jnp.full(self.lanes, self.keep_partial),
            aux=None,
        )

    def evaluate(
        self, world: GridWorld, goal: ConfigurationGoal, q: jax.Array, proposals: Proposals
    ):
        """Distances (B,) to the goal, and what the guide says."""
        score, _ = super().evaluate(world, goal, q, proposals)
        action, value = self.guide.predict(world, q)
        return score, GuidedNode(action=action, value=value, density=jnp.ones(self.lanes))

    def after_insert(
        self,
        world: GridWorld,
        goal: ConfigurationGoal,
        tree: Tree,
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree:
        """Count what was tried, and rewire."""
        # What failed counts where it began, so that the next lanes begin elsewhere.
        tried = jnp.where(expansion.accepted[:, None], expansion.q, tree.q[proposals.parent])
        near = self._kernel(world, tree.q, tried)  # (B, N)
        density = tree.payload.density + jnp.sum(near, axis=0)
        # New nodes count all that are in the tree, themselves and each other included.
        own = jnp.sum(jnp.where(trees.occupied(tree), near, 0.0), axis=1)
        density = density.at[expansion.node_index].set(own, mode="drop")
        payload = dataclasses.replace(tree.payload, density=density)
        tree = dataclasses.replace(tree, payload=payload)
        return super().after_insert(world, goal, tree, proposals, expansion)

    def _selected(self, world: GridWorld, goal: ConfigurationGoal, tree: Tree) -> jax.Array:
        """The nodes (B,) i32 to extend, one after the other; none is at the goal."""
        selectable = trees.occupied(tree) & (tree.score > goal.threshold)

        def choose(density: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
            bound = tree.payload.value + self.bonus * _uncertainty(tree, density)
            best = jnp.argmax(jnp.where(selectable, bound, -jnp.inf))
            # As if its child were there.
            return density + self._kernel(world, tree.q, tree.q[best][None])[0], best

        _, chosen = jax.lax.scan(choose, tree.payload.density, length=self.lanes)
        return chosen.astype(jnp.int32)

    def _density(self, world: GridWorld, tree: Tree, q: jax.Array) -> jax.Array:
        """How many nodes are around ``q`` (n, D), by the kernel, (n,); block by block."""
        size = min(BLOCK, tree.capacity)

        def add(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            block, total = state
            # The last block begins early enough to be a whole one; no node counts twice.
            first = jnp.minimum(block * size, tree.capacity - size)
            index = first + jnp.arange(size)
            counted = (index < tree.size) & (index >= block * size)
            near = self._kernel(world, jax.lax.dynamic_slice_in_dim(tree.q, first, size), q)
            return block + 1, total + jnp.sum(jnp.where(counted, near, 0.0), axis=1)

        start = jnp.int32(0), jnp.zeros(len(q), q.dtype)
        return jax.lax.while_loop(lambda state: state[0] * size < tree.size, add, start)[1]

    def _kernel(self, world: GridWorld, nodes: jax.Array, q: jax.Array) -> jax.Array:
        """The Gaussian kernel (n, N) of ``q`` (n, D) and nodes (N, D).

        Its distance is that of a base that slides: curves would cost more than they tell.
        """
        apart = GridWorld.distances(world, nodes, q, jnp.array(True))
        return jnp.exp(-((apart / self.width) ** 2))

    def _within_radius(self, world: GridWorld, q: jax.Array, target: jax.Array) -> jax.Array:
        """Targets (B, D), moved towards ``q`` (B, D) until edges are no longer than the radius."""
        edge = world.edge(q, target)
        share = self.radius / jnp.maximum(world.length(edge), 1e-9)
        short = world.normalize(world.end(q, world.truncate(edge, jnp.minimum(share, 1.0))))
        return jnp.where((share < 1.0)[:, None], short, target)


def _uncertainty(tree: Tree, density: jax.Array) -> jax.Array:
    """The exploration part of the bound (...) at densities (...) of at least one."""
    total = jnp.sum(jnp.where(trees.occupied(tree), tree.payload.density, 0.0))
    return jnp.sqrt(jnp.log(jnp.maximum(total, 1.0)) / jnp.maximum(density, 1.0))


@jax.jit
def _predict(guide: Any, world: GridWorld, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What a guide says of configurations (n, D), for the host."""
    return guide.predict(world, q)
