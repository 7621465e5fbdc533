"""Visual-RRT with lineages: one tree from the start, in which many branches get their turn.

Ranked by loss alone, the branches of one local minimum would take all lanes. So every node belongs
to a lineage, which children inherit and which competes with no other. The tree is grown in three
stages. Random edges scatter from the start; they take turns among the lineages. Then each lineage
improves by random jumps from its best node. At last each follows its image gradient, as Visual-RRT
does: one Adam step a node, whose child inherits the moments. First all lineages take turns, and
then the best go on.
"""

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core import tree as trees
from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edge_checks import num_checks
from vrrt_jax.core.types import Expansion, Goal, Proposals, Tree, pytree, static
from vrrt_jax.scene.world import World
from vrrt_jax.splat.lanes import map_lanes, one_of
from vrrt_jax.visual.adam import adam_step, fresh_moments, losses_and_gradients

JUMP_FIRST, JUMP_LAST = 0.8, 0.2  # [rad] standard deviations of a joint that a jump moves
BESIDE = 1e-3  # [rad] a joint of a child that only repeats its parent with a gradient
FARTHER = 1.5  # radius of an attempt, in units of the one before
FEWEST_MOVED = 0.2  # share of its joints that a jump moves, at least, on average


@pytree
class LineageNode:
    """What is kept for a node."""

    lineage: jax.Array  # (N,) i32 the one that it belongs to
    adam: optax.ScaleByAdamState  # count (N,), mu (N, D), nu (N, D)
    grad: jax.Array  # (N, D) of the loss, where it is known
    has_grad: jax.Array  # (N,) bool
    exploited: jax.Array  # (N,) bool, its gradient step has been taken or is blocked


@pytree
class LineageLanes:
    """What the lanes of an iteration are about."""

    lineage: jax.Array  # (B,) i32 of the children
    adam: optax.ScaleByAdamState  # count (B,), mu (B, D), nu (B, D) that the children get
    descends: jax.Array  # (B,) bool, takes an Adam step; the same for all lanes


@pytree
class LineageRRT:
    """Visual-RRT (Lee et al., CVPR 2026) with lineages, for any goal with a differentiable loss.

    A gradient costs three times as much as a loss: only the last stage takes them.
    """

    MAX_STEP: ClassVar[float] = 2.8  # [rad]

    radius: Any = 2.8  # () of the ball around the start [rad]
    samples: Any = 1024  # () random edges from the start
    jumps: Any = 64  # () of each lineage
    steps: Any = 60  # () Adam steps of a lineage
    young: Any = 25  # () of them that every lineage takes, before the best go on
    alpha: Any = 0.06  # () first Adam step, falling to zero [rad]
    beta1: Any = 0.9  # ()
    beta2: Any = 0.9  # ()
    num: int = static(default=64)  # lineages, L
    lanes: int = static(default=32)
    edge_steps: int = static(default=140)

    @classmethod
    def from_config(cls, config: PlannerConfig, world: World) -> "LineageRRT":
        """The policy with the settings of a plan."""
        own = config.lineages
        return cls(
            **{name: jnp.float32(getattr(own, name)) for name in ("radius", "alpha")},
            **{n: jnp.int32(getattr(own, n)) for n in ("samples", "jumps", "steps", "young")},
            beta1=jnp.float32(config.expand.beta1),
            beta2=jnp.float32(config.expand.beta2),
            num=own.num,
            lanes=config.tree.lanes,
            edge_steps=num_checks(world, cls.MAX_STEP),
        )

    def again(self) -> "LineageRRT":
        """The policy of the next attempt: twice as much to do in each stage, and farther around."""
        names = ("samples", "jumps", "steps", "young")
        more = {name: 2 * getattr(self, name) for name in names}
        return dataclasses.replace(self, radius=FARTHER * self.radius, **more)

    @property
    def stages(self) -> Any:
        """Iterations (3,) at which the stages end; in the last all have had their steps."""
        turns = -(-self.num // self.lanes)  # iterations in which every lineage has had one
        length = [-(-self.samples // self.lanes), self.jumps * turns]
        length.append((1 + self.young) * turns + self.steps - self.young)
        return jnp.cumsum(jnp.stack([jnp.int32(number) for number in length]))

    def init(
        self, world: World, goal: Goal, q_roots: np.ndarray, capacity: int
    ) -> Tree[LineageNode]:
        """The start, and other roots, in the first lineages; those in collision look worst."""
        return tree_from_roots(world, goal, jnp.asarray(q_roots), capacity)

    def goal_score(self, goal: Goal) -> float:
        """The goal's own threshold."""
        return float(goal.threshold)

    def propose(
        self, world: World, goal: Goal, tree: Tree[LineageNode], key: jax.Array
    ) -> Proposals:
        """Scatter, jump or descend, by the iteration."""
        stage = jnp.searchsorted(self.stages[:2], tree.iteration, side="right")
        stages = (self._scatter, self._jump, self._descend)
        return jax.lax.switch(stage, stages, world, goal, tree, key)

    def _scatter(
        self, world: World, goal: Goal, tree: Tree[LineageNode], key: jax.Array
    ) -> Proposals:
        """Random edges from the start."""
        step = steps_in_ball(key, self.lanes, tree.q.shape[1], self.radius)
        start = jnp.zeros(self.lanes, jnp.int32)
        every = jnp.ones(self.lanes, bool)
        lineage = self._in_turn(tree.iteration)
        return self._proposals(start, tree.q[0] + step, every, lineage)

    def _jump(self, world: World, goal: Goal, tree: Tree[LineageNode], key: jax.Array) -> Proposals:
        """From the best node of each lineage in turn; some joints move, by ever less."""
        begin, end = self.stages[:2]
        best, exists, _ = self._best(tree)
        turn = tree.iteration - begin
        lineage = self._in_turn(turn)
        parent = best[lineage]

        key_step, key_share, key_moved = jax.random.split(key, 3)
        progress = turn / jnp.maximum(end - begin - 1, 1)
        spread = JUMP_FIRST * (JUMP_LAST / JUMP_FIRST) ** progress
        shape = (self.lanes, tree.q.shape[1])
        share = jax.random.uniform(key_share, (self.lanes, 1), minval=FEWEST_MOVED)
        moved = jax.random.uniform(key_moved, shape) < share
        step = spread * moved * jax.random.normal(key_step, shape)
        return self._proposals(parent, tree.q[parent] + step, exists[lineage], lineage)

    def _descend(
        self, world: World, goal: Goal, tree: Tree[LineageNode], key: jax.Array
    ) -> Proposals:
        """An Adam step at the tip of each lineage that gets a lane."""
        # The tip is the newest node of a lineage that has taken a step, or else its best.
        node = tree.payload
        best, exists, lowest = self._best(tree)
        slot = jnp.where(node.has_grad, jnp.arange(tree.capacity), -1)
        newest = jax.ops.segment_max(slot, self._label(tree), self.num + 1)[: self.num]
        tip = jnp.where(newest >= 0, newest, best)

        # Young lineages come first, those with the fewest steps before others; then the best.
        count = jnp.asarray(node.adam.count)[tip]
        goes_on = exists & ~node.exploited[tip] & (count < self.steps)
        rank = jnp.where(count < self.young, count - self.young, lowest)
        order = jnp.argsort(jnp.where(goes_on, rank, jnp.inf))
        lineage = jnp.resize(order, (self.lanes,))  # fewer lineages than lanes: some come twice
        valid = goes_on[lineage] & (jnp.arange(self.lanes) < self.num)
        parent = jnp.where(valid, tip[lineage], 0)

        # An Adam step. Where no gradient is known yet, a child right beside the tip gets one.
        q, has_grad = tree.q[parent], node.has_grad[parent]
        old = jax.tree.map(lambda leaf: leaf[parent], node.adam)
        alpha = self.alpha * (1.0 - old.count / self.steps)
        step, adam = adam_step(world, q, node.grad[parent], old, alpha, self.beta1, self.beta2)
        beside = BESIDE * jax.random.normal(key, step.shape)
        step, adam = jax.vmap(_one_of)(has_grad, (step, adam), (beside, old))
        return self._proposals(parent, q + step, valid, lineage, adam)

    def _in_turn(self, turn: jax.Array) -> jax.Array:
        """The lineages (B,) that the lanes serve in an iteration, if all of them take turns."""
        return (turn * self.lanes + jnp.arange(self.lanes)) % self.num

    def _label(self, tree: Tree[LineageNode]) -> jax.Array:
        """The lineage (N,) of each node, L for empty slots."""
        return jnp.where(trees.occupied(tree), tree.payload.lineage, self.num)

    def _best(self, tree: Tree[LineageNode]) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The best node (L,) of each lineage, whether there is one, and its score."""
        label = self._label(tree)
        lowest = jax.ops.segment_min(tree.score, label, self.num + 1)
        slot = jnp.where(tree.score <= lowest[label], jnp.arange(tree.capacity), tree.capacity)
        best = jax.ops.segment_min(slot, label, self.num + 1)[: self.num]
        exists = best < tree.capacity
        return jnp.where(exists, best, 0), exists, lowest[: self.num]

    def _proposals(
        self,
        parent: jax.Array,
        target: jax.Array,
        valid: jax.Array,
        lineage: jax.Array,
        adam: optax.ScaleByAdamState | None = None,
    ) -> Proposals:
        descends = jnp.full(self.lanes, adam is not None)
        adam = fresh_moments(*target.shape) if adam is None else adam
        return Proposals(
            parent=parent.astype(jnp.int32),
            target=target,
            valid=valid,
            partial=jnp.ones(self.lanes, bool),
            aux=LineageLanes(lineage=lineage.astype(jnp.int32), adam=adam, descends=descends),
        )

    def evaluate(
        self, world: World, goal: Goal, q: jax.Array, proposals: Proposals
    ) -> tuple[jax.Array, LineageNode]:
        """Losses (B,) and payloads of the children."""
        lanes: LineageLanes = proposals.aux
        score, grad = one_of(
            lanes.descends[0],
            losses_and_gradients,
            lambda world, goal, q: (_losses(world, goal, q), jnp.zeros_like(q)),
            *(world, goal, q),
        )
        return score, LineageNode(
            lineage=lanes.lineage,
            adam=lanes.adam,
            grad=grad,
            has_grad=lanes.descends,
            exploited=jnp.zeros(self.lanes, bool),
        )

    def after_insert(
        self,
        world: World,
        goal: Goal,
        tree: Tree[LineageNode],
        proposals: Proposals,
        expansion: Expansion,
    ) -> Tree[LineageNode]:
        """Mark parents as exploited, also those whose step was blocked."""
        # Writes to slot N are dropped: lanes without a step mark nobody.
        stepped = proposals.aux.descends & proposals.valid
        taken = jnp.where(stepped, proposals.parent, tree.capacity)
        exploited = tree.payload.exploited.at[taken].set(True, mode="drop")
        payload = dataclasses.replace(tree.payload, exploited=exploited)
        return dataclasses.replace(tree, payload=payload)

    def extract_path(self, tree: Tree[LineageNode]) -> np.ndarray | None:
        """The path (P, D) to the best node, if tree edges join it to the start."""
        return trees.best_path(tree)


def _one_of(is_first: jax.Array, first: Any, second: Any) -> Any:
    """One of two trees of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(is_first, a, b), first, second)


def _losses(world: World, goal: Goal, q: jax.Array) -> jax.Array:
    """Losses (n,) of configurations (n, D)."""
    return map_lanes(lambda q: goal.loss(world, q), q)


@host_jit
def losses_where_free(world: World, goal: Goal, q: jax.Array) -> jax.Array:
    """Losses (n,) of configurations (n, D), infinite in collision."""
    return jnp.where(jax.vmap(world.is_free)(q), _losses(world, goal, q), jnp.inf)


def steps_in_ball(key: jax.Array, num: int, joints: int, radius: Any) -> jax.Array:
    """Random steps (n, D) inside a ball; their length is uniform, so that short ones are many."""
    key_direction, key_length = jax.random.split(key)
    direction = jax.random.normal(key_direction, (num, joints))
    direction /= jnp.linalg.norm(direction, axis=1, keepdims=True)
    return radius * jax.random.uniform(key_length, (num, 1)) * direction


@functools.partial(host_jit, static_argnums=3)
def tree_from_roots(world: World, goal: Goal, q: jax.Array, capacity: int) -> Tree[LineageNode]:
    """Roots ``q`` (R, D), the start first; the worst of scores for those in collision."""
    score = _losses(world, goal, q)
    is_free = jax.vmap(world.is_free)(q)
    payload = LineageNode(
        lineage=jnp.arange(len(q), dtype=jnp.int32),
        adam=fresh_moments(*q.shape),
        grad=jnp.zeros_like(q),
        has_grad=jnp.zeros(len(q), bool),
        exploited=jnp.zeros(len(q), bool),
    )
    score = jnp.where(is_free, score, jnp.finfo(score.dtype).max)
    return trees.create(q, score, payload, capacity, trees.root_costs(len(q)))
