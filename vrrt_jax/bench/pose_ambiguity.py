"""What no image tells: a gripper that looks alike after half a turn of the last joint."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from vrrt_jax.bench.tasks import (
    ROBOTS,
    Scenery,
    Task,
    bench_robot,
    bench_world,
    goal_images,
    image_psnr,
    make_task,
)
from vrrt_jax.core.edges import joint_error

LEVELS = (0.5, 1.0, 1.5, 2.0, 2.5)  # distances from start to goal [rad]
LOOKED_AT = 5  # tasks a level whose images are compared


def run(tasks_per_level: int = 20, seed: int = 0) -> dict[str, Any]:
    """How alike the true meshes look at a goal and at its twin, and which of them is nearer.

    A planner that cannot tell them apart had better take the one nearer to the start: that one is
    the wrong one in ``twin_is_nearer`` of the tasks.

    Args:
        tasks_per_level: of the visual benchmark.
        seed: of the tasks.

    Returns:
        For each robot: by level the median PSNR of the two [dB] over a few tasks, and the share of
        all tasks whose twin is within the limits and nearer to the start.
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
                        np.median([_alike(robot, task) for task in tasks[:LOOKED_AT]])
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


def _alike(robot: str, task: Task) -> float:
    images, _ = goal_images(robot, task, Scenery())
    return image_psnr(robot, twin(robot, task).q_goal, images, Scenery())


def _is_nearer(robot_name: str, task: Task) -> bool:
    robot, world = bench_robot(robot_name), bench_world(robot_name, task.world)
    q = twin(robot_name, task).q_goal
    if np.any(~robot.is_continuous & ((q < robot.lower) | (q > robot.upper))):
        return False
    away, truly = (np.linalg.norm(joint_error(world, e, task.q_start)) for e in (q, task.q_goal))
    return bool(away < truly)


def draw(path: str | Path, level: float = 2.5, seed: int = 0) -> None:
    """Write a figure of a goal of each robot, its twin, and where they differ."""
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
    """A square window around what a mask (H, W) shows."""
    low, high = (f(np.argwhere(mask), axis=0) for f in (np.min, np.max))
    half, center = int(np.max(high - low)) // 2 + margin, (low + high) // 2
    first = np.maximum(center - half, 0)
    y, x = (slice(int(a), int(b)) for a, b in zip(first, first + 2 * half, strict=True))
    return y, x
