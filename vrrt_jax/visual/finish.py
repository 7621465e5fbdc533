"""From a grown tree to a result: choose where to end, find a path there, shorten and verify it."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core import tree as trees
from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.edges import free_prefix
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.result import EARLY_STOPS, PlanResult, Status, with_time_of
from vrrt_jax.core.search import SearchResult, StopReason, make_termination, search
from vrrt_jax.core.timing import timed
from vrrt_jax.core.types import ExpansionPolicy
from vrrt_jax.outcome import Chosen, finish, time_left
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.verify import verify_path
from vrrt_jax.scene.world import World, checked_more_finely, with_margin
from vrrt_jax.visual.distinct import distances_to, distinct
from vrrt_jax.visual.policy import VisualRRT
from vrrt_jax.visual.polish import Polished, evaluate_cost, linearize, polish
from vrrt_jax.visual.problem import VisualProblem

MAX_GOALS = 3  # matched configurations that are tried before there is no path
MAX_REPLANS = 3  # paths that the exact check may refuse before it has the last word
MARGIN_STEP = 0.01  # [m] by which each of them keeps farther away than the one before
SWEEP_STEP = 0.02  # [rad] between configurations of a straight line that is tried
SWEEP_MARGIN = 0.002  # [m] that it keeps away: what links move between two of the last check
SAME_LOSS = 1.05  # losses within this factor are the same match
AMBIGUITY_RATIO = 1.1  # and within this factor the image does not tell which it is


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ends:
    """Configurations that a path may end at."""

    q: np.ndarray  # (n, D)
    loss: np.ndarray  # (n,)
    cost: np.ndarray  # (n,) which tells apart those that look alike
    order: list[int]  # which to try, the best first
    rivals: list[int]  # which of them are worth naming beside the one that is taken
    paths: dict[int, np.ndarray]  # (P, D) by end, where the tree has one
    threshold: float  # loss of a match


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
    # Try the ends in turn: by the tree's own path, straight, or by RRT-Connect.
    path, end, refused = None, ends.order[0], 0
    all_collide = not np.isfinite(ends.cost[end])
    for candidate in [] if all_collide else ends.order[:MAX_GOALS]:
        path = ends.paths.get(candidate)
        if path is None:
            found, path, is_refused = _straight(robot, world, found, q_start, ends.q[candidate])
            refused += is_refused
        if path is None:
            goal = ends.q[candidate]
            found, path = _connect(world, connector, found, q_start, goal, key, config)
        if path is not None:
            end = candidate
        if path is not None or found.stopped in EARLY_STOPS:
            break
    target, loss = ends.q[end], float(ends.loss[end])
    if loss > ends.threshold and found.stopped is StopReason.TIME_LIMIT:
        # The match was missed before the time was up on the way to what is none.
        found = dataclasses.replace(found, stopped=stopped)
    chosen = Chosen(path=path, target=target, loss=loss, threshold=ends.threshold)
    result = finish(robot, world, found, chosen, q_start, key, config)
    result = dataclasses.replace(result, refused=result.refused + refused)

    # A path that the exact check refuses is sought again, farther away from obstacles, with edges
    # that are checked more finely.
    for again in range(1, MAX_REPLANS):
        if result.status is not Status.NOT_VERIFIED:
            break
        key = jax.random.fold_in(key, again)
        idle = dataclasses.replace(found, compile_s=0.0, search_s=0.0)
        rest = time_left(config, result.timing["search_s"])
        farther = checked_more_finely(with_margin(world, again * MARGIN_STEP))
        other, path = _connect(farther, connector, idle, q_start, target, key, rest)
        chosen = dataclasses.replace(chosen, path=path)
        other = finish(robot, farther, other, chosen, q_start, key, config)
        other = dataclasses.replace(other, expansions=0)  # of the same search
        result = with_time_of(other if other.ok else result, result, other)

    matching = [k for k in ends.rivals if ends.loss[k] <= ends.threshold]
    alike = [k for k in matching if k != end and ends.cost[k] <= AMBIGUITY_RATIO * ends.cost[end]]
    if result.status is Status.NO_PATH and all_collide:
        advice = "all that was found is in collision: move the obstacles"
        result = dataclasses.replace(result, advice=advice)
    return dataclasses.replace(
        result, alternatives=ends.q[alike], search_match_threshold=search_threshold
    )


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
            lambda: polish(world, polishing, q[nodes], seed), evaluate_cost, linearize
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
    loss = score
    if not isinstance(policy, VisualRRT):  # whose scores are losses
        loss = score.copy()
        loss[order] = [float(problem.goal.loss(world, jnp.asarray(q[end]))) for end in order]
    # On a small image even neighbors look the same: there are no rivals to name.
    return found, Ends(
        q=q,
        loss=loss,
        cost=score,
        order=order,
        rivals=[],
        paths=paths,
        threshold=threshold,
    )


def _polished_ends(
    world: World,
    polished: Polished,
    threshold: float,
    q_start: np.ndarray,
    config: PlannerConfig,
) -> Ends:
    """Polished configurations in the order in which they are tried."""
    # Of two that look alike, the nearer to the start is likelier; a match goes before all others.
    far = distances_to(world, polished.q, q_start) ** 2
    preference = polished.cost * (1.0 + config.match.start_preference * far)
    order = np.lexsort([preference, polished.loss > threshold])
    rivals = [int(k) for k in order if np.isfinite(polished.cost[k])]
    matched = [k for k in rivals if polished.loss[k] <= threshold]
    return Ends(
        q=polished.q,
        loss=polished.loss,
        cost=polished.cost,
        order=matched or rivals or [int(np.argmin(polished.loss))],  # the last: all collide
        rivals=rivals,
        paths={},
        threshold=threshold,
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


def _straight(
    robot: Robot, world: World, found: SearchResult, q_start: np.ndarray, q_goal: np.ndarray
) -> tuple[SearchResult, np.ndarray | None, bool]:
    """The straight path (2, D) if it is free, and whether the exact check refused it.

    The time for the check is added to the search's. The exact check judges, which also grants what
    the covering spheres refuse. A world with an ``is_free`` of its own is asked as well.
    """
    exact_scene(robot, world)  # built once, and no part of any search
    started = time.perf_counter()
    path = np.stack([q_start, q_goal])
    seen = verify_path(robot, world, path, step=SWEEP_STEP, measure_clearance=True)
    clear = seen.ok and not seen.clearance < world.margin + SWEEP_MARGIN
    if clear and overrides_is_free(world):
        edge = world.edge(jnp.asarray(path[:1]), jnp.asarray(path[1:]))
        steps = max(int(np.ceil(float(world.span(edge)[0] / world.resolution))), 1)
        clear = int(free_prefix(world, jnp.asarray(path[:1]), edge, steps)[0]) == steps
    spent_s = time.perf_counter() - started
    found = dataclasses.replace(found, search_s=found.search_s + spent_s)
    return found, path if clear else None, not seen.ok


def _connect(
    world: World,
    policy: RRTConnect,
    found: SearchResult,
    q_start: np.ndarray,
    q_goal: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
) -> tuple[SearchResult, np.ndarray | None]:
    """A path (P, D) by RRT-Connect, if there is one; its time is added to the search's.

    If time is up meanwhile, or the user interrupts, the search has stopped for that.
    """
    goal = ConfigurationGoal(q=jnp.asarray(q_goal))
    connection = search(
        world,
        goal,
        policy,
        policy.init(world, goal, q_start[None], config.tree.capacity),
        key=key,
        termination=make_termination(
            policy.goal_score(goal), max_iterations=config.budget.connect_iterations
        ),
        time_limit_s=time_left(config, found.search_s).budget.time_limit_s,
        max_capacity=config.tree.max_capacity,
    )
    found = dataclasses.replace(
        found,
        stopped=connection.stopped if connection.stopped in EARLY_STOPS else found.stopped,
        compile_s=found.compile_s + connection.compile_s,
        search_s=found.search_s + connection.search_s,
    )
    return found, policy.extract_path(connection.tree)
