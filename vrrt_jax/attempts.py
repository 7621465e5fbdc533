"""Plans to goals that are known by their loss: a search, its end; and again if it failed."""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.compiling import compile_together
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.parallel import map_on_threads
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import ABORTED, PlanResult, Status, with_time_of
from vrrt_jax.core.search import SearchResult, compile_search, make_termination, search
from vrrt_jax.core.shortcut import shortcut
from vrrt_jax.core.timing import timed
from vrrt_jax.core.types import ExpansionPolicy, Goal, Tree
from vrrt_jax.outcome import Progress, time_left
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World, pose_error
from vrrt_jax.visual import lineages
from vrrt_jax.visual import policy as published
from vrrt_jax.visual.finish import finish_visual
from vrrt_jax.visual.goal import ImageObjective
from vrrt_jax.visual.least_squares import linearize
from vrrt_jax.visual.lineages import LineageRRT
from vrrt_jax.visual.polish import compile_polishing
from vrrt_jax.visual.problem import VisualProblem

ATTEMPT_KEY = 0x7FFFFFFF  # folded into the key of a later attempt; iterations count from 0
MORE_EACH = 2  # attempts that do more than the one before
CONFIRMING = 2  # more attempts where a match is in doubt, or has no path
DOUBTFUL = 0.5  # of the threshold; a match with a larger loss is in doubt
UNLIKELY = 0.5  # probability of a match; one below is looked for again as if it were none
SAME_POSE = 0.05  # [rad] mean over the joints; two attempts that end as near agree
AGREEING = 3  # attempts that end at the same pose, which does not match, for it to be named
STRANGE = 2.0  # thresholds; colors as far off are another lamp's, and not a wrong pose's
ROOT_SAMPLES, ROOT_BATCHES = 4096, 8  # random configurations, of which some are roots


def plan_by_loss(
    robot: Robot,
    world: World,
    problem: VisualProblem,
    policy: ExpansionPolicy,
    roots: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
    on_progress: Progress,
) -> PlanResult:
    """Attempts with different keys, until one is solved; the best of them.

    Most goals are found at once. So the first attempt is short; the second takes twice as long, and
    the others four times.
    """
    with interruptible():
        result = attempt(robot, world, problem, policy, roots, key, config, on_progress)
        ends = [result.target]
        for again in range(1, config.budget.attempts):
            rest = time_left(config, result.timing["search_s"])
            # A match in doubt is believed if a few more attempts find no better one, or, under
            # another lamp, where all are in doubt, if one more ends there too.
            in_doubt = _is_in_doubt(result)
            if result.colored_loss > STRANGE * result.match_threshold:
                in_doubt &= _num_ends_at(world, result.target, ends) < 2
            few_more = in_doubt or result.status in (Status.NO_PATH, Status.NOT_VERIFIED)
            goes_on = result.status is Status.NO_MATCH or (few_more and again <= CONFIRMING)
            goes_on |= in_doubt and result.match_probability < UNLIKELY
            if not goes_on or rest.budget.time_limit_s == 0:
                break
            key = jax.random.fold_in(key, ATTEMPT_KEY - again)
            # The start's tree may not get there: it is walled in, or the goal is far away.
            places = roots
            if isinstance(policy, LineageRRT):
                policy = policy.again() if again <= MORE_EACH else policy
                room = min(policy.num - 2, config.tree.capacity - policy.lanes - len(roots))
                others = promising_roots(world, problem.goal, key, max(room, 0))
                places = np.concatenate([roots, others])
            other = attempt(robot, world, problem, policy, places, key, rest, on_progress)
            ends.append(other.target)
            if other.status in ABORTED and not other.ok:
                # It ended before its loss could be compared with the other's.
                best = dataclasses.replace(result, status=other.status, advice=other.advice)
            else:
                best = other if _is_better(other, result, config.match.ambiguity) else result
            result = with_time_of(best, result, other)
    num = _num_ends_at(world, result.target, ends)
    is_image = isinstance(problem.goal, ImageObjective)
    if is_image and result.status is Status.NO_MATCH and num >= AGREEING:
        scale = 1.1 * config.match.scale * result.loss / result.match_threshold
        advice = (
            f"{num} of {len(ends)} attempts end at the same pose: if it looks right, the picture "
            f"or its mask is rougher than usual; match.scale={scale:.2g} lets it match"
        )
        result = dataclasses.replace(result, advice=advice)
    return result


def _is_in_doubt(result: PlanResult) -> bool:
    """Whether the image fits a match less well, or in stranger colors, than most true poses."""
    threshold = result.match_threshold
    return result.ok and (result.loss > DOUBTFUL * threshold or result.colored_loss > threshold)


def _num_ends_at(world: World, target: np.ndarray, ends: Sequence[np.ndarray]) -> int:
    """How many attempts ended at a configuration (D,)."""
    return sum(pose_error(world, end, target).mean() < SAME_POSE for end in ends)


def _is_better(other: PlanResult, result: PlanResult, ambiguity: float) -> bool:
    """Whether a later attempt came to more. What looks the same is no better."""
    if other.ok != result.ok:
        return other.ok
    if other.ok and np.isfinite(other.colored_loss):
        return ambiguity * other.colored_loss < result.colored_loss
    return other.loss < result.loss


def promising_roots(world: World, goal: Goal, key: jax.Array, num: int) -> np.ndarray:
    """The best (at most num, D) of free configurations drawn anywhere inside the limits."""
    key = jax.random.fold_in(key, ATTEMPT_KEY)
    q = np.asarray(sample_configurations(world, key, ROOT_SAMPLES))
    parts = map_on_threads(
        lambda part: lineages.losses_where_free(world, goal, part), np.split(q, ROOT_BATCHES)
    )
    loss = np.concatenate(parts)
    return q[np.argsort(loss, kind="stable")[: min(num, np.sum(np.isfinite(loss)))]]


def attempt(
    robot: Robot,
    world: World,
    problem: VisualProblem,
    policy: ExpansionPolicy,
    roots: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
    on_progress: Progress,
) -> PlanResult:
    """Search from the start (the first of the roots), and finish, once."""
    goal, termination = problem.goal, termination_of(config, policy, problem.goal)

    def init() -> Tree:
        return policy.init(world, goal, roots, config.tree.capacity)

    def compile_start() -> None:
        compile_search(world, goal, policy, init(), key=key, termination=termination)

    def compile_end() -> None:
        if problem.polishing is not None:
            compile_polishing(world, problem.polishing)
        shortcut(world, np.repeat(roots[:1], 3, axis=0), key=key, rounds=0)

    def prepare() -> Tree:
        polished = None if problem.polishing is None else problem.polishing.arrays
        kind = world, goal, policy, polished, roots
        compile_together(kind, compile_start, compile_end)
        return init()

    tree, compile_s, _ = timed(
        prepare,
        lineages.tree_from_roots,
        published.tree_from_roots,
        linearize,
    )
    found = search(
        world,
        goal,
        policy,
        tree,
        key=key,
        termination=termination,
        time_limit_s=config.budget.time_limit_s,
        max_capacity=config.tree.max_capacity,
        copies=config.lineages.trees if isinstance(policy, LineageRRT) else 1,
        on_progress=on_progress,
    )
    found = dataclasses.replace(found, compile_s=found.compile_s + compile_s)
    return finish_visual(robot, world, problem, policy, found, roots[0], key, config)


def termination_of(config: PlannerConfig, policy: ExpansionPolicy, goal: Goal) -> Any:
    """When a search by loss ends."""
    budget = config.budget
    return make_termination(
        policy.goal_score(goal),
        enough_iterations=int(policy.stages[-1]) if isinstance(policy, LineageRRT) else None,
        settle_iterations=budget.settle_iterations,
        max_iterations=budget.max_iterations,
        patience=budget.patience,
        min_improvement=budget.min_improvement,
        min_ratio=budget.min_ratio,
    )


def plan_batch_by_loss(
    robot: Robot,
    world: World,
    problems: Sequence[VisualProblem],
    policy: ExpansionPolicy,
    starts: Sequence[np.ndarray],
    keys: jax.Array,
    config: PlannerConfig,
    devices: Sequence[Any],
    on_progress: Progress,
) -> list[PlanResult]:
    """One attempt at each of Q problems, in one search over all of them; see ``plan_batch``.

    Several devices share out the search, and then each finishes its own problems.
    """
    each = -(-len(problems) // len(devices))  # problems of a device
    # As many for each device: the last problem again where there are too few.
    places = np.minimum(np.arange(each * len(devices)), len(problems) - 1)
    mesh = Mesh(np.array(devices), ("problems",)) if len(devices) > 1 else None

    def search_all() -> SearchResult:
        trees = [
            policy.init(world, problem.goal, q_start[None], config.tree.capacity)
            for problem, q_start in zip(problems, starts, strict=True)
        ]
        goals = [problem.goal for problem in problems]
        terminations = [termination_of(config, policy, goal) for goal in goals]
        shared: Any = [_stack([part[i] for i in places]) for part in (goals, trees, terminations)]
        shared.append(keys[places])
        everywhere = world, policy
        if mesh is not None:
            shared = jax.device_put(shared, NamedSharding(mesh, PartitionSpec("problems")))
            everywhere = jax.device_put(everywhere, NamedSharding(mesh, PartitionSpec()))
        goal, tree, termination, own_keys = shared
        return search(
            everywhere[0],
            goal,
            everywhere[1],
            tree,
            key=own_keys,
            termination=termination,
            time_limit_s=config.budget.time_limit_s,
            max_capacity=config.tree.max_capacity,
            batched=True,
            mesh=mesh,
            on_progress=on_progress,
        )

    @single_precision
    def finish_one(i: int) -> PlanResult:
        own = dataclasses.replace(
            found, tree=jax.tree.map(lambda leaf: leaf[i], trees), stopped=found.stopped_each[i]
        )
        with jax.default_device(devices[i // each]):
            return finish_visual(robot, world, problems[i], policy, own, starts[i], keys[i], config)

    with interruptible():
        found = search_all()
        trees = jax.device_get(found.tree) if mesh is not None else found.tree
        with ThreadPoolExecutor(len(devices)) as pool:
            return list(pool.map(finish_one, range(len(problems))))


def _stack(items: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *items)
