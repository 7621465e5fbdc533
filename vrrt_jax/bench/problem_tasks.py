"""Image goals in the scenes of joint-goal problems from elsewhere."""

import functools
from pathlib import Path

import numpy as np

from vrrt_jax.bench.arm_problems import problem_files
from vrrt_jax.bench.arm_trials import Trial, pose_problem
from vrrt_jax.bench.tasks import (
    NUM_SLOTS,
    Task,
    bench_robot,
    bench_world,
    problems_of,
    straight_is_blocked,
)


def problem_task(folder: str, robot_name: str, level: str, index: int) -> Task:
    """A task of a file: its start and obstacles; its goal is for rendering and scoring alone.

    Args:
        folder: see :func:`~vrrt_jax.bench.arm_problems.problem_files`.
        robot_name: one of :data:`~vrrt_jax.bench.tasks.ROBOTS`.
        level: the file's name without its suffix.
        index: of the task, below the number of :func:`usable_problems`.
    """
    file = files_of(folder, robot_name)[level]
    problems, number = problems_of(str(file), robot_name), usable_problems(file, robot_name)[index]
    q_start, q_goal = problems.q_start[number], problems.q_goal[number]
    name = f"{file}#{number}"
    world = bench_world(robot_name, name)
    return Task(
        level=level,
        index=index,
        world=name,
        q_start=q_start,
        q_goal=q_goal,
        straight_is_blocked=straight_is_blocked(bench_robot(robot_name), world, q_start, q_goal),
    )


def files_of(folder: str, robot_name: str) -> dict[str, Path]:
    """Files of problems by name.

    Raises:
        FileNotFoundError: there are none.
    """
    return {file.stem: file for file in problem_files(folder, robot_name)}


@functools.cache
def usable_problems(file: Path, robot_name: str) -> list[int]:
    """Problems of a file whose ends are free, in an order drawn once.

    What the fingers hold at the goal is in the hand all the way; see
    :func:`~vrrt_jax.bench.arm_trials.pose_problem`.

    Raises:
        ValueError: the file is damaged or of another robot, or has more obstacles than there is
            room for.
    """
    problems = problems_of(str(file), robot_name)
    most = max(map(len, problems.obstacles))
    if most > NUM_SLOTS:
        raise ValueError(f"'{file}' has {most} obstacles a problem; expected at most {NUM_SLOTS}")
    robot, empty = bench_robot(robot_name), bench_world(robot_name, "")
    order = np.random.default_rng(0).permutation(len(problems.q_start)).tolist()
    return [k for k in order if isinstance(pose_problem(robot, empty, problems, k), Trial)]
