"""How a plan ends: from the chosen path to a result, and what to try next."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.edges import nearest_turn
from vrrt_jax.core.postprocess import plan_result, postprocess, unchecked
from vrrt_jax.core.result import EARLY_STOPS, STATUS_OF, PlanResult, Status
from vrrt_jax.core.search import SearchResult
from vrrt_jax.core.shortcut import padded
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.verify import check_path
from vrrt_jax.scene.world import World, batch_clearance, keeping_clearance, obstacle_list

Progress = Callable[..., Any] | None  # called with the search state and the seconds so far

# What to try next, by how a plan to an image ended.
ADVICE = {
    Status.SOLVED: "",
    Status.NO_MATCH: (
        "check the camera and the self-model, add a view, or raise budget.max_iterations"
    ),
    Status.NO_PATH: "raise budget.connect_iterations, or move the obstacles",
    Status.MAX_ITERATIONS: "raise budget.max_iterations",
    Status.TREE_FULL: "raise tree.max_capacity",
    Status.TIME_LIMIT: "raise budget.time_limit_s",
    Status.INTERRUPTED: "run it again",
    Status.NOT_VERIFIED: "lower the world's resolution or raise its margin",
}

# The same of a plan to a joint goal, where it differs.
JOINT_ADVICE = ADVICE | {
    Status.NO_MATCH: "raise budget.max_iterations",
    Status.NO_PATH: "raise budget.max_iterations, or move the obstacles",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chosen:
    """The end that was chosen, and the path to it."""

    path: np.ndarray | None  # (P, D), None if none was found
    target: np.ndarray  # (D,)
    loss: float
    threshold: float
    tree_share: float = 1.0  # of the path's length, what the search's tree led along


def time_left(config: PlannerConfig, spent_s: float) -> PlannerConfig:
    """The same settings, with what is left of the time."""
    left_s = max(0.0, config.budget.time_limit_s - spent_s)
    return config.changed({"budget.time_limit_s": left_s})


def finish(
    robot: Robot,
    world: World,
    found: SearchResult,
    chosen: Chosen,
    q_start: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
    room: World | None = None,
) -> PlanResult:
    """Shorten and verify the chosen path, and say what became of the plan.

    Without a path the result is the start alone.

    Args:
        robot: whose path it is.
        world: robot and obstacles.
        found: the search.
        chosen: where to, and the raw path.
        q_start: (D,).
        key: random key of shortcutting.
        config: settings.
        room: the world with the clearance that the chosen path keeps; found here if it is None.
    """
    done = unchecked(q_start[None])
    if chosen.path is not None:
        if room is None:
            room = keeping_clearance(world, padded(chosen.path), config.path.margin)
        done = postprocess(
            room,
            chosen.path,
            lambda path: check_path(robot, world, path, step=config.budget.verify_step),
            key=key,
            rounds=config.budget.shortcut_rounds,
        )
    # The first thing that failed: without time nothing else is for certain, and without a match a
    # path is not missed.
    matched = chosen.loss <= chosen.threshold
    if matched and done.is_verified:
        status = Status.SOLVED
    elif found.stopped in EARLY_STOPS:
        status = STATUS_OF[found.stopped]
    elif not matched:
        status = STATUS_OF.get(found.stopped, Status.NO_MATCH)
    elif chosen.path is None:
        status = Status.NO_PATH
    else:
        status = Status.NOT_VERIFIED
    result = plan_result(
        world,
        found,
        done,
        status=status,
        advice=ADVICE[status],
        target=nearest_turn(world, chosen.target, done.checked.path[-1]),
        loss=chosen.loss,
        match_threshold=chosen.threshold,
    )
    if not obstacle_list(world):
        return dataclasses.replace(result, tree_share=chosen.tree_share)
    # Every fourth of the small steps, and the end: what the spheres do between is next to nothing.
    seldom = np.concatenate([result.trajectory[::4], result.trajectory[-1:]])
    for room in (world.by_spheres_alone(), world):  # polytopes only where spheres touch
        clearance = batch_clearance(room, padded(seldom, 512), len(seldom))
        if clearance > 0:
            break
    return dataclasses.replace(result, clearance=float(clearance), tree_share=chosen.tree_share)
