"""Planning, from the outside: what users call, with every input checked on the host."""

import dataclasses
from collections.abc import Sequence
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax import checks
from vrrt_jax.attempts import plan_by_loss
from vrrt_jax.config import PlannerConfig, check_config
from vrrt_jax.core.check_protocols import check_goal, check_policy
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners import PLANNERS, RRT, RRTConnect, RRTStar
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import PlanResult
from vrrt_jax.core.types import ExpansionPolicy, Goal
from vrrt_jax.joint import plan_to_goal
from vrrt_jax.outcome import Progress
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World, rooms
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import Camera
from vrrt_jax.visual.end_picture import EndPicture
from vrrt_jax.visual.goal import ImageGoal
from vrrt_jax.visual.lineages import LineageRRT
from vrrt_jax.visual.policy import VisualRRT
from vrrt_jax.visual.problem import VisualProblem, make_problem

VISUAL = "visual-rrt"

Image = np.ndarray | Sequence[np.ndarray]
AnyGoal = ImageGoal | ConfigurationGoal | Goal


@overload
def plan(
    robot: Robot,
    world: World,
    goal: AnyGoal,
    q_start: np.ndarray,
    *,
    key: jax.Array,
    planner: str | ExpansionPolicy | None = None,
    config: PlannerConfig | None = None,
    q_guess: np.ndarray | None = None,
    on_progress: Progress = None,
) -> PlanResult: ...
@overload
def plan(
    robot: Robot,
    world: World,
    self_model: SelfModel,
    camera: Camera | Sequence[Camera],
    goal_image: Image,
    q_start: np.ndarray,
    /,
    *,
    key: jax.Array,
    planner: str | ExpansionPolicy | None = None,
    config: PlannerConfig | None = None,
    mask: Image | None = None,
    q_guess: np.ndarray | None = None,
    on_progress: Progress = None,
) -> PlanResult: ...
@single_precision
def plan(
    robot: Robot,
    world: World,
    goal: Any,
    *inputs: Any,
    q_start: np.ndarray | None = None,
    key: jax.Array,
    planner: str | ExpansionPolicy | None = None,
    config: PlannerConfig | None = None,
    mask: Image | None = None,
    q_guess: np.ndarray | None = None,
    on_progress: Progress = None,
) -> PlanResult:
    """Find a collision-free path to a goal: ``plan(robot, world, goal, q_start, key=key)``.

    ``plan(robot, world, self_model, camera, goal_image, q_start, key=key)`` is short for the goal
    ``ImageGoal(self_model, camera, goal_image, mask)``.

    Args:
        robot: from :func:`load_robot`.
        world: from :func:`load_world` or :func:`build_world`, for this robot.
        goal: an :class:`ImageGoal`, a :class:`ConfigurationGoal`, or any pytree with a
            differentiable ``loss(world, q)`` and a ``threshold``.
        inputs: ``q_start``, unless it is given by name.
        q_start: (D,) start configuration [rad] or [m].
        key: random key; the same key gives the same plan on the same machine, unless time ends it.
        planner: "visual-rrt", or to a joint goal "rrt-connect" (the default there), "rrt" or
            "rrt-star" (goes on to improve until its iterations are used up); or a policy of the
            kernel, see :class:`~vrrt_jax.core.types.ExpansionPolicy`.
        config: settings, the default ones if None. To a joint goal, the budget and the size of the
            tree are used.
        mask: (H, W) bool, True for the pixels of the goal image that are compared, where not all
            are; or V of them. For the second form.
        q_guess: (D,) where the goal roughly is, if that is known: searched from too.
        on_progress: called with the search state and the seconds so far.

    Raises:
        ValueError: an input makes no sense; the message says what to do.
    """
    inputs = inputs if q_start is None else (*inputs, q_start)
    if isinstance(goal, SelfModel):
        goal, inputs = _image_goal(goal, inputs, mask)
    elif mask is not None:
        raise ValueError("mask is given beside a goal; expected ImageGoal(..., mask=mask)")
    (start,) = counted(inputs, "q_start")
    config = PlannerConfig() if config is None else config
    check_config(config)
    start = checks.check_start(robot, world, start)
    policy = policy_of(planner, goal, world, config)
    problem = problem_of(robot, world, goal, start, policy, config)
    roots = start[None]
    if q_guess is not None:
        if isinstance(goal, ConfigurationGoal):
            raise ValueError("q_guess is for goals that are not known; drop it for a joint goal")
        roots = np.stack([start, checks.check_limits(robot, q_guess, "guess")])
    if isinstance(problem, ConfigurationGoal):
        return plan_to_goal(robot, world, problem, policy, start, key, config, on_progress)
    # Images do not tell poses to the millimeter: spheres do, where the start allows.
    room = rooms(world, start[None], margin=0.0)[0]
    result = plan_by_loss(robot, room, problem, policy, roots, key, config, on_progress)
    return drawn(result, goal, robot)


@single_precision
def plan_to_configuration(
    robot: Robot,
    world: World,
    q_start: np.ndarray,
    q_goal: np.ndarray,
    *,
    key: jax.Array,
    planner: str | ExpansionPolicy = "rrt-connect",
    config: PlannerConfig | None = None,
    goal_bias: float = 0.1,
    on_progress: Progress = None,
) -> PlanResult:
    """Short for :func:`plan` with a :class:`ConfigurationGoal`.

    Args:
        robot: from :func:`load_robot`.
        world: for this robot.
        q_start: (D,) [rad] or [m].
        q_goal: (D,) [rad] or [m]; or (G, D), any of which will do, for "rrt-connect".
        key: random key.
        planner: see :func:`plan`.
        config: budget, capacity and lanes are used.
        goal_bias: share of lanes that aim at the goal, for "rrt" and "rrt-star".
        on_progress: called with the search state and the seconds so far.

    Raises:
        ValueError: an input makes no sense; the message says what to do.
    """
    config = PlannerConfig() if config is None else config
    if planner in ("rrt", "rrt-star"):
        make = RRT if planner == "rrt" else RRTStar
        planner = make.for_world(world, goal_bias=goal_bias, lanes=config.tree.lanes)
    goal = ConfigurationGoal(q=np.asarray(q_goal))
    run = {"key": key, "planner": planner, "config": config, "on_progress": on_progress}
    return plan(robot, world, goal, q_start, **run)


@single_precision
def plan_waypoints(
    robot: Robot,
    world: World,
    goals: Sequence[AnyGoal],
    q_start: np.ndarray,
    *,
    key: jax.Array,
    config: PlannerConfig | None = None,
    on_progress: Progress = None,
) -> list[PlanResult]:
    """Plan to one goal after another, each from where the plan before it ended.

    Each leg begins exactly where the one before it ended, so that
    ``np.concatenate([q_start[None], *(leg.path[1:] for leg in legs)])`` is the whole way.

    Args:
        robot: from :func:`load_robot`.
        world: for this robot.
        goals: where to, in turn: image goals, joint goals, or both.
        q_start: (D,) start configuration of the first leg [rad] or [m].
        key: random key; leg ``i`` uses ``fold_in(key, i)``.
        config: settings of each leg, the default ones if None.
        on_progress: called with the search state and the seconds so far of the leg.

    Returns:
        A result a leg. The first one that is not solved is the last.

    Raises:
        ValueError: an input makes no sense; all goals are looked at before the first leg.
    """
    config = PlannerConfig() if config is None else config
    check_config(config)
    q_start = checks.check_start(robot, world, q_start)
    if not goals:
        raise ValueError("the goals are an empty list; expected one at least")
    for i, goal in enumerate(goals):
        try:
            problem_of(robot, world, goal, q_start, policy_of(None, goal, world, config), config)
        except ValueError as error:
            raise ValueError(f"goal {i}: {error}") from None
    legs: list[PlanResult] = []
    for i, goal in enumerate(goals):
        start, leg_key = legs[-1].path[-1] if legs else q_start, jax.random.fold_in(key, i)
        run = {"key": leg_key, "config": config, "on_progress": on_progress}
        legs.append(plan(robot, world, goal, start, **run))
        if not legs[-1].ok:
            break
    return legs


def drawn(result: PlanResult, goal: AnyGoal, robot: Robot) -> PlanResult:
    """A result that notebooks show with its goal image, if there is one."""
    draw = EndPicture(goal, robot) if isinstance(goal, ImageGoal) else None
    return dataclasses.replace(result, draw=draw)


def policy_of(
    planner: str | ExpansionPolicy | None, goal: AnyGoal, world: World, config: PlannerConfig
) -> ExpansionPolicy:
    """The policy of a planner by name, or the object itself.

    Raises:
        ValueError: the name is unknown or not for such a goal, or the object is no policy.
    """
    has_configuration = isinstance(goal, ConfigurationGoal)
    if planner is None:
        planner = "rrt-connect" if has_configuration else VISUAL
    if not isinstance(planner, str):
        check_policy(planner)
        if isinstance(planner, tuple(PLANNERS.values())) and not has_configuration:
            raise ValueError(_needs_configuration(type(planner).__name__, goal))
        return planner
    if planner == VISUAL:
        policy = LineageRRT if config.lineages.num else VisualRRT
        return policy.from_config(config, world)
    if planner not in PLANNERS:
        raise ValueError(f"unknown planner '{planner}'; have: {', '.join([*PLANNERS, VISUAL])}")
    if not has_configuration:
        raise ValueError(_needs_configuration(planner, goal))
    return PLANNERS[planner].for_world(world, lanes=config.tree.lanes)


def problem_of(
    robot: Robot,
    world: World,
    goal: AnyGoal,
    start: np.ndarray,
    policy: ExpansionPolicy,
    config: PlannerConfig,
) -> ConfigurationGoal | VisualProblem:
    """What is searched for: a joint goal, or a goal known by its loss.

    Raises:
        ValueError: the goal makes no sense.
    """
    if isinstance(goal, ConfigurationGoal):
        return _checked_goal(robot, world, goal, policy)
    if not isinstance(goal, ImageGoal):
        check_goal(goal)
    return make_problem(robot, goal, start, config)


def _checked_goal(
    robot: Robot, world: World, goal: ConfigurationGoal, policy: ExpansionPolicy
) -> ConfigurationGoal:
    """A joint goal inside the limits and free.

    Raises:
        ValueError: it is not; or there are several, and the planner takes one.
    """
    if np.ndim(goal.q) < 2:
        q = checks.check_start(robot, world, goal.q, what="goal")
        return dataclasses.replace(goal, q=jnp.asarray(q))
    if not isinstance(policy, RRTConnect):
        raise ValueError(
            f"{type(policy).__name__} takes one goal; expected q (D,), or planner 'rrt-connect'"
        )
    all_q = [checks.check_start(robot, world, q, what=f"goal {k}") for k, q in enumerate(goal.q)]
    if not all_q:
        raise ValueError("the goal is an empty list; expected one configuration (D,) at least")
    return dataclasses.replace(goal, q=jnp.asarray(np.stack(all_q)))


def _needs_configuration(planner: str, goal: AnyGoal) -> str:
    return (
        f"planner '{planner}' needs a ConfigurationGoal, and the goal is a "
        f"{type(goal).__name__}; expected planner '{VISUAL}'"
    )


def _image_goal(
    self_model: SelfModel, inputs: tuple[Any, ...], mask: Image | None
) -> tuple[ImageGoal, tuple[Any, ...]]:
    """The goal of the second form of :func:`plan`, and what follows it."""
    camera, image, *rest = counted(inputs, "camera", "goal_image", "q_start")
    return ImageGoal(self_model, camera, image, mask), tuple(rest)


def counted(inputs: tuple[Any, ...], *names: str) -> tuple[Any, ...]:
    """What follows the goal.

    Raises:
        ValueError: it is not as many things as these names.
    """
    if len(inputs) != len(names):
        raise ValueError(f"got {len(inputs)} inputs after the goal; expected {', '.join(names)}")
    return inputs
