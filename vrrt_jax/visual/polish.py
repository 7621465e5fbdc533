"""Least squares on the ends of a search: tell apart what a small image cannot.

Many configurations look nearly like the goal: half a turn of a gripper, another elbow, a wrist that
makes up for another. Each is a local minimum of the loss, which gradients do not leave. So samples
spread widely around the best nodes of a search, with some joints moved and others not, and all
descend by Levenberg-Marquardt, for which with few joints forward renders suffice. The distinct ends
start the next round. Where none matches, the outer joints are drawn anew: the image tells them
last. The last ends descend on a larger image with more splats, which tells what the small one does
not, and then on a close-up of the hand beside it, where half a turn becomes visible. What no image
tells stays near the start: a weak prior sees to that.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import PolishConfig
from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edges import difference, enforce_bounds, steps_between
from vrrt_jax.core.parallel import map_on_threads
from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.scene.world import World
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.images import cut_goal
from vrrt_jax.splat.lanes import map_lanes
from vrrt_jax.splat.types import Camera, SplatModel
from vrrt_jax.visual.distinct import distinct
from vrrt_jax.visual.goal import CloseUp
from vrrt_jax.visual.polish_samples import last_hinge, nearer_turns, redraw_outer, sample_around
from vrrt_jax.visual.twins import twins

LINEARIZE_BATCH = 4  # configurations in one call: with their differences, a batch of renders
CLOSE_UP_BATCH = 2  # the same at a close-up: few ends are left, and each core takes some
EVALUATE_BATCH = 32  # configurations whose cost alone is asked for, in one call
FD_STEP = 2e-4  # [rad] step of the finite differences; longer ones lose the weak directions
LEAST_TOLD = 1e-3  # of a threshold per rad^2; joints that raise the loss by less are not told
RIDGE = 1e-7  # keeps joints that no pixel sees where they are
MAX_STEP = 0.3  # [rad] of one step of a joint
LATE_SAMPLES = 4  # times as many, where nothing matches
TWINNED = 2  # best ends whose kinematic twins are looked at
PAYS = 0.01  # share of the cost; steps that save less are idle
IDLE_STEPS = 2  # in a row, after which a configuration is left
TURNS = 12  # in which the last joint goes all the way round
SPREAD_DECAY = 0.5  # how far samples spread in a round, in units of the round before
LEAST_COVERED = 0.01  # share of a close-up; a hand that is hidden tells nothing


@pytree
class PriorGoal:
    """A goal, and a weak preference for configurations near the start."""

    goal: Any  # a LeastSquaresGoal
    q_start: jax.Array  # (D,)
    prior: jax.Array  # () cost of a radian away from the start


@dataclasses.dataclass(frozen=True, kw_only=True)
class Polishing:
    """On which images configurations are polished, and how."""

    coarse: PriorGoal  # samples descend on this one
    fine: PriorGoal  # and the last of them on this one
    close_up: CloseUp | None  # and their hands at last here
    config: PolishConfig

    @property
    def arrays(self) -> Any:
        """A pytree of all that programs see of it."""
        close_up = self.close_up
        return self.coarse, self.fine, None if close_up is None else close_up.objective

    @property
    def threshold(self) -> float:
        """Loss of a match on the fine image."""
        return float(self.fine.goal.threshold)


class _GaussNewtonModel(NamedTuple):
    """The cost of n configurations, and its quadratic model around each."""

    q: np.ndarray  # (n, D)
    loss: np.ndarray  # (n,) of the goal alone
    cost: np.ndarray  # (n,) and with the prior
    matrix: np.ndarray  # (n, D, D) of Gauss and Newton, half of the cost's second derivatives
    slope: np.ndarray  # (n, D) half of its first
    free: np.ndarray  # (n,) bool

    def take(self, rows: Any) -> "_GaussNewtonModel":
        """The same of some configurations."""
        return _GaussNewtonModel(*(column[rows] for column in self))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Polished:
    """Distinct ends of polishing, best first."""

    q: np.ndarray  # (n, D)
    loss: np.ndarray  # (n,) on the fine image, as it is judged
    colored_loss: np.ndarray  # (n,) on the fine image, as it is searched
    cost: np.ndarray  # (n,) the same with the prior and the close-up, infinite in collision
    uncertainty: np.ndarray  # (n, D) how far off a joint may be, see :func:`joint_uncertainty`


def polish(world: World, polishing: Polishing, q: np.ndarray, seed: int) -> Polished:
    """Spread samples around configurations (H, D) and descend.

    Args:
        world: robot and obstacles.
        polishing: the goal at each resolution.
        q: (H, D) hypotheses.
        seed: of the samples.
    """
    rng = np.random.default_rng(seed)
    config, coarse, fine = polishing.config, polishing.coarse, polishing.fine
    q_start = np.asarray(fine.q_start)

    # Rounds on the coarse image: sample, keep the best, descend, keep distinct ends. Where nothing
    # matches after all rounds, there are as many again, with more samples.
    for k in range(2 * config.rounds):
        if k < config.rounds:
            num, lanes, spread = config.samples, config.lanes, config.spread * SPREAD_DECAY**k
            samples = sample_around(q, last_hinge(world), num, spread, rng)
        else:
            num, lanes = LATE_SAMPLES * config.samples // 2, 2 * config.lanes
            around = sample_around(q, last_hinge(world), num, config.spread, rng)
            samples = np.concatenate([around, redraw_outer(world, q, num, rng)])
        samples = nearer_turns(world, samples, q_start)
        cost = _in_batches(evaluate_cost, world, coarse, samples, EVALUATE_BATCH)[0]
        best = samples[np.argsort(cost, kind="stable")[:lanes]]
        ends = _descend(lambda q, _: _linearize(world, coarse, q), best, config.steps)
        kept = _distinct_ends(world, ends, config.kept)
        q = kept.q
        matched = np.any(kept.free & (kept.cost <= float(coarse.goal.threshold)))
        if matched and k + 1 >= config.rounds:
            break

    # The fine image, from every minimum over a whole turn of the last joint.
    turned = _turns_of_last_hinge(world, fine, q, config.kept)
    ends = _descend(lambda q, _: _linearize(world, fine, q), turned, config.steps)
    kept = _with_twins(world, fine, _distinct_ends(world, ends, config.kept), config)

    # The close-up of the hand, together with the fine image.
    if polishing.close_up is not None:
        ends = _descend_close_up(world, polishing, polishing.close_up, kept)
        kept = _distinct_ends(world, ends, config.kept)
    colored = _linearize(world, fine, kept.q).loss
    judge = getattr(fine.goal, "judge", None)
    loss = colored
    if judge is not None:
        loss = _linearize(world, dataclasses.replace(fine, goal=judge), kept.q).loss
    informed = kept.matrix - float(fine.prior) * np.eye(q.shape[1])
    return Polished(
        q=kept.q,
        loss=loss,
        colored_loss=colored,
        cost=np.where(kept.free, kept.cost, np.inf),
        uncertainty=joint_uncertainty(informed, polishing.threshold),
    )


def compile_polishing(world: World, polishing: Polishing) -> None:
    """Run every program of :func:`polish` once, at the start."""
    q = np.asarray(polishing.fine.q_start)[None]
    for goal in (polishing.coarse, polishing.fine):
        _in_batches(evaluate_cost, world, goal, q, EVALUATE_BATCH)
        _linearize(world, goal, q)
    if polishing.close_up is not None:
        near = _hand_goal(world, polishing.fine, polishing.close_up, q[0])[0]
        _linearize(world, near, q, CLOSE_UP_BATCH)


def _with_twins(
    world: World, goal: PriorGoal, ends: _GaussNewtonModel, config: PolishConfig
) -> _GaussNewtonModel:
    """The best of the ends and of the kinematic twins of the few best."""
    others = nearer_turns(world, twins(world, ends.q[:TWINNED]), np.asarray(goal.q_start))
    if not len(others):
        return ends
    found = _descend(lambda q, _: _linearize(world, goal, q), others, config.steps)
    both = [np.concatenate(columns) for columns in zip(ends, found, strict=True)]
    return _distinct_ends(world, _GaussNewtonModel(*both), config.kept)


def joint_uncertainty(matrix: np.ndarray, threshold: float) -> np.ndarray:
    """How far each joint may be off before the loss has risen by the threshold of a match.

    The other joints follow as they like best. What no pixel tells is uncertain by half a turn.

    Args:
        matrix: (n, D, D) of Gauss and Newton, half of the second derivatives of the loss.
        threshold: loss of a match.

    Returns:
        (n, D) [rad] or [m], at most pi.
    """
    # The least that a parabola rises if one joint moves by 1 is the inverse of this diagonal.
    joints = matrix.shape[-1]
    inverse = np.linalg.inv(matrix.astype(np.float64) + LEAST_TOLD * threshold * np.eye(joints))
    return np.minimum(np.sqrt(threshold * np.einsum("nii->ni", inverse)), np.pi)


def _distinct_ends(world: World, model: _GaussNewtonModel, num: int) -> _GaussNewtonModel:
    """At most num, the free ones first and by rising cost; of near ones only the first."""
    rows = distinct(world, model.q, np.lexsort([model.cost, ~model.free]), num)
    return model.take(rows)


def _turns_of_last_hinge(world: World, goal: PriorGoal, q: np.ndarray, num: int) -> np.ndarray:
    """The best (at most num, D) of configurations (H, D) and their minima over the last joint.

    Its turn is what images tell least: a gripper spins about its axis and hardly changes.
    """
    joints = q.shape[1]
    turn = 2 * np.pi / TURNS * np.arange(TURNS)
    around = (q[:, None] + turn[:, None] * np.eye(joints)[last_hinge(world)]).reshape(-1, joints)
    around = nearer_turns(world, around, np.asarray(goal.q_start))
    cost = _in_batches(evaluate_cost, world, goal, around, EVALUATE_BATCH)[0].reshape(-1, TURNS)
    # A turn is a minimum if both of its neighbors cost more; no turn at all is always one.
    is_minimum = (cost < np.roll(cost, 1, axis=1)) & (cost <= np.roll(cost, -1, axis=1))
    is_minimum[:, 0] = True
    order = np.argsort(np.where(is_minimum, cost, np.inf), axis=None, kind="stable")
    return around[order[: min(num, np.sum(is_minimum))]]


def _descend_close_up(
    world: World, polishing: Polishing, close_up: CloseUp, ends: _GaussNewtonModel
) -> _GaussNewtonModel:
    """Descend on the fine image and a close-up of the first end's hand together.

    The cost is the sum of both; the fine image's is taken for the parabola that it is around ends.
    """
    goal, threshold = _hand_goal(world, polishing.fine, close_up, ends.q[0])
    weight = polishing.threshold / threshold

    def linearize_both(q: np.ndarray, rows: np.ndarray) -> _GaussNewtonModel:
        near, own = _linearize(world, goal, q, CLOSE_UP_BATCH), ends.take(rows)
        step = steps_between(world, own.q, near.q)
        bent = np.einsum("nij,nj->ni", own.matrix, step)
        return near._replace(
            cost=own.cost + np.sum(step * (bent + 2 * own.slope), axis=1) + weight * near.loss,
            matrix=own.matrix + weight * near.matrix,
            slope=own.slope + bent + weight * near.slope,
        )

    return _descend(linearize_both, ends.q, polishing.config.steps)


def _hand_goal(
    world: World, fine: PriorGoal, close_up: CloseUp, q: np.ndarray
) -> tuple[PriorGoal, float]:
    """A close-up of the hand that a configuration (D,) has, and the loss of a match there."""
    whole = close_up.objective
    middle = np.asarray(_hand_px(world, whole.splats, whole.cameras, q))
    image, cameras = cut_goal(whole.image, whole.cameras, middle, close_up.px)
    # The fewer of its pixels are known, the less it says.
    known = max(float(np.mean(image.valid)), 1e-6)
    covered = float(np.mean(image.valid * image.alpha)) / known
    objective = dataclasses.replace(whole, image=image, cameras=cameras)
    goal = dataclasses.replace(fine, goal=objective, prior=jnp.float32(0))
    return goal, close_up.threshold * max(covered, LEAST_COVERED) / known


@host_jit
def _hand_px(world: World, splats: SplatModel, cameras: Camera, q: jax.Array) -> jax.Array:
    """Where (V, 2) the middle of the last link is in V views [px]."""
    last = splats.link == splats.link[-1]
    middle = jnp.sum(last[:, None] * splats.mean, axis=0) / jnp.sum(last)
    pose = link_poses(world.chain, q)[splats.link[-1]]
    return jax.vmap(project, (0, None))(cameras, pose[:3, :3] @ middle + pose[:3, 3])[0]


def _descend(
    linearize: Callable[[np.ndarray, np.ndarray], _GaussNewtonModel], q: np.ndarray, steps: int
) -> _GaussNewtonModel:
    """Levenberg-Marquardt: steps that lower the cost; those that do not raise the damping.

    A configuration whose steps hardly pay any more is left where it is.

    Args:
        linearize: the model around some of the configurations, given these and their indices.
        q: (n, D) where from.
        steps: at most so many.
    """
    now = linearize(q, np.arange(len(q)))
    damping, idle = np.full(len(now.q), 1e-3), np.zeros(len(now.q), int)
    for _ in range(steps):
        rows = np.flatnonzero(idle < IDLE_STEPS)
        if not len(rows):
            break
        # Solve the damped normal equations of every configuration that goes on.
        old = now.take(rows)
        diagonal = np.einsum("nii->ni", old.matrix)
        ridge = damping[rows, None] * diagonal + RIDGE
        matrix = old.matrix + ridge[:, :, None] * np.eye(now.q.shape[1])
        change = -np.linalg.solve(matrix, old.slope[..., None])[..., 0]
        tried = linearize(old.q + np.clip(change, -MAX_STEP, MAX_STEP), rows)
        # Take what is better; elsewhere go on from where it was, with shorter steps.
        better = tried.cost < old.cost
        damping[rows] *= np.where(better, 0.3, 4.0)
        idle[rows] = np.where(tried.cost < (1 - PAYS) * old.cost, 0, idle[rows] + 1)
        for column, new in zip(now, tried, strict=True):
            column[rows[better]] = new[better]
    return now


def _linearize(
    world: World, goal: PriorGoal, q: np.ndarray, size: int = LINEARIZE_BATCH
) -> _GaussNewtonModel:
    """The quadratic model around configurations (n, D)."""
    return _GaussNewtonModel(*_in_batches(linearize, world, goal, q, size))


def _in_batches(
    function: Callable, world: World, goal: PriorGoal, q: np.ndarray, size: int
) -> list[np.ndarray]:
    """Arrays (n, ...) about configurations (n, D), a few at a time: one program serves any n."""
    batches = -(-len(q) // size)
    padded = np.resize(q, (batches * size, q.shape[1])).astype(np.float32)
    found = map_on_threads(lambda batch: function(world, goal, batch), np.split(padded, batches))
    return [np.concatenate(column)[: len(q)] for column in zip(*found, strict=True)]


@host_jit
def evaluate_cost(world: World, goal: PriorGoal, q: jax.Array) -> tuple[jax.Array]:
    """The cost alone (n,), see :class:`_GaussNewtonModel`."""
    q = enforce_bounds(world, q)
    loss = map_lanes(lambda q: goal.goal.loss(world, q), q)
    away = difference(world, goal.q_start, q)
    return (loss + goal.prior * jnp.sum(away**2, axis=1),)


@host_jit
def linearize(world: World, goal: PriorGoal, q: jax.Array) -> tuple[jax.Array, ...]:
    """Columns of a :class:`_GaussNewtonModel`; derivatives are finite differences."""
    joints = q.shape[1]
    q = enforce_bounds(world, q)
    # Predictions of every configuration, and of the same with each joint moved a little.
    places = q[:, None] + FD_STEP * jnp.eye(joints + 1, joints, -1)
    seen = map_lanes(lambda q: goal.goal.prediction(world, q), places.reshape(-1, joints))
    seen = seen.reshape(len(q), joints + 1, -1)
    residual = seen[:, 0] - goal.goal.target()
    jacobian = (seen[:, 1:] - seen[:, :1]) / FD_STEP
    away = difference(world, goal.q_start, q)
    loss = jnp.sum(residual**2, axis=1)
    return (
        q,
        loss,
        loss + goal.prior * jnp.sum(away**2, axis=1),
        jnp.einsum("nip,njp->nij", jacobian, jacobian) + goal.prior * jnp.eye(joints),
        jnp.einsum("nip,np->ni", jacobian, residual) + goal.prior * away,
        jax.vmap(world.is_free)(q),
    )
