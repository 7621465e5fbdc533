"""Plans to joint goals: a search that keeps a clearance where it can, and batches of them."""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.check_protocols import check_extracted_path
from vrrt_jax.core.command import usable_cores
from vrrt_jax.core.goal import ConfigurationGoal, nearest_and_loss, starts_at
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import ABORTED, STATUS_OF, PlanResult, Status, with_time_of
from vrrt_jax.core.search import (
    SearchResult,
    StopReason,
    make_termination,
    no_search,
    search,
)
from vrrt_jax.core.types import ExpansionPolicy
from vrrt_jax.outcome import JOINT_ADVICE, Chosen, Progress, finish, time_left
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World, checked_more_finely, rooms

WARY_SHARE = 0.15  # of the iterations are searched with a clearance to keep, then without
SPHERES_SHARE = 0.5  # of them are searched by spheres alone, then by polytopes too


@single_precision
def plan_to_goal(
    robot: Robot,
    world: World,
    goal: ConfigurationGoal,
    policy: ExpansionPolicy,
    q_start: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
    on_progress: Progress,
) -> PlanResult:
    """Search, extract the policy's path, shorten and verify it; again, with another key, if not.

    Random trees need many times longer now and then: beginning afresh is the cure for that. After
    a path that the exact check refused, edges are checked more finely.

    Args:
        robot: whose path it is.
        world: robot and obstacles.
        goal: inside the limits and free.
        policy: the planner.
        q_start: (D,) inside the limits and free.
        key: random key.
        config: settings.
        on_progress: called with the search state and the seconds so far.
    """
    results: list[PlanResult] = []
    with interruptible():
        for attempt in range(config.budget.attempts):
            own_key = jax.random.fold_in(key, attempt) if attempt else key
            spent_s = sum(result.timing["search_s"] for result in results)
            own = time_left(config, spent_s)
            results.append(_attempt(robot, world, goal, policy, q_start, own_key, own, on_progress))
            if results[-1].ok or results[-1].status in ABORTED:
                break
            if results[-1].refused:
                world = checked_more_finely(world)
    return with_time_of(results[-1], *results)


def _attempt(
    robot: Robot,
    world: World,
    goal: ConfigurationGoal,
    policy: ExpansionPolicy,
    q_start: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
    on_progress: Progress,
) -> PlanResult:
    """One attempt, which keeps ``config.path.margin`` from everything if it can.

    It keeps less where start or goal are nearer than that. If no path is found soon, one is
    searched for without, and at last by polytopes where spheres touch. A plan that starts at its
    goal has nothing to search for.
    """
    if starts_at(goal, world, q_start):
        tree = policy.init(world, goal, q_start[None], config.tree.capacity)
        chosen = _chosen(world, goal, q_start[None], q_start)
        result = finish(robot, world, no_search(policy, goal, tree), chosen, q_start, key, config)
        return dataclasses.replace(result, advice=JOINT_ADVICE[result.status])
    limit = config.budget.max_iterations
    # A planner that goes on to improve gets all of its iterations in the wariest room.
    improves = policy.goal_score(goal) == -np.inf
    compile_s = search_s = done = 0.0
    for room in rooms(world, np.vstack([q_start, goal.q]), config.path.margin):
        share = WARY_SHARE if room.margin > world.margin else SPHERES_SHARE
        share = 1.0 if improves else 1.0 - done if room is world else share
        done += share
        iterations = max(round(share * limit), 1)
        own = time_left(config, search_s)
        found, path = _search(room, goal, policy, q_start, key, iterations, own, on_progress)
        compile_s, search_s = compile_s + found.compile_s, search_s + found.search_s
        chosen = _chosen(world, goal, path, q_start)
        is_there = path is not None and chosen.loss <= chosen.threshold
        if is_there or found.stopped is not StopReason.ITERATIONS:
            break
    found = dataclasses.replace(found, compile_s=compile_s, search_s=search_s)
    result = finish(robot, world, found, chosen, q_start, key, config, room if is_there else None)
    status = result.status
    if path is None:
        status = STATUS_OF.get(found.stopped, Status.NO_PATH)
    return dataclasses.replace(result, status=status, advice=JOINT_ADVICE[status])


def _chosen(
    world: World, goal: ConfigurationGoal, path: np.ndarray | None, q_start: np.ndarray
) -> Chosen:
    """Where a path, or the start without one, stands to the goal."""
    nearest, loss = nearest_and_loss(goal, world, q_start if path is None else path[-1])
    return Chosen(
        path=path,
        target=np.asarray(nearest),
        loss=float(loss),
        threshold=float(goal.threshold),
    )


def _search(
    world: World,
    goal: ConfigurationGoal,
    policy: ExpansionPolicy,
    q_start: np.ndarray,
    key: jax.Array,
    iterations: int,
    config: PlannerConfig,
    on_progress: Progress,
) -> tuple[SearchResult, np.ndarray | None]:
    found = search(
        world,
        goal,
        policy,
        policy.init(world, goal, q_start[None], config.tree.capacity),
        key=key,
        termination=make_termination(policy.goal_score(goal), max_iterations=iterations),
        time_limit_s=config.budget.time_limit_s,
        max_capacity=config.tree.max_capacity,
        on_progress=on_progress,
    )
    path = policy.extract_path(found.tree)
    check_extracted_path(policy, path, q_start)
    return found, path


def plan_each_to_configuration(
    robot: Robot,
    worlds: Sequence[World],
    goals: Sequence[ConfigurationGoal],
    policy: ExpansionPolicy,
    starts: Sequence[np.ndarray],
    keys: jax.Array,
    config: PlannerConfig,
    devices: Sequence[Any],
    on_progress: Progress,
) -> list[PlanResult]:
    """Q problems on as many threads as there are cores, or devices; see ``plan_batch``.

    A search of one problem keeps one core busy. An outer ``vmap`` over problems is slower on a CPU:
    each of its steps waits for the problem that needs most checks.
    """

    def plan_one(index: int) -> PlanResult:
        own = robot, worlds[index], goals[index], policy, starts[index], keys[index]
        with jax.default_device(devices[index % len(devices)]):
            return plan_to_goal(*own, config, on_progress)

    threads = max(usable_cores(), len(devices))
    with interruptible(), ThreadPoolExecutor(threads) as pool:
        # The first problem compiles what the others use. Ctrl-C ends all, each with its best path.
        return [plan_one(0), *pool.map(plan_one, range(1, len(goals)))]
