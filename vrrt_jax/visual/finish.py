"""From a grown tree to a verified path."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import PlannerConfig, PlanResult
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import unwrapped
from vrrt_jax.core.planners.rrt import tree_path
from vrrt_jax.core.planners.rrt_connect import RRTConnect, connection_path
from vrrt_jax.core.search import SearchResult, StopReason, make_termination, search
from vrrt_jax.core.shortcut import path_length, shortcut
from vrrt_jax.core.types import Rejection, Status
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.verify import verify_path
from vrrt_jax.scene.world import World, obstacle_list, with_margin
from vrrt_jax.visual.polish import DISTINCT, Polishing, apart, glance, look_at, polish

STATUS_OF = {
    StopReason.CONVERGED: Status.NO_MATCH,
    StopReason.ITERATIONS: Status.MAX_ITERATIONS,
    StopReason.TREE_FULL: Status.TREE_FULL,
    StopReason.TIME_LIMIT: Status.TIME_LIMIT,
    StopReason.INTERRUPTED: Status.INTERRUPTED,
}
HURRIED = (StopReason.TIME_LIMIT, StopReason.INTERRUPTED)  # what ends these, ends all
TRIED = 3  # matched configurations that are tried before there is no path
REFUSED = 3  # paths that the exact check may refuse before it has the last word
WARY = 0.01  # [m] by which each of them keeps farther away than the one before
GLANCE = 0.02  # [rad] between configurations of a straight line that is tried
GRAZE = 0.002  # [m] that it keeps away: what links move between configurations of the last check
SAME_LOSS = 1.05  # losses within this factor are the same match
ALIKE = 1.1  # and within this factor the image does not tell which it is


def finish_visual(
    robot: Robot,
    world: World,
    found: SearchResult,
    goal_loss: float,
    polishing: Polishing | None,
    q_start: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
) -> PlanResult:
    """Choose where to end, find a way there, shorten and verify it.

    Args:
        robot: whose path it is.
        world: robot and obstacles.
        found: the search.
        goal_loss: that counts as matched in it.
        polishing: how to look at matches more closely.
        q_start: (D,).
        key: random key.
        config: settings.
    """
    score, q = np.asarray(found.tree.score), np.asarray(found.tree.q)
    search_goal_loss = goal_loss
    hurried = found.stopped in HURRIED
    if polishing is not None and not hurried:
        goal_loss = polishing.goal_loss
        nodes = list(_distinct(world, score, q, q_start, config.hypotheses, np.inf))
        found, (q, score, cost) = _polished(found, world, polishing, q[nodes], key)
        far = apart(world, q, q_start) ** 2  # of two that look alike, the nearer is likelier
        order = np.lexsort([cost * (1.0 + config.start_preference * far), score > goal_loss])
        rivals = [int(k) for k in order if np.isfinite(cost[k])] or [0]
        ends = [k for k in rivals if score[k] <= goal_loss] or rivals
        paths = {}
    else:
        if hurried and score.min() > goal_loss:  # nothing matches: the best that a path leads to
            score = np.where(np.asarray(found.tree.cost) < trees.UNREACHED, score, np.inf)
        ends = list(_distinct(world, score, q, q_start, TRIED, goal_loss))
        paths = {end: tree_path(found.tree, end) for end in ends}
        paths = {end: path for end, path in paths.items() if np.array_equal(path[0], q_start)}
        rivals, cost = [], score  # on a small image even neighbors look the same
    for end in ends[:TRIED]:
        path = paths.get(end)
        if path is None:
            found, path = _straight(robot, world, found, q_start, q[end])
        if path is None:
            found, path = _connected(world, found, q_start, q[end], key, config)
        if path is not None or found.stopped in HURRIED:
            break
    if path is None:
        end = ends[0]
    target, loss = q[end], float(score[end])
    matching = [k for k in rivals if score[k] <= goal_loss]
    alike = [k for k in matching if k != end and cost[k] <= ALIKE * cost[end]]
    result = finish(robot, world, found, path, target, loss, goal_loss, key, config, q_start)
    for again in range(1, REFUSED):
        if result.status is not Status.NOT_VERIFIED:
            break
        key = jax.random.fold_in(key, again)
        idle = dataclasses.replace(found, compile_s=0.0, search_s=0.0)
        rest = time_left(config, result.timing["search_s"])
        wary = with_margin(world, again * WARY)
        other, path = _connected(wary, idle, q_start, target, key, rest)
        other = finish(robot, wary, other, path, target, loss, goal_loss, key, config, q_start)
        result = with_time_of(other if other.ok else result, result, other)
    return dataclasses.replace(result, alternatives=q[alike], search_goal_loss=search_goal_loss)


def _distinct(
    world: World,
    score: np.ndarray,
    q: np.ndarray,
    q_start: np.ndarray,
    most: int,
    goal_loss: float,
) -> Iterator[int]:
    """Where to end: as good as the best, nearest to the start first; then other matches."""
    open_nodes = np.flatnonzero(np.isfinite(score) & (score <= max(goal_loss, score.min())))
    for _ in range(most):
        if len(open_nodes) == 0:
            return
        # Nodes just under the bar would be nearer still, but only as they are not there yet.
        equal = open_nodes[score[open_nodes] <= SAME_LOSS * score[open_nodes].min()]
        best = int(equal[np.argmin(apart(world, q[equal], q_start))])
        yield best
        open_nodes = open_nodes[apart(world, q[open_nodes], q[best]) > DISTINCT]


def _straight(
    robot: Robot, world: World, found: SearchResult, q_start: np.ndarray, q_goal: np.ndarray
) -> tuple[SearchResult, np.ndarray | None]:
    """The straight path (2, D) if it is free; the time for the check is added to the search's.

    The exact check judges, which also grants what the covering spheres refuse.
    """
    obstacles = obstacle_list(world)
    exact_scene(robot, obstacles)  # built once, and no part of any search
    started = time.perf_counter()
    path = np.stack([q_start, q_goal])
    seen = verify_path(robot, obstacles, path, step=GLANCE)
    clear = seen.ok and not seen.clearance < world.margin + GRAZE
    spent_s = time.perf_counter() - started
    found = dataclasses.replace(found, search_s=found.search_s + spent_s)
    return found, path if clear else None


def _connected(
    world: World,
    found: SearchResult,
    q_start: np.ndarray,
    q_goal: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
) -> tuple[SearchResult, np.ndarray | None]:
    """A path (P, D) by RRT-Connect, if there is one; its time is added to the search's.

    If time is up meanwhile, or the user interrupts, the search has stopped for that.
    """
    policy = RRTConnect(lanes=config.lanes)
    tree = policy.forest(jnp.asarray(q_start), jnp.asarray(q_goal), config.capacity)
    stop = make_termination(0.0, max_iterations=config.connect_iterations)
    limit_s = time_left(config, found.search_s).time_limit_s
    connection = search(world, policy, tree, key=key, stop=stop, time_limit_s=limit_s)
    found = dataclasses.replace(
        found,
        stopped=connection.stopped if connection.stopped in HURRIED else found.stopped,
        compile_s=found.compile_s + connection.compile_s,
        search_s=found.search_s + connection.search_s,
    )
    return found, connection_path(connection.tree)


def _polished(
    found: SearchResult, world: World, polishing: Polishing, q: np.ndarray, key: jax.Array
) -> tuple[SearchResult, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What :func:`polish` returns; its time is added to the search's."""
    seed = int(jax.random.bits(key, dtype=jnp.uint32))
    result, compile_s, polish_s = timed(lambda: polish(world, polishing, q, seed), glance, look_at)
    compile_s, search_s = found.compile_s + compile_s, found.search_s + polish_s
    found = dataclasses.replace(found, compile_s=compile_s, search_s=search_s)
    return found, result


def time_left(config: PlannerConfig, spent_s: float) -> PlannerConfig:
    """The same settings, with what is left of the time."""
    return dataclasses.replace(config, time_limit_s=max(0.0, config.time_limit_s - spent_s))


def with_time_of(result: PlanResult, *results: PlanResult) -> PlanResult:
    """A result that took the time of all."""
    timing = {name: sum(r.timing[name] for r in results) for name in result.timing}
    return dataclasses.replace(result, timing=timing)


def timed(run: Callable[[], Any], *programs: Any) -> tuple[Any, float, float]:
    """The result of a run, and the seconds that compiling these jitted functions took, and it."""

    def clocked() -> tuple[Any, float]:
        started = time.perf_counter()
        result = jax.block_until_ready(run())
        return result, time.perf_counter() - started

    def compiled() -> int:
        return sum(program._cache_size() for program in programs)

    before = compiled()
    result, first_s = clocked()
    if compiled() == before:
        return result, 0.0, first_s
    result, run_s = clocked()
    return result, first_s - run_s, run_s


def finish(
    robot: Robot,
    world: World,
    found: SearchResult,
    raw_path: np.ndarray | None,
    target: np.ndarray,
    loss: float,
    goal_loss: float,
    key: jax.Array,
    config: PlannerConfig,
    q_start: np.ndarray,
) -> PlanResult:
    """Shorten and verify; if the shortened path fails the exact check, fall back on the raw one.

    Without a path the result is the start alone.
    """
    has_path, hurried = raw_path is not None, found.stopped in HURRIED
    raw_path = q_start[None] if raw_path is None else raw_path
    started = time.perf_counter()
    shortcut(world, raw_path, key=key, rounds=0)
    shortcut_compile_s = time.perf_counter() - started
    started = time.perf_counter()
    path = unwrapped(world, shortcut(world, raw_path, key=key, rounds=config.shortcut_rounds))
    shortcut_s = time.perf_counter() - started

    started = time.perf_counter()
    obstacles = obstacle_list(world)
    verification = verify_path(robot, obstacles, path, step=config.verify_step)
    if not verification.ok:
        longer = unwrapped(world, raw_path)
        raw = verify_path(robot, obstacles, longer, step=config.verify_step)
        if raw.ok:
            path, verification = longer, raw
    verify_s = time.perf_counter() - started

    if has_path and loss <= goal_loss and verification.ok:
        status = Status.SOLVED
    elif hurried:
        status = STATUS_OF[found.stopped]
    elif not has_path:
        status = Status.NO_PATH
    elif loss > goal_loss:
        status = STATUS_OF.get(found.stopped, Status.NO_MATCH)
    else:
        status = Status.NOT_VERIFIED
    rejected = np.asarray(found.tree.rejected)
    return PlanResult(
        status=status,
        path=path,
        raw_path=raw_path,
        target=target,
        alternatives=target[None][:0],
        loss=loss,
        goal_loss=goal_loss,
        search_goal_loss=goal_loss,
        cost=path_length(world, path),
        verification=verification,
        rejected={reason.name.lower(): int(rejected[reason]) for reason in Rejection},
        iterations=int(found.tree.iteration),
        timing={
            "compile_s": found.compile_s + shortcut_compile_s,
            "search_s": found.search_s,
            "shortcut_s": shortcut_s,
            "verify_s": verify_s,
        },
        history=found.history,
        tree=found.tree,
    )
