"""Poses that an image can hardly tell apart: the last joint turned by half a turn.

The pose with the last joint turned is called the twin of a pose.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.bench.tasks import (
    ROBOTS,
    Scenery,
    Task,
    bench_robot,
    bench_world,
    cameras,
    goal_images,
    image_psnr,
    make_task,
    robot_views,
)
from vrrt_jax.core.edges import joint_error
from vrrt_jax.scene.world import World
from vrrt_jax.splat.images import shrink_views
from vrrt_jax.splat.loss import weighted, weighted_goal
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import GoalImage
from vrrt_jax.visual.goal import ImageGoal, ImageObjective

LEVELS = (0.5, 1.0, 1.5, 2.0, 2.5)  # distances from start to goal [rad]
NUM_COMPARED = 5  # tasks of a level whose images are compared


def run(tasks_per_level: int = 20, seed: int = 0) -> dict[str, Any]:
    """Compare images of goals and of their twins, and their distances from the start.

    A planner that cannot tell a goal from its twin does best to take the one nearer to the start.
    That one is wrong in a share ``twin_is_nearer`` of the tasks.

    Args:
        tasks_per_level: number of tasks of the visual benchmark at each distance.
        seed: of the tasks.

    Returns:
        For each robot and distance: the median PSNR between the images of a goal and its twin [dB],
        over a few tasks; and the share of all tasks whose twin is within the limits and nearer to
        the start.
    """
    found = {}
    for robot in ROBOTS:
        levels = []
        for level in LEVELS:
            tasks = [
                make_task(robot, level, i, seed, obstacles=True) for i in range(tasks_per_level)
            ]
            levels.append(
                {
                    "distance_rad": level,
                    "n": len(tasks),
                    "psnr_db": float(
                        np.median([_psnr_db(robot, task) for task in tasks[:NUM_COMPARED]])
                    ),
                    "twin_is_nearer": float(np.mean([_is_nearer(robot, t) for t in tasks])),
                }
            )
        found[robot] = levels
    return found


def twin(robot: str, task: Task) -> Task:
    """The same task with the last joint of its goal turned by half a turn, towards the start."""
    q_goal = task.q_goal.copy()
    q_goal[-1] += np.pi if q_goal[-1] < task.q_start[-1] else -np.pi
    return dataclasses.replace(task, q_goal=q_goal)


def _psnr_db(robot: str, task: Task) -> float:
    """PSNR between the images of a task's goal and of its twin [dB]."""
    images, _ = goal_images(robot, task, Scenery())
    return image_psnr(robot, twin(robot, task).q_goal, images, Scenery())


def _is_nearer(robot_name: str, task: Task) -> bool:
    """Whether the twin is within the limits, and nearer to the start than the goal."""
    robot, world = bench_robot(robot_name), bench_world(robot_name, task.world)
    q = twin(robot_name, task).q_goal
    if np.any(~robot.is_continuous & ((q < robot.lower) | (q > robot.upper))):
        return False
    to_twin, to_goal = (
        np.linalg.norm(joint_error(world, end, task.q_start)) for end in (q, task.q_goal)
    )
    return bool(to_twin < to_goal)


def looks_the_same(
    robot: str, task: Task, q: np.ndarray, self_model: SelfModel, scenery: Scenery, image_px: int
) -> bool:
    """Whether the goal image can hardly tell a configuration from the true one.

    It cannot where the true meshes at ``q`` differ less from it than the self-model does at the
    goal. Both differences are the planner's image loss, on one image with one mask.

    Args:
        robot: one of the benchmark's.
        task: whose goal image it is.
        q: (D,) the configuration that was found.
        self_model: the robot's.
        scenery: of the goal images.
        image_px: height that the images are shrunk to [px].
    """
    images, masks = goal_images(robot, task, scenery)
    goal = ImageGoal(self_model, cameras(robot, scenery), images, masks)
    objective = goal.at(bench_robot(robot), image_px)
    found, _ = shrink_views(robot_views(robot, q, scenery, masks), image_px)
    at_found, at_truth = _losses(
        bench_world(robot, task.world), objective, found, jnp.asarray(task.q_goal)
    )
    return bool(at_found <= at_truth)


@jax.jit
def _losses(
    world: World, objective: ImageObjective, found: GoalImage, q_true: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Image losses () of found images (V, h, w, ...), and of the self-model at the goal (D,)."""
    goal = objective.image
    at_found = jnp.sum((weighted(found.rgb, found.alpha, goal) - weighted_goal(goal)) ** 2)
    return at_found, objective.loss(world, q_true)


def draw(path: str | Path, level: float = 2.5, seed: int = 0) -> None:
    """Write a figure: a goal of each robot, its twin, and where their images differ."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    size = (8.2, 2.8 * len(ROBOTS))
    figure, axes = plt.subplots(len(ROBOTS), 3, figsize=size, squeeze=False, layout="constrained")
    for robot, row in zip(ROBOTS, axes, strict=True):
        task = make_task(robot, level, 0, seed, obstacles=True)
        goal, other = (goal_images(robot, t, Scenery())[0] for t in (task, twin(robot, task)))
        over_white = [a[..., :3] * a[..., 3:] + 1.0 - a[..., 3:] for a in (goal[0], other[0])]
        difference = 1.0 - np.max(np.abs(over_white[0] - over_white[1]), axis=-1)
        psnr_db = image_psnr(robot, twin(robot, task).q_goal, goal, Scenery())
        titles = (f"{robot}: a goal", "last joint half a turn on", f"difference: {psnr_db:.0f} dB")
        window = _around(goal[0][..., 3] > 0.5)
        for axis, title, image in zip(row, titles, (*over_white, difference), strict=True):
            axis.imshow(image[window], cmap="gray", vmin=0.0, vmax=1.0)
            axis.set(title=title, xticks=[], yticks=[])
    figure.savefig(path, dpi=75)
    plt.close(figure)


def _around(mask: np.ndarray, margin: int = 15) -> tuple[slice, slice]:
    """Rows and columns of a square around what a mask (H, W) shows."""
    low, high = (f(np.argwhere(mask), axis=0) for f in (np.min, np.max))
    half, center = int(np.max(high - low)) // 2 + margin, (low + high) // 2
    first = np.maximum(center - half, 0)
    y, x = (slice(int(a), int(b)) for a, b in zip(first, first + 2 * half, strict=True))
    return y, x
