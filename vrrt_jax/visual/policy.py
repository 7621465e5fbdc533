"""Visual-RRT as a policy of the kernel: grow towards what looks like the goal image.

The score of a node is its image loss. Exploiting lanes take one Adam step from a node's stored
gradient, and the child inherits the moments; exploring lanes take a random step and start afresh.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import difference, enforce_bounds
from vrrt_jax.core.parallel import map_on_threads
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.rewire import rewire
from vrrt_jax.core.types import Expansion, Proposals, Tree, pytree, static
from vrrt_jax.scene.world import World, is_free
from vrrt_jax.splat.lanes import map_lanes
from vrrt_jax.splat.loss import goal_loss
from vrrt_jax.splat.types import Camera, GoalImage, SplatModel
from vrrt_jax.splat.windows import Windows

CHILDREN = 16  # of a probe, in a generation
SPREAD_FIRST, SPREAD_LAST = 0.8, 0.2  # [rad] standard deviations of their joints
MAX_RANK = 1024  # best nodes that the frontier's law ranks; its weight there is below 1e-40


@pytree
class VisualNode:
    """What Visual-RRT keeps for a node: computed once, when it is inserted."""

    grad: jax.Array  # (N, D) of the image loss
    adam: optax.ScaleByAdamState  # count (N,), mu (N, D), nu (N, D)
    exploited: jax.Array  # (N,) bool, its gradient step has been taken or is blocked


@pytree
class VisualPolicy:
    """Visual-RRT (Lee et al., CVPR 2026); the symbols are the paper's.

    A new goal, camera, self-model of the same size or hyper-parameter never re-compiles.
    """

    splats: SplatModel
    windows: Windows | None  # how the rasterizer cuts its work, for these splats
    cameras: Camera  # leading axis V
    goal: GoalImage
    alpha: jax.Array  # () Adam step [rad]
    epsilon: jax.Array  # () exploration step [rad]
    kappa: jax.Array  # () decay of the frontier's geometric law
    eta: jax.Array  # () probability of the frontier's law, against a uniform choice of parent
    exploration: jax.Array  # () share r of lanes that explore
    beta1: jax.Array  # ()
    beta2: jax.Array  # ()
    inherit: jax.Array  # () bool, children go on with their parents' moments
    anneal_loss: jax.Array  # () loss under which Adam steps shrink with its square root; 0 = never
    rewire_radius: jax.Array  # () [rad]
    rewiring: bool = static(default=True)
    lanes: int = static(default=32)
    edge_steps: int = static(default=6)
    rewire_steps: int = static(default=15)
    rewire_checks: int = static(default=8)

    def loss(self, world: World, q: jax.Array) -> jax.Array:
        """Image loss () of a configuration (D,)."""
        return goal_loss(world.chain, self.splats, self.cameras, self.goal, q, self.windows)

    def roots(self, world: World, q: jax.Array) -> tuple[jax.Array, VisualNode]:
        """Losses (R,) and payloads of roots ``q`` (R, D)."""
        loss, grad = map_lanes(jax.value_and_grad(lambda q: self.loss(world, q)), q)
        adam = optax.ScaleByAdamState(
            count=jnp.zeros(len(q), jnp.int32), mu=jnp.zeros_like(q), nu=jnp.zeros_like(q)
        )
        return loss, VisualNode(grad=grad, adam=adam, exploited=jnp.zeros(len(q), bool))

    def propose(self, world: World, tree: Tree[VisualNode], key: jax.Array) -> Proposals:
        """Draw parents from the frontier, then step along the image gradient or at random.

        Nodes are ranked by loss; the node of rank k has probability
        ``eta (1 - kappa) kappa^k / (1 - kappa^M) + (1 - eta) / M``, drawn without replacement by
        Gumbel top-k. Exploiting lanes rank and draw only nodes not exploited before, since a second
        step from the same gradient would repeat the first; where those run out, lanes explore.
        The law ends at rank :data:`MAX_RANK`, as finding ranks costs more than all the rest.
        """
        key_exploit, key_explore, key_q = jax.random.split(key, 3)
        filled = trees.occupied(tree)
        exploit_parent, has_step = self._draw(
            tree.score, filled & ~tree.payload.exploited, key_exploit
        )
        explore_parent, has_parent = self._draw(tree.score, filled, key_explore)

        exploits = has_step & (
            jnp.arange(self.lanes) < jnp.round((1.0 - self.exploration) * self.lanes)
        )
        spare = jnp.where(has_parent, explore_parent, explore_parent[0])
        parent = jnp.where(exploits, exploit_parent, spare).astype(jnp.int32)
        q = tree.q[parent]
        node = jax.tree.map(lambda leaf: leaf[parent], tree.payload)
        kept = jax.tree.map(lambda leaf: jnp.where(self.inherit, leaf, 0), node.adam)
        node = dataclasses.replace(node, adam=kept)
        step, adam = self._adam_step(world, q, tree.score[parent], node)

        towards = difference(world, q, sample_configurations(world, key_q, self.lanes))
        norm = jnp.sqrt(jnp.sum(towards**2, axis=-1, keepdims=True))
        wander = self.epsilon * towards / jnp.maximum(norm, 1e-9)
        fresh = jax.tree.map(jnp.zeros_like, adam)
        lanes = exploits[:, None]
        return Proposals(
            parent=parent,
            target=q + jnp.where(lanes, step, wander),
            valid=jnp.ones(self.lanes, bool),
            partial=jnp.zeros(self.lanes, bool),
            aux=(
                exploits,
                jax.tree.map(
                    lambda a, b: jnp.where(exploits if a.ndim == 1 else lanes, a, b), adam, fresh
                ),
            ),
        )

    def _draw(
        self, score: jax.Array, allowed: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Nodes (B,) among those that are allowed (N,), and whether there were as many."""
        total = jnp.sum(allowed)
        ranked = jnp.minimum(total, MAX_RANK)
        rank = jnp.arange(min(MAX_RANK, len(score)))
        decay = (1.0 - self.kappa) * self.kappa**rank / (1.0 - self.kappa**ranked)
        _, best = jax.lax.top_k(jnp.where(allowed, -score, -jnp.inf), len(rank))
        weight = jnp.full(score.shape, (1.0 - self.eta) / total)
        weight = weight.at[best].add(self.eta * decay)
        noise = jax.random.gumbel(key, score.shape)
        logit = jnp.where(allowed, jnp.log(weight + 1e-30) + noise, -jnp.inf)
        logit, node = jax.lax.top_k(logit, self.lanes)
        return node, logit > -jnp.inf

    def _adam_step(self, world: World, q: jax.Array, loss: jax.Array, node: VisualNode):
        """Steps (B, D) down the image loss, and the moments after them."""
        adam = optax.scale_by_adam(b1=self.beta1, b2=self.beta2, eps=1e-8)
        direction, state = jax.vmap(adam.update)(node.grad, node.adam)
        shrink = jnp.sqrt(jnp.minimum(1.0, loss / jnp.maximum(self.anneal_loss, 1e-12)))
        step = -self.alpha * shrink[:, None] * jnp.asarray(direction)
        # Momentum into a limit would only hold the joint there.
        stuck = ~world.is_continuous & ((q + step < world.lower) | (q + step > world.upper))
        return step, state._replace(mu=jnp.where(stuck, 0.0, state.mu))

    def evaluate(self, world: World, q: jax.Array, proposals: Proposals):
        """Losses (B,) and payloads of the children."""
        loss, grad = map_lanes(jax.value_and_grad(lambda q: self.loss(world, q)), q)
        _, adam = proposals.aux
        return loss, VisualNode(grad=grad, adam=adam, exploited=jnp.zeros(self.lanes, bool))

    def after_insert(
        self,
        world: World,
        tree: Tree[VisualNode],
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree[VisualNode]:
        """Mark parents as exploited, also those whose step was blocked; rewire."""
        exploits, _ = proposals.aux
        taken = jnp.where(exploits, proposals.parent, tree.capacity)
        exploited = tree.payload.exploited.at[taken].set(True, mode="drop")
        tree = dataclasses.replace(
            tree, payload=dataclasses.replace(tree.payload, exploited=exploited)
        )
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


@pytree
class Probing:
    """Where to look before the search: forward-only renders around the start, at low resolution.

    It is done in parts of few enough lanes, that differ in their keys and may run side by side.
    """

    policy: VisualPolicy  # with the coarse goal; only its loss is used
    radius: jax.Array  # () largest distance from the start [rad]
    rounds: jax.Array  # () i32 times that each kept one looks for something better around it
    steps: jax.Array  # () i32 Adam steps that each kept one takes
    parts: int = static()  # none gives the plain tree of the paper
    num: int = static()  # configurations that a part renders
    kept: int = static()  # best of them that descend


def plant(
    world: World,
    policy: VisualPolicy,
    probing: Probing,
    q_roots: np.ndarray,
    key: jax.Array,
    capacity: int,
) -> Tree[VisualNode]:
    """A forest before the search: the start, and the probes that look most like the goal.

    All roots but the start have the cost :data:`~vrrt_jax.core.tree.UNREACHED`, until rewiring
    finds a way to them from the start's tree.

    Args:
        world: robot and obstacles.
        policy: of the search.
        probing: where to look.
        q_roots: (R, D) the start, and other configurations to search from.
        key: random key.
        capacity: slots of the tree.
    """
    keys = jax.random.split(key, probing.parts)
    probes = map_on_threads(lambda key: best_probes(world, probing, q_roots[0], key), keys)
    # As many in all as descended, so that lanes come out even and compile once.
    num = max(probing.parts * probing.kept, len(q_roots))
    return forest(world, policy, np.concatenate([q_roots, *probes])[:num], capacity)


@partial(jax.jit, static_argnums=3)
def forest(world: World, policy: VisualPolicy, q: jax.Array, capacity: int) -> Tree[VisualNode]:
    """Roots ``q`` (R, D), the start first; those in collision are never expanded."""
    score, payload = policy.roots(world, q)
    blocked = ~jax.vmap(is_free, (None, 0))(world, q)
    score = jnp.where(blocked, jnp.finfo(score.dtype).max, score)
    payload = dataclasses.replace(payload, exploited=blocked)
    cost = jnp.full(len(q), trees.UNREACHED).at[0].set(0.0)
    return trees.create(q, score, payload, capacity, cost)


@jax.jit
def best_probes(world: World, probing: Probing, q_start: jax.Array, key: jax.Array) -> jax.Array:
    """Configurations (kept, D) around the start that are free and render most like the goal."""
    key_direction, key_distance, key_children = jax.random.split(key, 3)
    direction = jax.random.normal(key_direction, (probing.num, len(q_start)))
    direction /= jnp.linalg.norm(direction, axis=1, keepdims=True)
    distance = probing.radius * jax.random.uniform(key_distance, (probing.num, 1))
    q = enforce_bounds(world, q_start + distance * direction)
    loss = _probe(world, probing, q)
    _, best = jax.lax.top_k(-loss, probing.kept)
    return _descend(world, probing, _evolve(world, probing, q[best], loss[best], key_children))


def _probe(world: World, probing: Probing, q: jax.Array) -> jax.Array:
    """Losses (n,) on the small image, infinite in collision."""
    loss = map_lanes(lambda q: probing.policy.loss(world, q), q)
    return jnp.where(jax.vmap(is_free, (None, 0))(world, q), loss, jnp.inf)


def _evolve(
    world: World, probing: Probing, q: jax.Array, loss: jax.Array, key: jax.Array
) -> jax.Array:
    """Probes (kept, D), each replaced by the best of its children while that is better.

    Children differ in some of the joints, by ever less. Where gradients end in the nearest local
    minimum, they jump out of it; and as none competes with another's children, they stay diverse.
    """
    num, joints = q.shape
    shape = (num, CHILDREN, joints)

    def generation(k, state):
        q, loss = state
        key_step, key_share, key_moved = jax.random.split(jax.random.fold_in(key, k), 3)
        past = k / jnp.maximum(probing.rounds - 1, 1)
        spread = SPREAD_FIRST * (SPREAD_LAST / SPREAD_FIRST) ** past
        share = jax.random.uniform(key_share, (*shape[:2], 1), minval=0.2)
        moved = jax.random.uniform(key_moved, shape) < share
        step = spread * moved * jax.random.normal(key_step, shape)
        children = enforce_bounds(world, (q[:, None] + step).reshape(-1, joints))
        losses = _probe(world, probing, children).reshape(num, CHILDREN)
        best = jnp.argmin(losses, axis=1)
        lowest = jnp.min(losses, axis=1)
        child = children.reshape(shape)[jnp.arange(num), best]
        better = lowest < loss
        return jnp.where(better[:, None], child, q), jnp.where(better, lowest, loss)

    return jax.lax.fori_loop(0, probing.rounds, generation, (q, loss))[0]


def _descend(world: World, probing: Probing, q: jax.Array) -> jax.Array:
    """Follow the coarse image gradient from ``q`` (kept, D); what ends in collision goes back."""
    adam = optax.scale_by_adam(b1=probing.policy.beta1, b2=probing.policy.beta2)
    gradient = jax.grad(lambda q: probing.policy.loss(world, q))

    def step(i, carry):
        q, state = carry
        direction, state = adam.update(map_lanes(gradient, q), state)
        length = probing.policy.alpha * (1.0 - i / probing.steps)
        return enforce_bounds(world, q - length * direction), state

    end, _ = jax.lax.fori_loop(0, probing.steps, step, (q, adam.init(q)))
    free = jax.vmap(is_free, (None, 0))(world, end)
    return jnp.where(free[:, None], end, q)
