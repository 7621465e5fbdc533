"""From a grown tree to a result: choose where to end, join that to the tree, shorten and verify."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core import tree as trees
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.result import EARLY_STOPS, PlanResult, Status, with_time_of
from vrrt_jax.core.search import SearchResult, StopReason
from vrrt_jax.core.timing import timed
from vrrt_jax.core.types import ExpansionPolicy
from vrrt_jax.outcome import Chosen, finish, time_left
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World, checked_more_finely, with_margin
from vrrt_jax.visual.certainty import match_probability
from vrrt_jax.visual.distinct import distances_to, distinct
from vrrt_jax.visual.join import Way, connect, join
from vrrt_jax.visual.least_squares import evaluate, linearize, settle
from vrrt_jax.visual.lineages import LineageRRT
from vrrt_jax.visual.policy import VisualRRT
from vrrt_jax.visual.polish import Polished, polish
from vrrt_jax.visual.problem import VisualProblem

MAX_GOALS = 3  # matched configurations that are tried before there is no path
MAX_REPLANS = 3  # paths that the exact check may refuse before it has the last word
MARGIN_STEP = 0.01  # [m] by which each of them keeps farther away than the one before
UNTOLD = 0.3  # [rad] or [m] joints that may be off by more are named
# A near match is likelier: goals are taken to be as dense as distance ** -joints, which favors no
# scale. A factor of e in density is worth as much as a cost that is lower by this share.
NEARNESS = 0.03
TINY = 1e-6  # share of a threshold; costs below that are equal
NEAR = 0.1  # [rad] all that are nearer are as likely
SAME_LOSS = 1.05  # losses within this factor are the same match


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ends:
    """Configurations that a path may end at."""

    q: np.ndarray  # (n, D)
    loss: np.ndarray  # (n,)
    colored_loss: np.ndarray  # (n,) see PlanResult
    cost: np.ndarray  # (n,) which tells apart those that look alike
    order: list[int]  # which to try, the best first
    rivals: list[int]  # which of them are worth naming beside the one that is taken
    paths: dict[int, np.ndarray]  # (P, D) by end, where the tree has one
    threshold: float  # loss of a match
    uncertainty: np.ndarray | None  # (n, D) how far off each joint may be, where that is known


def finish_visual(
    robot: Robot,
    world: World,
    problem: VisualProblem,
    policy: ExpansionPolicy,
    found: SearchResult,
    q_start: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
) -> PlanResult:
    """Choose where to end, find a path there, shorten and verify it.

    Args:
        robot: whose path it is.
        world: robot and obstacles.
        problem: the goal at every resolution.
        policy: the planner.
        found: the search.
        q_start: (D,).
        key: random key.
        config: settings.
    """
    search_threshold = float(problem.goal.threshold)
    found, ends = _choose_ends(world, problem, policy, found, q_start, key, config)
    stopped = found.stopped

    connector = RRTConnect.for_world(world, lanes=config.tree.lanes)
    # Try the ends in turn, until the tree leads to one.
    way, end = None, ends.order[0]
    all_collide = not np.isfinite(ends.cost[end])
    for candidate in [] if all_collide else ends.order[:MAX_GOALS]:
        if candidate in ends.paths:
            way = Way(path=ends.paths[candidate], tree_share=1.0)
        else:
            found, way = join(world, connector, found, ends.q[candidate], key, config)
        if way is not None:
            end = candidate
        if way is not None or found.stopped in EARLY_STOPS:
            break
    target, loss = ends.q[end], float(ends.loss[end])
    if loss > ends.threshold and found.stopped is StopReason.TIME_LIMIT:
        # The match was missed before the time was up on the way to what is none.
        found = dataclasses.replace(found, stopped=stopped)
    chosen = _chosen(way, target, loss, ends.threshold)
    result = finish(robot, world, found, chosen, q_start, key, config)

    # A path that the exact check refuses is sought again, farther away from obstacles, with edges
    # that are checked more finely.
    for again in range(1, MAX_REPLANS):
        if result.status is not Status.NOT_VERIFIED:
            break
        key = jax.random.fold_in(key, again)
        idle = dataclasses.replace(found, compile_s=0.0, search_s=0.0)
        rest = time_left(config, result.timing["search_s"])
        farther = checked_more_finely(with_margin(world, again * MARGIN_STEP))
        other, way = connect(farther, connector, idle, target, key, rest)
        chosen = _chosen(way, target, loss, ends.threshold)
        other = finish(robot, farther, other, chosen, q_start, key, config)
        other = dataclasses.replace(other, expansions=0)  # of the same search
        result = with_time_of(other if other.ok else result, result, other)

    matching = [k for k in ends.rivals if ends.loss[k] <= ends.threshold]
    as_good = config.match.ambiguity * ends.cost[end]
    alike = [k for k in matching if k != end and ends.cost[k] <= as_good]
    if result.status is Status.NO_PATH and all_collide:
        advice = "all that was found is in collision: move the obstacles"
        result = dataclasses.replace(result, advice=advice)
    uncertainty = None if ends.uncertainty is None else ends.uncertainty[end]
    if result.ok and uncertainty is not None:
        result = dataclasses.replace(result, advice=_untold(robot, uncertainty))
    probability = float("nan")
    if uncertainty is not None and np.isfinite(ends.cost[end]):
        losses = loss, float(ends.colored_loss[end])
        probability = match_probability(*losses, ends.threshold, ends.cost, end, uncertainty)
    return dataclasses.replace(
        result,
        match_probability=probability,
        colored_loss=float(ends.colored_loss[end]),
        alternatives=ends.q[alike],
        joint_uncertainty=uncertainty,
        search_match_threshold=search_threshold,
    )


def _untold(robot: Robot, uncertainty: np.ndarray) -> str:
    """What to do about joints that the image hardly tells, "" if there are none."""
    joints = [
        f"{name} by {off:.2g}"
        for name, off in zip(robot.joint_names, uncertainty, strict=True)
        if off > UNTOLD
    ]
    if not joints:
        return ""
    return f"the image hardly tells all joints (may be off: {', '.join(joints)}): add a view"


def _chosen(way: Way | None, target: np.ndarray, loss: float, threshold: float) -> Chosen:
    path, share = (None, 0.0) if way is None else (way.path, way.tree_share)
    return Chosen(path=path, target=target, loss=loss, threshold=threshold, tree_share=share)


def _choose_ends(
    world: World,
    problem: VisualProblem,
    policy: ExpansionPolicy,
    found: SearchResult,
    q_start: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
) -> tuple[SearchResult, Ends]:
    """The ends of a search, polished if there is time; that time is added to the search's."""
    score, q = np.asarray(found.tree.score), np.asarray(found.tree.q)
    threshold, polishing = float(problem.goal.threshold), problem.polishing
    ended_early = found.stopped in EARLY_STOPS
    if polishing is not None and not ended_early:
        nodes = _best_nodes(world, score, q, q_start, config.polish.hypotheses, np.inf)
        seed = int(jax.random.bits(key, dtype=jnp.uint32))
        polished, compile_s, polish_s = timed(
            lambda: polish(world, polishing, q[nodes], seed), evaluate, linearize, settle
        )
        found = dataclasses.replace(
            found, compile_s=found.compile_s + compile_s, search_s=found.search_s + polish_s
        )
        return found, _polished_ends(world, polished, polishing.threshold, q_start, config)
    if ended_early and score.min() > threshold:
        # Nothing matches: the best node that a path leads to.
        score = np.where(np.asarray(found.tree.cost) < trees.UNREACHED, score, np.inf)
    order = _best_nodes(world, score, q, q_start, MAX_GOALS, threshold)
    paths = {end: trees.branch_path(found.tree, end) for end in order}
    paths = {end: path for end, path in paths.items() if np.array_equal(path[0], q_start)}
    # Scores of planners to images are losses, but those of a match are judged otherwise.
    goal, loss = problem.goal, score.copy()
    judge = getattr(goal, "judge", goal)
    if judge is not goal or not isinstance(policy, VisualRRT | LineageRRT):
        loss[order] = [float(judge.loss(world, jnp.asarray(q[end]))) for end in order]
    # On a small image even neighbors look the same: there are no rivals to name.
    return found, Ends(
        q=q,
        loss=loss,
        colored_loss=score,
        cost=score,
        order=order,
        rivals=[],
        paths=paths,
        threshold=threshold,
        uncertainty=None,
    )


def _polished_ends(
    world: World,
    polished: Polished,
    threshold: float,
    q_start: np.ndarray,
    config: PlannerConfig,
) -> Ends:
    """Polished configurations in the order in which they are tried."""
    # A match goes before all others; those that look the same are weighed by their distances.
    fits = polished.loss <= threshold
    least = np.min(polished.cost, where=fits, initial=np.inf)
    alike = fits & (polished.cost <= config.match.ambiguity * least)
    far = np.maximum(distances_to(world, polished.q, q_start), NEAR)
    sparsity = len(q_start) * np.log(far)
    weighed = np.log(np.maximum(polished.cost, TINY * threshold)) + NEARNESS * sparsity
    order = np.lexsort([np.where(alike, weighed, polished.cost), ~alike, ~fits])
    rivals = [int(k) for k in order if np.isfinite(polished.cost[k])]
    matched = [k for k in rivals if polished.loss[k] <= threshold]
    return Ends(
        q=polished.q,
        loss=polished.loss,
        colored_loss=polished.colored_loss,
        cost=polished.cost,
        order=matched or rivals or [int(np.argmin(polished.loss))],  # the last: all collide
        rivals=rivals,
        paths={},
        threshold=threshold,
        uncertainty=polished.uncertainty,
    )


def _best_nodes(
    world: World,
    score: np.ndarray,
    q: np.ndarray,
    q_start: np.ndarray,
    num: int,
    threshold: float,
) -> list[int]:
    """Distinct nodes: as good as the best, nearest to the start first; then other matches."""

    def nearest_of_the_best(candidates: np.ndarray) -> int:
        # Nodes just under the threshold would be nearer still, but only as they are not there yet.
        equal = candidates[score[candidates] <= SAME_LOSS * score[candidates].min()]
        return int(equal[np.argmin(distances_to(world, q[equal], q_start))])

    matching = np.flatnonzero(np.isfinite(score) & (score <= max(threshold, score.min())))
    return distinct(world, q, matching, num, nearest_of_the_best)
