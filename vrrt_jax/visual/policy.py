"""Visual-RRT as published, as a policy of the kernel: grow towards what looks like the goal image.

The score of a node is its loss. Exploiting lanes take one Adam step from a node's stored gradient,
and the child inherits the moments; exploring lanes take a random step and start afresh.
"""

import dataclasses
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core import tree as trees
from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edge_checks import num_checks
from vrrt_jax.core.edges import difference
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.rewire import rewire
from vrrt_jax.core.types import Expansion, Goal, Proposals, Tree, pytree, static
from vrrt_jax.scene.world import World
from vrrt_jax.visual.adam import adam_step, fresh_moments, losses_and_gradients

MAX_RANK = 1024  # best nodes that the frontier's law ranks; its weight there is below 1e-40


@pytree
class VisualNode:
    """What Visual-RRT keeps for a node: computed once, when it is inserted."""

    grad: jax.Array  # (N, D) of the loss
    adam: optax.ScaleByAdamState  # count (N,), mu (N, D), nu (N, D)
    exploited: jax.Array  # (N,) bool, its gradient step has been taken or is blocked


@pytree
class VisualLanes:
    """What the lanes of an iteration are about."""

    exploits: jax.Array  # (B,) bool, takes an Adam step; the others explore
    adam: optax.ScaleByAdamState  # count (B,), mu (B, D), nu (B, D) that the children get


@pytree
class VisualRRT:
    """Visual-RRT (Lee et al., CVPR 2026); the symbols are the paper's.

    It follows the gradient of any goal with a differentiable loss. A new goal, camera, self-model
    of the same size or hyper-parameter never re-compiles.
    """

    MAX_STEP: ClassVar[float] = 0.12  # [rad] of a gradient step
    MAX_REWIRED_EDGE: ClassVar[float] = 0.3  # [rad]

    alpha: Any = 0.04  # () Adam step [rad]
    epsilon: Any = 0.04  # () shortest exploration step [rad]
    rho: Any = 0.7  # () exploration radius: its longest step [rad]
    kappa: Any = 0.9  # () decay of the frontier's geometric law
    eta: Any = 0.7  # () probability of the frontier's law, against a uniform choice of parent
    exploration: Any = 0.3  # () share r of lanes that explore
    beta1: Any = 0.9  # ()
    beta2: Any = 0.9  # ()
    inherit: Any = True  # () bool, children go on with their parents' moments
    rewire_radius: Any = 0.3  # () [rad]
    rewiring: bool = static(default=True)
    lanes: int = static(default=32)
    edge_steps: int = static(default=6)
    rewire_steps: int = static(default=15)
    rewire_checks: int = static(default=8)

    @classmethod
    def from_config(cls, config: PlannerConfig, world: World) -> "VisualRRT":
        """The policy with the settings of a plan; its steps are as long in any world."""
        expand, tree = config.expand, config.tree
        numbers: dict[str, Any] = {
            name: jnp.asarray(value) for name, value in dataclasses.asdict(expand).items()
        }
        return cls(
            **numbers,
            rewire_radius=jnp.float32(tree.rewire_radius),
            rewiring=tree.rewiring,
            lanes=tree.lanes,
            edge_steps=num_checks(world, max(cls.MAX_STEP, expand.rho, expand.epsilon)),
            rewire_steps=num_checks(world, max(tree.rewire_radius, cls.MAX_REWIRED_EDGE)),
        )

    def init(
        self, world: World, goal: Goal, q_roots: np.ndarray, capacity: int
    ) -> Tree[VisualNode]:
        """A forest of the start and other roots; those in collision are never expanded."""
        return tree_from_roots(world, goal, jnp.asarray(q_roots), capacity)

    def goal_score(self, goal: Goal) -> float:
        """The goal's own threshold."""
        return float(goal.threshold)

    def propose(
        self, world: World, goal: Goal, tree: Tree[VisualNode], key: jax.Array
    ) -> Proposals:
        """Draw parents from the frontier, then step along the gradient or at random.

        Nodes are ranked by loss; the node of rank k has probability
        ``eta (1 - kappa) kappa^k / (1 - kappa^M) + (1 - eta) / M``, drawn without replacement by
        Gumbel top-k. Exploiting lanes rank and draw only nodes not exploited before, since a second
        step from the same gradient would repeat the first; where those run out, lanes explore.
        The law ends at rank :data:`MAX_RANK`, as finding ranks costs more than all the rest.
        """
        key_exploit, key_explore, key_q = jax.random.split(key, 3)

        # Parents: the first lanes exploit, the others explore. An exploring lane without a parent
        # of its own shares the first one's.
        occupied = trees.occupied(tree)
        unexploited = occupied & ~tree.payload.exploited
        exploit_parent, has_step = self._draw(tree.score, unexploited, key_exploit)
        explore_parent, has_parent = self._draw(tree.score, occupied, key_explore)
        num_exploiting = jnp.round((1.0 - self.exploration) * self.lanes)
        exploits = has_step & (jnp.arange(self.lanes) < num_exploiting)
        spare = jnp.where(has_parent, explore_parent, explore_parent[0])
        parent = jnp.where(exploits, exploit_parent, spare).astype(jnp.int32)

        # Exploitation: one Adam step from the parent's stored gradient and moments.
        q = tree.q[parent]
        node = jax.tree.map(lambda leaf: leaf[parent], tree.payload)
        kept = jax.tree.map(lambda leaf: jnp.where(self.inherit, leaf, 0), node.adam)
        alpha = jnp.full(self.lanes, self.alpha)
        step, adam = adam_step(world, q, node.grad, kept, alpha, self.beta1, self.beta2)

        # Exploration: a step of random length towards a random configuration, with fresh moments.
        key_q, key_length = jax.random.split(key_q)
        towards = difference(world, q, sample_configurations(world, key_q, self.lanes))
        norm = jnp.sqrt(jnp.sum(towards**2, axis=-1, keepdims=True))
        longest = jnp.maximum(self.rho, self.epsilon)
        length = jax.random.uniform(
            key_length, (self.lanes, 1), minval=self.epsilon, maxval=longest
        )
        random_step = length * towards / jnp.maximum(norm, 1e-9)
        adam = jax.tree.map(
            lambda leaf, fresh: jnp.where(
                exploits.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, fresh
            ),
            adam,
            fresh_moments(*q.shape),
        )
        return Proposals(
            parent=parent,
            target=q + jnp.where(exploits[:, None], step, random_step),
            valid=jnp.ones(self.lanes, bool),
            partial=jnp.zeros(self.lanes, bool),
            aux=VisualLanes(exploits=exploits, adam=adam),
        )

    def _draw(
        self, score: jax.Array, allowed: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Nodes (B,) among those that are allowed (N,), and whether there were as many."""
        total = jnp.sum(allowed)
        num_ranked = jnp.minimum(total, MAX_RANK)
        rank = jnp.arange(min(MAX_RANK, len(score)))
        decay = (1.0 - self.kappa) * self.kappa**rank / (1.0 - self.kappa**num_ranked)
        _, best = jax.lax.top_k(jnp.where(allowed, -score, -jnp.inf), len(rank))
        weight = jnp.full(score.shape, (1.0 - self.eta) / total)
        weight = weight.at[best].add(self.eta * decay)
        noise = jax.random.gumbel(key, score.shape)
        logit = jnp.where(allowed, jnp.log(weight + 1e-30) + noise, -jnp.inf)
        logit, node = jax.lax.top_k(logit, self.lanes)
        return node, logit > -jnp.inf

    def evaluate(
        self, world: World, goal: Goal, q: jax.Array, proposals: Proposals
    ) -> tuple[jax.Array, VisualNode]:
        """Losses (B,) and payloads of the children."""
        loss, grad = losses_and_gradients(world, goal, q)
        unexploited = jnp.zeros(self.lanes, bool)
        return loss, VisualNode(grad=grad, adam=proposals.aux.adam, exploited=unexploited)

    def after_insert(
        self,
        world: World,
        goal: Goal,
        tree: Tree[VisualNode],
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree[VisualNode]:
        """Mark parents as exploited, also those whose step was blocked; rewire."""
        # Writes to slot N are dropped: lanes that explore mark nobody.
        taken = jnp.where(proposals.aux.exploits, proposals.parent, tree.capacity)
        exploited = tree.payload.exploited.at[taken].set(True, mode="drop")
        payload = dataclasses.replace(tree.payload, exploited=exploited)
        tree = dataclasses.replace(tree, payload=payload)
        if not self.rewiring:
            return tree
        return rewire(
            world,
            tree,
            expansion,
            radius=self.rewire_radius,
            edge_steps=self.rewire_steps,
            checks=self.rewire_checks,
        )

    def extract_path(self, tree: Tree[VisualNode]) -> np.ndarray | None:
        """The path (P, D) to the best node, if tree edges join it to the start."""
        return trees.best_path(tree)


@partial(host_jit, static_argnums=3)
def tree_from_roots(world: World, goal: Goal, q: jax.Array, capacity: int) -> Tree[VisualNode]:
    """Roots ``q`` (R, D), the start first; those in collision are never expanded."""
    score, grad = losses_and_gradients(world, goal, q)
    blocked = ~jax.vmap(world.is_free)(q)
    moments = fresh_moments(*q.shape)
    score = jnp.where(blocked, jnp.finfo(score.dtype).max, score)
    payload = VisualNode(grad=grad, adam=moments, exploited=blocked)
    return trees.create(q, score, payload, capacity, trees.root_costs(len(q)))
