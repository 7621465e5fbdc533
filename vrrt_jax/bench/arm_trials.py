"""One joint-goal problem: what the hand holds, whether it can be posed at all, and a timed plan."""

import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax import checks, planner
from vrrt_jax.batch import plan_batch
from vrrt_jax.bench.arm_problems import ArmProblems
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.interrupt import uninterrupted
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.pose import plan_to_pose
from vrrt_jax.robots.kinematics import batch_link_poses
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.attached import attach, detach, touching_spheres
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import contacts
from vrrt_jax.scene.world import World, batch_is_free, with_obstacles

POSE = "pose"  # the name of plan_to_pose among planners
LARGEST_HELD = 0.3  # [m] edge or length of what a hand can hold
_COMPILED = "/jax/core/compile/backend_compile_duration"  # jax.monitoring's name of a compilation


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial:
    """A problem that can be planned: both ends are free."""

    index: int  # in its file
    world: World
    q_start: np.ndarray  # (D,)
    q_goal: np.ndarray  # (D,)
    held_attached: bool  # what the fingers hold at the goal moves with the hand, all the way


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refusal:
    """A problem that cannot be planned, which is no failure of the planner."""

    index: int
    # "file": said to be invalid there. "limits": an end is outside of them. "exact": C MuJoCo finds
    # an end in collision with the true meshes. "spheres": only with the spheres that cover them.
    # "held": an end is free but for what the hand holds.
    kind: str
    reason: str


def pose_problem(robot: Robot, world: World, problems: ArmProblems, index: int) -> Trial | Refusal:
    """Put a problem's obstacles into a world's slots, and check both ends.

    Args:
        robot: whose problems they are.
        world: of the robot, with as many slots as the problem has obstacles.
        problems: N of them.
        index: which one.
    """
    if not problems.is_valid[index]:
        return Refusal(index=index, kind="file", reason="the file says that it is not valid")
    obstacles = problems.obstacles[index]
    q_start, q_goal = problems.q_start[index], problems.q_goal[index]
    held = held_at_goal(robot, obstacles, q_goal)
    world = bare = with_obstacles(world, obstacles)
    if held is not None:
        name = obstacles[held].name
        world = attach(world, name, robot.link_names[-1], q=q_goal)
        bare = detach(world, name)
    for what, q in (("start", q_start), ("goal", q_goal)):
        if found := _refused(robot, world, q, what):
            is_held = held is not None and _refused(robot, bare, q, what) is None
            return Refusal(index=index, kind="held" if is_held else found[0], reason=found[1])
    return Trial(
        index=index,
        world=world,
        q_start=q_start,
        q_goal=q_goal,
        held_attached=held is not None,
    )


def held_at_goal(robot: Robot, obstacles: Sequence[Obstacle], q_goal: np.ndarray) -> int | None:
    """Which obstacle the fingers hold at the goal, if they hold one.

    C MuJoCo says what touches what, with the true meshes and with the spheres that cover them. An
    obstacle is held if it is small, and if the hand (all bodies that the last joint carries)
    touches it and no other body does. Whatever else touches there is no matter of this function.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        obstacles: K of them.
        q_goal: (D,) [rad] or [m].

    Returns:
        The obstacle's index; None if there is no such obstacle, or more than one.
    """
    bodies: dict[int, set[str]] = {}  # that touch an obstacle, by its index
    for geometry in ("auto", "spheres"):
        scene = exact_scene(robot, obstacles, geometry=geometry)
        for first, second in scene.touching(q_goal):
            if second >= scene.num_bodies:
                index = scene.obstacle_index(second)
                bodies.setdefault(index, set()).add(scene.model.body(first).name)
    held = [
        index
        for index, touching in bodies.items()
        if _longest_edge(obstacles[index]) <= LARGEST_HELD and touching <= _hand_bodies(robot)
    ]
    return held[0] if len(held) == 1 else None


@functools.lru_cache(maxsize=8)
def _hand_bodies(robot: Robot) -> frozenset[str]:
    """The bodies that the last joint carries."""
    model = mujoco.MjModel.from_xml_string(robot.xml)
    last = model.body(robot.link_names[-1]).id
    carried = np.flatnonzero(model.body_weldid == model.body_weldid[last])
    return frozenset(model.body(body).name for body in carried)


def _longest_edge(obstacle: Obstacle) -> float:
    """Of a box, a cylinder or a sphere [m]."""
    return 2 * max(obstacle.size)


def _refused(robot: Robot, world: World, q: np.ndarray, what: str) -> tuple[str, str] | None:
    """Why a configuration is refused: a kind of :class:`Refusal` and words; None if it is not."""
    try:
        q = checks.check_limits(robot, q, what)
    except ValueError as error:
        return "limits", str(error)
    if touching := contacts(robot, world, q):
        geometry = exact_scene(robot, world).geometry
        return "exact" if geometry == "meshes" else "spheres", f"{what}: {'; '.join(touching)}"
    if not bool(batch_is_free(world, jnp.asarray(q)[None])[0]):
        touching = contacts(robot, world, q, geometry="spheres") or touching_spheres(world, q)
        touching = touching or ["within the margin"]
        return "spheres", f"{what}: {'; '.join(touching)}"
    return None


def solve(
    robot: Robot, trial: Trial, *, planner_name: str, config: PlannerConfig, seed: int
) -> dict[str, Any]:
    """Plan once and time it. If something compiles meanwhile, the same plan is timed again.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        trial: what to plan.
        planner_name: see :func:`vrrt_jax.plan`; or "pose", to where the last link is at the goal.
        config: settings.
        seed: of the benchmark.

    Returns:
        A row: ``index``, ``status``, ``solved``, ``wall_ms`` of the whole call, ``stages_ms``,
        ``cost`` [rad], ``raw_cost`` before shortening, ``refused_paths`` by the exact check,
        ``held_attached`` and ``recompiled``.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed meanwhile.
    """

    def plan():
        started = time.perf_counter()
        key = jax.random.fold_in(jax.random.key(seed), trial.index)
        own: dict[str, Any] = {"key": key, "config": config}
        with uninterrupted():
            if planner_name == POSE:
                result = plan_to_pose(robot, trial.world, trial.q_start, pose, **own)
            else:
                goal = ConfigurationGoal(q=trial.q_goal)
                own["planner"] = planner_name
                result = planner.plan(robot, trial.world, goal, trial.q_start, **own)
        return result, 1e3 * (time.perf_counter() - started)

    pose = np.asarray(batch_link_poses(trial.world.chain, trial.q_goal[None]))[0, -1]
    before = _compilations()[0]
    result, wall_ms = plan()
    recompiled = _compilations()[0] > before
    if recompiled:
        result, wall_ms = plan()
    return {
        "index": trial.index,
        "status": result.status.name,
        "solved": result.ok,
        "wall_ms": wall_ms,
        "stages_ms": {
            stage: 1e3 * result.timing[f"{stage}_s"] for stage in ("search", "shortcut", "verify")
        },
        "raw_cost": path_length(trial.world, result.raw_path) if result.ok else None,
        "cost": result.cost if result.ok else None,
        "refused_paths": result.refused,
        "held_attached": trial.held_attached,
        "recompiled": recompiled,
    }


def alike(trials: Sequence[Trial]) -> list[list[Trial]]:
    """Trials in groups that share their compiled functions: what is held adds spheres."""
    groups: dict[Any, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(_shapes(trial), []).append(trial)
    return list(groups.values())


def _shapes(trial: Trial) -> tuple[tuple[int, ...], ...]:
    return tuple(jnp.shape(leaf) for leaf in jax.tree.leaves(trial.world))


def batch_rate(
    robot: Robot,
    trials: Sequence[Trial],
    *,
    size: int,
    planner_name: str,
    config: PlannerConfig,
    seed: int,
) -> float:
    """Verified problems per second of batched plans, compilation excluded.

    Trials are repeated, with other keys, where they do not fill the last batch of their group, see
    :func:`alike`.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        trials: what to plan, one at least.
        size: of a batch.
        planner_name: see :func:`vrrt_jax.plan`.
        config: settings.
        seed: of the benchmark.
    """
    batches = []
    for group in alike(trials):
        num_batches = -(-len(group) // size)
        filled = [group[i % len(group)] for i in range(num_batches * size)]
        batches += [filled[k * size : (k + 1) * size] for k in range(num_batches)]

    def plan(number: int) -> int:
        batch = batches[number]
        worlds: Any = [trial.world for trial in batch]
        with uninterrupted():
            results = plan_batch(
                robot,
                worlds,
                [ConfigurationGoal(q=trial.q_goal) for trial in batch],
                np.stack([trial.q_start for trial in batch]),
                key=jax.random.fold_in(jax.random.key(seed), number),
                planner=planner_name,
                config=config,
            )
        return sum(result.ok for result in results)

    for number in range(len(batches)):
        if number == 0 or _shapes(batches[number][0]) != _shapes(batches[number - 1][0]):
            plan(number)  # compiles
    started = time.perf_counter()
    solved = sum(plan(number) for number in range(len(batches)))
    return solved / (time.perf_counter() - started)


@functools.cache
def _compilations() -> list[int]:
    """One number: how many programs this process has compiled since the first call."""
    count = [0]

    def on_duration(event: str, duration_secs: float, **_: Any) -> None:
        count[0] += event == _COMPILED

    jax.monitoring.register_event_duration_secs_listener(on_duration)
    return count
