"""Many problems at once: shared out to threads, to one batched search, or to several devices."""

from collections.abc import Sequence
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax import checks
from vrrt_jax.attempts import plan_batch_by_loss
from vrrt_jax.config import PlannerConfig, check_config
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import PlanResult
from vrrt_jax.core.types import ExpansionPolicy, Goal
from vrrt_jax.joint import plan_each_to_configuration
from vrrt_jax.outcome import Progress
from vrrt_jax.planner import Image, counted, drawn, policy_of, problem_of
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World, rooms
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import Camera
from vrrt_jax.visual.goal import ImageGoal


@overload
def plan_batch(
    robot: Robot,
    world: World | Sequence[World],
    goals: Sequence[ImageGoal | ConfigurationGoal | Goal],
    q_starts: np.ndarray,
    *,
    key: jax.Array,
    planner: str | ExpansionPolicy | None = None,
    config: PlannerConfig | None = None,
    devices: Sequence[Any] | None = None,
    on_progress: Progress = None,
) -> list[PlanResult]: ...
@overload
def plan_batch(
    robot: Robot,
    world: World,
    self_model: SelfModel,
    camera: Camera | Sequence[Camera],
    goal_images: Sequence[Image],
    q_starts: np.ndarray,
    /,
    *,
    key: jax.Array,
    planner: str | ExpansionPolicy | None = None,
    config: PlannerConfig | None = None,
    devices: Sequence[Any] | None = None,
    on_progress: Progress = None,
) -> list[PlanResult]: ...
@single_precision
def plan_batch(
    robot: Robot,
    world: World | Sequence[World],
    goals: Any,
    *inputs: Any,
    q_starts: np.ndarray | None = None,
    key: jax.Array,
    planner: str | ExpansionPolicy | None = None,
    config: PlannerConfig | None = None,
    devices: Sequence[Any] | None = None,
    on_progress: Progress = None,
) -> list[PlanResult]:
    """Solve Q problems of one robot at once.

    Call it as ``plan_batch(robot, world, goals, q_starts, key=key)``, or with a self-model, a
    camera and Q goal images instead of the goals. Problem ``i`` uses the key ``fold_in(key, i)``.

    Joint goals are planned on as many threads as there are cores, each in its own world if Q worlds
    are given. Goals that are known by their loss are searched for by an outer ``vmap``, in one
    world and with one attempt each; their search times hold the search of the whole batch. On a
    CPU a loop over :func:`plan` is as fast for these; on other devices the batch pays.

    Args:
        robot: from :func:`load_robot`.
        world: for this robot; or Q of them, for joint goals.
        goals: Q goals that differ in numbers only, such as image goals of one camera.
        inputs: ``q_starts``, unless it is given by name.
        q_starts: (Q, D) start configurations.
        key: random key.
        planner: see :func:`plan`.
        config: settings, the default ones if None.
        devices: that share out the problems, such as ``jax.devices()``; the usual one if None. Each
            compiles programs of its own.
        on_progress: called with the batched search state and the seconds so far.

    Raises:
        ValueError: an input makes no sense; the message names the problem.
    """
    inputs = inputs if q_starts is None else (*inputs, q_starts)
    if isinstance(goals, SelfModel):
        camera, images, *rest = counted(inputs, "camera", "goal_images", "q_starts")
        inputs = tuple(rest)
        goals = [ImageGoal(goals, camera, image) for image in images]
    (all_starts,) = counted(inputs, "q_starts")
    config = PlannerConfig() if config is None else config
    check_config(config)
    worlds = [world] * len(goals) if isinstance(world, World) else list(world)
    if len(goals) != len(worlds):
        raise ValueError(f"got {len(worlds)} worlds and {len(goals)} goals; expected as many")
    if len(goals) != len(all_starts) or len(goals) == 0:
        raise ValueError(
            f"got {len(goals)} goals and {len(all_starts)} starts; expected as many, and one at "
            "least"
        )
    devices = list(jnp.zeros(()).devices() if devices is None else devices)
    if not devices:
        raise ValueError("devices is an empty list; expected one at least, such as jax.devices()")
    policy = policy_of(planner, goals[0], worlds[0], config)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(goals)))
    starts: list[np.ndarray] = []
    checked: list[Any] = []
    for i, (own, goal, q_start) in enumerate(zip(worlds, goals, all_starts, strict=True)):
        try:
            if isinstance(goal, ConfigurationGoal) != isinstance(goals[0], ConfigurationGoal):
                raise ValueError(
                    f"the goal is an object of {type(goal).__name__}, that of problem 0 of "
                    f"{type(goals[0]).__name__}; expected goals of one kind"
                )
            starts.append(checks.check_start(robot, own, q_start))
            checked.append(problem_of(robot, own, goal, starts[-1], policy, config))
        except ValueError as error:
            raise ValueError(f"problem {i}: {error}") from None
    if isinstance(goals[0], ConfigurationGoal):
        return plan_each_to_configuration(
            robot, worlds, checked, policy, starts, keys, config, devices, on_progress
        )
    if any(own is not worlds[0] for own in worlds):
        raise ValueError("goals known by their loss are searched for in one world; got several")
    room = rooms(worlds[0], np.stack(starts), margin=0.0)[0]  # as in ``plan``
    results = plan_batch_by_loss(
        robot, room, checked, policy, starts, keys, config, devices, on_progress
    )
    return [drawn(result, goal, robot) for result, goal in zip(results, goals, strict=True)]
