"""Least squares on the ends of a search: tell apart what a small image cannot.

Many configurations look nearly like the goal: half a turn of a gripper, another elbow, a wrist that
makes up for another. Each is a local minimum of the loss, which gradients do not leave. So samples
spread widely around the best nodes of a search: some joints move a little, or the outer joints,
which the image tells last, are drawn anew. The best descend by Levenberg-Marquardt. Then the best
settle on a larger image with more splats, which tells what the small one does not, and at last on a
close-up of the hand beside it, where half a turn becomes visible. What no image tells stays near
the start: a weak prior sees to that.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import PolishConfig
from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.scene.world import World, batch_is_free
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.images import cut_goal, mask_loss
from vrrt_jax.splat.types import Camera, SplatModel
from vrrt_jax.visual.distinct import distances_to, distinct
from vrrt_jax.visual.goal import CloseUp
from vrrt_jax.visual.least_squares import (
    PAYS,
    Ends,
    Objective,
    Parabola,
    derivatives,
    descend,
    evaluate_each,
    settle_each,
)
from vrrt_jax.visual.polish_samples import (
    half_turned,
    last_hinge,
    nearer_turns,
    redraw_outer,
    sample_around,
)
from vrrt_jax.visual.twins import twins

LEAST_TOLD = 1e-3  # of a threshold per rad^2; joints that raise the loss by less are not told
SETTLE_STEPS = 8  # at most, on the large images
PROMISING = 6.0  # times the least cost; ends that cost more, and do not match, are left
RIVALS = 2.0  # times the least cost; ends that cost more on the fine image are left
# Passes on fine image and close-up, after which an end that goes on to save as much of its cost in
# each as in the one before should cost no more than so many times the least.
FORESEEN, ALIKE = 16, 1.1
TWINNED = 2  # best ends whose kinematic twins, and half turns of the hand, are looked at
SAME_END = 0.1  # [rad] half turns of a hand, and twins, this near to an end are that end
BESIDE = (
    0.002,
    0.03,
)  # [rad] of a joint, how far beside an end in collision free ones are looked for
NUM_BESIDE = 512  # configurations that are looked at there
TURNS = 12  # in which the last joint goes all the way round
TURNED = 3  # times as many ends of these turns as are kept
HAND_ROUNDS = 8  # of looking for what looks like the best on the close-up, at most
HANDS, OUTER = 256, 4  # samples of a round, of which some of the last joints are drawn anew
HAND_SPREAD = 0.01  # [rad] of their other joints
HANDS_KEPT = 3  # of these settle
HAND_FITS, HAND_FAR = 2.0, 6.0  # thresholds; ends that cost less or more are left as they are
LEAST_COVERED = 0.01  # share of a close-up; a hand that is hidden tells nothing


@dataclasses.dataclass(frozen=True, kw_only=True)
class Polishing:
    """On which images configurations are polished, and how."""

    soft: Objective  # samples descend on this one, as the search does
    coarse: Objective  # the best of them settle on this one
    fine: Objective  # and on this one
    close_up: CloseUp | None  # and their hands at last here
    config: PolishConfig

    @property
    def arrays(self) -> Any:
        """A pytree of all that programs see of it."""
        close_up = self.close_up
        return self.soft, self.coarse, self.fine, None if close_up is None else close_up.objective

    @property
    def threshold(self) -> float:
        """Loss of a match on the fine image."""
        return float(self.fine.goal.threshold)

    @property
    def as_judged(self) -> "Polishing":
        """The same, where colors count as little as where it is judged what matches."""
        close_up = self.close_up
        if close_up is not None:
            close_up = dataclasses.replace(close_up, objective=close_up.objective.judge)
        coarse, fine = (
            dataclasses.replace(objective, goal=objective.goal.judge)
            for objective in (self.coarse, self.fine)
        )
        return dataclasses.replace(self, coarse=coarse, fine=fine, close_up=close_up)


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
    config, coarse, fine = polishing.config, polishing.coarse, polishing.fine
    searched, judged = fine, polishing.as_judged
    rng = np.random.default_rng(seed)
    ends = _search_around(world, polishing, q, rng)

    # From every minimum over a whole turn of the last joint, to the fine image.
    turned = _turns_of_last_hinge(world, coarse, ends.q, TURNED * config.kept)
    ends = _distinct_ends(world, _settled(world, coarse, turned), config.kept)
    ends = _settled(world, fine, _promising(ends, coarse).q)
    ends = _distinct_ends(world, ends, config.kept)
    others = nearer_turns(world, twins(world, ends.q[:TWINNED]), np.asarray(fine.prior.q))
    if len(others):
        ends = _distinct_ends(world, _joined(ends, _settled(world, fine, others)), config.kept)

    # In another light than that of training, shading would outweigh what tells poses apart.
    light_is_strange = ends.loss[0] > polishing.threshold and _matches(world, judged, ends.q[0])
    if light_is_strange:
        polishing, fine = judged, judged.fine
        ends = _distinct_ends(world, _settled(world, fine, ends.q), config.kept)

    # Once more the best, where derivatives are those of the minimum.
    ends = ends.take(ends.cost <= RIVALS * ends.cost[0])
    if polishing.close_up is None:
        ends = _distinct_ends(world, _settled(world, fine, ends.q), config.kept)
    else:
        ends = _settled_with_hand(world, polishing, polishing.close_up, ends, rng)
    ends = _freed(world, fine, ends, seed)
    ends = ends.take(np.lexsort([ends.cost, ~ends.free]))
    loss, colored_loss = evaluate_each(world, judged.fine, ends.q)[0], ends.loss
    if light_is_strange:
        colored_loss = evaluate_each(world, searched, ends.q)[0]
    informed = ends.matrix - np.asarray(fine.prior.matrix)
    return Polished(
        q=ends.q,
        loss=loss,
        colored_loss=colored_loss,
        cost=np.where(ends.free, ends.cost, np.inf),
        uncertainty=joint_uncertainty(informed, polishing.threshold),
    )


def _matches(world: World, polishing: Polishing, q: np.ndarray) -> bool:
    """Whether a configuration (D,) does on the fine image."""
    return bool(evaluate_each(world, polishing.fine, q[None])[0][0] <= polishing.threshold)


def compile_polishing(world: World, polishing: Polishing) -> None:
    """Run every program that :func:`polish` always needs once, at the start."""
    soft, coarse, fine = polishing.soft, polishing.coarse, polishing.fine
    q = np.asarray(fine.prior.q)[None]
    derivatives(world, soft, q)
    for goal in (soft, coarse, fine):
        evaluate_each(world, goal, q)
    for goal in (coarse, fine):
        settle_each(world, [goal], q, 0)
    if polishing.close_up is not None:
        derivatives(world, fine, q)
        near = _hand_goal(world, fine, polishing.close_up, q[0])[0]
        settle_each(world, [near], q, 0)


def _search_around(
    world: World, polishing: Polishing, q: np.ndarray, rng: np.random.Generator
) -> Ends:
    """Distinct ends on small images: sample, descend, settle."""
    config, soft, coarse = polishing.config, polishing.soft, polishing.coarse
    around = sample_around(world, q, config.samples, config.spread, rng)
    samples = np.concatenate([around, redraw_outer(world, q, config.samples, rng)])
    samples = nearer_turns(world, samples, np.asarray(soft.prior.q))
    cost = evaluate_each(world, soft, samples)[1]
    best = samples[np.argsort(cost, kind="stable")[: config.lanes]]
    ends = _distinct_ends(world, descend(world, soft, best, config.steps), config.kept)
    return _distinct_ends(world, _settled(world, coarse, ends.q), config.kept)


def _promising(ends: Ends, objective: Objective) -> Ends:
    """Those that match, or that cost little more than the best."""
    enough = max(PROMISING * ends.cost[0], float(objective.goal.threshold))
    return ends.take(ends.cost <= enough)


def _settled(world: World, objective: Objective, q: np.ndarray) -> Ends:
    return settle_each(world, [objective] * len(q), q, SETTLE_STEPS)


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


def _distinct_ends(world: World, ends: Ends, num: int) -> Ends:
    """At most num, by rising cost, free or not; of near ones only the first."""
    return ends.take(distinct(world, ends.q, np.argsort(ends.cost, kind="stable"), num))


def _turns_of_last_hinge(world: World, objective: Objective, q: np.ndarray, num: int) -> np.ndarray:
    """The best (at most num, D) of configurations (H, D) and their minima over the last joint.

    Its turn is what images tell least: a gripper spins about its axis and hardly changes.
    """
    joints = q.shape[1]
    turn = 2 * np.pi / TURNS * np.arange(TURNS)
    around = (q[:, None] + turn[:, None] * np.eye(joints)[last_hinge(world)]).reshape(-1, joints)
    around = nearer_turns(world, around, np.asarray(objective.prior.q))
    cost = evaluate_each(world, objective, around)[1].reshape(-1, TURNS)
    # A turn is a minimum if both of its neighbors cost more; no turn at all is always one.
    is_minimum = (cost < np.roll(cost, 1, axis=1)) & (cost <= np.roll(cost, -1, axis=1))
    is_minimum[:, 0] = True
    order = np.argsort(np.where(is_minimum, cost, np.inf), axis=None, kind="stable")
    return around[order[: min(num, np.sum(is_minimum))]]


def _joined(ends: Ends, others: Ends) -> Ends:
    return Ends(*(np.concatenate(columns) for columns in zip(ends, others, strict=True)))


def _settled_with_hand(
    world: World,
    polishing: Polishing,
    close_up: CloseUp,
    ends: Ends,
    rng: np.random.Generator,
) -> Ends:
    """Settle on fine image and close-up of the hand; so does what looks like the best.

    That is: its half turn and twins, and where it fits, but not well, the best of those whose outer
    joints are drawn anew. If one of these costs less, what looks like that one is looked at next.
    """
    fine, kept = polishing.fine, polishing.config.kept
    goal, threshold = _hand_goal(world, fine, close_up, ends.q[0])
    weight = polishing.threshold / threshold
    ends = _distinct_ends(world, _settled_together(world, fine, goal, weight, ends), kept)
    fits_badly = HAND_FITS < ends.cost[0] / polishing.threshold < HAND_FAR
    tried = ends.q
    for _ in range(HAND_ROUNDS):
        best = ends.q[:TWINNED]
        others = [half_turned(world, best), twins(world, best)]
        if fits_badly:
            drawn = redraw_outer(world, best[:1], HANDS, rng, joints=OUTER, spread=HAND_SPREAD)
            cost = evaluate_each(world, polishing.coarse, drawn)[1]
            cost += weight * evaluate_each(world, goal, drawn)[0]
            order = np.argsort(cost, kind="stable")
            others.append(drawn[distinct(world, drawn, order, HANDS_KEPT)])
        others = nearer_turns(world, np.concatenate(others), np.asarray(fine.prior.q))
        known = np.concatenate([tried, ends.q])
        others = others[[np.min(distances_to(world, known, q)) > SAME_END for q in others]]
        if len(others):
            tried = np.concatenate([tried, others])
            others = derivatives(world, fine, others)
            others = _settled_together(world, fine, goal, weight, others, ends.cost[0])
            ends = _distinct_ends(world, _joined(ends, others), kept)
        if np.array_equal(ends.q[0], best[0]):
            break
    return ends


def _settled_together(
    world: World,
    fine: Objective,
    goal: Objective,
    weight: float,
    ends: Ends,
    least: float = np.inf,
) -> Ends:
    """Settle on the fine image and another one, which has a weight, together.

    The cost is the sum of both. In each pass the fine image's is taken for the parabola that it is
    around the ends of the one before; a hand slides farther than that holds. Ends go on while that
    pays, and while they cost little more than the best, or would not if they went on like this.

    Args:
        world: robot and obstacles.
        fine: the fine image.
        goal: the other image.
        weight: of that one.
        ends: where to begin, with derivatives on the fine image.
        least: cost of the best end so far.
    """
    goal = dataclasses.replace(goal, weight=jnp.float32(weight))
    rows, done = np.arange(len(ends.q)), ends._replace(cost=np.full(len(ends.q), np.inf))
    while len(rows):
        around = [
            dataclasses.replace(goal, prior=Parabola(q=q, cost=cost, slope=slope, matrix=matrix))
            for q, _, cost, slope, matrix, _ in zip(*ends, strict=True)
        ]
        close = settle_each(world, around, ends.q, SETTLE_STEPS)
        ends = derivatives(world, fine, close.q)
        both = ends._replace(cost=ends.cost + weight * close.loss, matrix=close.matrix)
        pays = both.cost < (1 - PAYS) * done.cost[rows]
        pays &= both.cost < RIVALS * np.min(both.cost)
        least = min(least, np.min(both.cost))
        foreseen = both.cost * np.minimum(both.cost / done.cost[rows], 1.0) ** FORESEEN
        pays &= foreseen < ALIKE * least
        better = both.cost < done.cost[rows]
        for column, new in zip(done, both, strict=True):
            column[rows[better]] = new[better]
        rows, ends = rows[pays], ends.take(pays)
    return done


def _freed(world: World, fine: Objective, ends: Ends, seed: int) -> Ends:
    """The same, but those in collision give way to free ones right beside them, if there are any.

    A robot that touches something at its goal, such as one that grasps, is hardly ever seen so well
    that its estimate touches nothing. Of free samples the one that costs least is taken, by the
    parabola around the end.
    """
    rng, ends = np.random.default_rng(seed), Ends(*(np.array(column) for column in ends))
    for row in np.flatnonzero(~ends.free):
        scale = BESIDE[0] * (BESIDE[1] / BESIDE[0]) ** rng.uniform(size=(NUM_BESIDE, 1))
        change = scale * rng.normal(size=(NUM_BESIDE, ends.q.shape[1]))
        q = np.asarray(enforce_bounds(world, jnp.asarray(ends.q[row] + change, jnp.float32)))
        more = np.einsum("ni,ij,nj->n", change, ends.matrix[row], change)
        is_free = np.asarray(batch_is_free(world, q))
        if np.any(is_free):
            best = int(np.argmin(np.where(is_free, more, np.inf)))
            ends.q[row], ends.free[row] = q[best], True
            ends.cost[row] += more[best]
            ends.loss[row] = evaluate_each(world, fine, q[best : best + 1])[0][0]
    return ends


def _hand_goal(
    world: World, fine: Objective, close_up: CloseUp, q: np.ndarray
) -> tuple[Objective, float]:
    """A close-up of the hand that a configuration (D,) has, and the loss of a match there."""
    whole = close_up.objective
    middle = np.asarray(_hand_px(world, whole.splats, whole.cameras, q))
    image, cameras = cut_goal(whole.image, whole.cameras, middle, close_up.px)
    # The fewer of its pixels are known, the less it says.
    known = max(float(np.mean(image.valid)), 1e-6)
    covered = float(np.mean(image.valid * image.alpha)) / known
    goal = dataclasses.replace(whole, image=image, cameras=cameras)
    objective = dataclasses.replace(fine, goal=goal)
    expected = close_up.threshold * max(covered, LEAST_COVERED) / known
    expected += mask_loss(image, close_up.outline_error_px)
    return objective, close_up.match_scale * expected


@host_jit
def _hand_px(world: World, splats: SplatModel, cameras: Camera, q: jax.Array) -> jax.Array:
    """Where (V, 2) the middle of the last link is in V views [px]."""
    last = splats.link == splats.link[-1]
    middle = jnp.sum(last[:, None] * splats.mean, axis=0) / jnp.sum(last)
    pose = link_poses(world.chain, q)[splats.link[-1]]
    return jax.vmap(project, (0, None))(cameras, pose[:3, :3] @ middle + pose[:3, 3])[0]
