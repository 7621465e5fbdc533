"""Solve one task with one method, and say what became of it."""

import dataclasses
import functools
import time
import zlib
from typing import Any

import jax
import numpy as np

from vrrt_jax import planner
from vrrt_jax.bench import baselines
from vrrt_jax.bench.pose_ambiguity import looks_the_same
from vrrt_jax.bench.tasks import (
    Scenery,
    Task,
    bench_robot,
    bench_world,
    cameras,
    goal_images,
    image_psnr,
    level_name,
)
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.result import Status
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.problems import self_model_path
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.verify import verify_path
from vrrt_jax.scene.world import World, pose_error
from vrrt_jax.splat.model import SelfModel, load_self_model

METHODS = ("vrrt", "dr-robot", "prof-robot", "dr-robot-rrt-star")
CONFIGS = ("default", "paper")
SUCCESS_RAD = 0.05  # mean joint error, as in the paper
CAUSES = (
    "no match found",
    "matched the wrong pose",
    "wrong pose that looks the same",
    "right pose, no path",
    "right pose, no path known",
    "out of time",
    "invalid path",
)


@functools.cache
def _self_model(robot_name: str) -> SelfModel:
    return load_self_model(self_model_path(bench_robot(robot_name)))


@functools.cache
def _classifier(robot_name: str, world: str) -> baselines.Classifier:
    trained, _ = baselines.train_classifier(bench_robot(robot_name), bench_world(robot_name, world))
    return trained


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attempt:
    """What a method came back with."""

    path: np.ndarray  # (P, D)
    matched: bool  # the image of its end is below the match threshold
    has_path: bool  # False if no way to its end was found
    out_of_time: bool
    loss: float
    search_s: float  # planning, without compilation
    refused: int = 0  # paths that the exact check refused while planning
    ambiguous: bool = False  # it said that other poses look the same
    tree_share: float | None = None  # of its path, what its tree led along
    match_probability: float | None = None  # how sure it said it was of the pose


def solve(
    robot_name: str,
    task: Task,
    *,
    method: str,
    config: PlannerConfig,
    scenery: Scenery,
    seed: int,
    guess_sigma: float = 0.0,
    collisions: bool = True,
    engine: str = "mjx",
) -> dict[str, Any]:
    """Run a method on a task and judge the outcome as the paper does.

    Args:
        robot_name: one of the benchmark's.
        task: from :func:`make_task`.
        method: one of :data:`METHODS`.
        config: of Visual-RRT.
        scenery: what the goal images look like.
        seed: of the method; the task's index is folded in.
        guess_sigma: if positive, Visual-RRT is also told the goal with that much noise [rad].
        collisions: False judges the pose alone.
        engine: of the world that is planned in.

    Returns:
        A row for the results file.
    """
    robot, world = bench_robot(robot_name), bench_world(robot_name, task.world, engine)
    images, masks = goal_images(robot_name, task, scenery)
    task_seed = zlib.crc32(f"{seed} {level_name(task.level)} {task.index}".encode())
    key = jax.random.key(task_seed)
    self_model = _self_model(robot_name)
    inputs = (robot, world, self_model, cameras(robot_name, scenery), images, task.q_start)
    started = time.perf_counter()
    if method == "vrrt":
        noise = np.random.default_rng(task_seed).normal(size=robot.num_joints)
        guess = task.q_goal + guess_sigma * noise
        guess = np.where(robot.is_continuous, guess, np.clip(guess, robot.lower, robot.upper))
        attempt = _plan(inputs, key, config, masks, guess if guess_sigma > 0 else None)
    else:
        attempt = _baseline(inputs, robot_name, task, method, key, masks)
    wall_s = time.perf_counter() - started

    error = pose_error(world, attempt.path[-1], task.q_goal)
    right = bool(error.mean() < SUCCESS_RAD)
    valid = not collisions or verify_path(robot, world, attempt.path).ok
    success = right and valid and (attempt.has_path or not collisions)
    psnr_db = image_psnr(robot_name, attempt.path[-1], images, scenery, masks)
    length = path_length(world, attempt.path)
    reference, cause = None, ""
    if collisions and right and (valid or not attempt.has_path):
        reference = _reference_length(robot, world, task, key)
    if not success:
        alike = not right and looks_the_same(
            robot_name, task, attempt.path[-1], self_model, scenery, config.polish.px
        )
        known = reference is not None or not collisions
        cause = _cause(attempt, right=right, valid=valid, alike=alike, known=known)
    return {
        "level": task.level,
        "index": task.index,
        "world": task.world,
        "distance_rad": round(path_length(world, np.stack([task.q_start, task.q_goal])), 3),
        "straight_is_blocked": task.straight_is_blocked,
        "success": success,
        "cause": cause,
        # It said that it had solved the task, and that no other pose looks the same.
        "false_solved": bool(
            not right
            and attempt.matched
            and valid
            and not attempt.ambiguous
            and (attempt.has_path or not collisions)
        ),
        "tree_share": attempt.tree_share,
        "match_probability": attempt.match_probability,
        "mean_error_rad": round(float(error.mean()), 5),
        "max_error_rad": round(float(error.max()), 5),
        "l2_error_rad": round(float(np.linalg.norm(error)), 5),
        "path_length": round(length, 4),
        "path_over_reference": round(length / reference, 4) if success and reference else None,
        "loss": float(f"{attempt.loss:.4g}"),
        "psnr_db": round(psnr_db, 2),
        # A path that is judged only here counts too.
        "refused_paths": max(attempt.refused, int(not valid)),
        "time_s": round(attempt.search_s, 3),
        "wall_s": round(wall_s, 2),
    }


def _reference_length(robot: Robot, world: World, task: Task, key: jax.Array) -> float | None:
    """Of RRT-Connect's shortened path to the true goal, if it finds one."""
    found = planner.plan_to_configuration(robot, world, task.q_start, task.q_goal, key=key)
    return found.cost if found.ok else None


def _cause(attempt: Attempt, *, right: bool, valid: bool, alike: bool, known: bool) -> str:
    if attempt.out_of_time:
        return "out of time"
    if right and attempt.has_path and not valid:
        return "invalid path"
    if right:  # RRT-Connect may know no path to the true goal either
        return "right pose, no path" if known else "right pose, no path known"
    if alike:
        return "wrong pose that looks the same"
    return "matched the wrong pose" if attempt.matched else "no match found"


def _plan(inputs, key, config: PlannerConfig, masks, guess) -> Attempt:
    result = planner.plan(*inputs, key=key, config=config, mask=masks, q_guess=guess)
    times, has_path = result.timing, result.verification is not None
    return Attempt(
        path=result.path if has_path else result.target[None],
        matched=result.loss <= result.match_threshold,
        has_path=has_path,
        out_of_time=result.status is Status.TIME_LIMIT,
        loss=result.loss,
        search_s=times["search_s"] + times["shortcut_s"] + times["verify_s"],
        refused=result.refused,
        ambiguous=len(result.alternatives) > 0,
        tree_share=round(result.tree_share, 4),
        match_probability=_finite(result.match_probability),
    )


def _finite(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


def _baseline(inputs, robot_name: str, task: Task, method: str, key, masks) -> Attempt:
    classifier = None
    if method == "prof-robot" and task.world:
        classifier = _classifier(robot_name, task.world)
    found = baselines.dr_robot(*inputs, classifier=classifier, mask=masks)
    if method == "dr-robot-rrt-star":
        found = baselines.rrt_star_to_estimate(inputs[0], inputs[1], found, key=key)
    return Attempt(
        path=found.path,
        matched=found.loss <= found.match_threshold,
        has_path=found.found_path,
        out_of_time=False,
        loss=found.loss,
        search_s=found.search_s,
        refused=found.refused,
    )
