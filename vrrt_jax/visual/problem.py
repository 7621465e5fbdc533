"""A visual problem, ready to be searched: the goal at every resolution that a plan needs."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrrt_jax import checks
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.goal import LeastSquaresGoal
from vrrt_jax.core.types import Goal
from vrrt_jax.robots.robot import Robot
from vrrt_jax.visual.goal import ImageGoal
from vrrt_jax.visual.least_squares import Objective, Parabola
from vrrt_jax.visual.polish import Polishing

SOFT_BLOCKS = (2, 4)  # [px] of the image that is searched


@dataclasses.dataclass(frozen=True, kw_only=True)
class VisualProblem:
    """The goal of the search, and of the polishing after it."""

    goal: Goal
    polishing: Polishing | None  # None where nothing is to be polished


def make_problem(
    robot: Robot, goal: ImageGoal | Goal, q_start: np.ndarray, config: PlannerConfig
) -> VisualProblem:
    """Prepare a goal.

    An :class:`ImageGoal` is shrunk to the resolution of each stage. Any other goal with a
    differentiable loss serves all stages as it is; it is polished if it is a
    :class:`~vrrt_jax.core.goal.LeastSquaresGoal`.

    Args:
        robot: whose goal it is.
        goal: where to.
        q_start: (D,), which the cameras have to see.
        config: resolutions, and what each stage does.

    Raises:
        ValueError: an image, a camera, a mask or the self-model makes no sense.
    """
    close_up = None
    if isinstance(goal, ImageGoal):
        checks.check_self_model(robot, goal.self_model)
        scale = config.match.scale
        # What is judged on the image that is searched is judged by its pixels.
        blocks = SOFT_BLOCKS if config.polish.hypotheses else ()
        search_goal: Any = goal.at(robot, config.tree.image_px, scale, blocks)
        checks.check_cameras(robot, search_goal.splats, search_goal.cameras, q_start)
        coarse_goal = fine_goal = search_goal
        if config.polish.hypotheses:
            coarse_goal = goal.at(robot, config.polish.coarse_px, scale)
            fine_goal = goal.at(robot, config.polish.px, scale)
            if config.polish.close_px:
                close_up = goal.close_up(config.polish.close_px, scale)
        has_residuals = True
    else:
        search_goal = coarse_goal = fine_goal = goal
        has_residuals = isinstance(goal, LeastSquaresGoal)
    polishing = None
    if config.polish.hypotheses and has_residuals:
        polishing = Polishing(
            soft=_with_prior(search_goal, q_start, config),
            coarse=_with_prior(coarse_goal, q_start, config),
            fine=_with_prior(fine_goal, q_start, config),
            close_up=close_up,
            config=config.polish,
        )
    return VisualProblem(goal=search_goal, polishing=polishing)


def _with_prior(goal: Any, q_start: np.ndarray, config: PlannerConfig) -> Objective:
    """A goal, and a weak preference for configurations near the start."""
    joints, weight = len(q_start), config.polish.start_prior * float(goal.threshold)
    prior = Parabola(
        q=jnp.asarray(q_start),
        cost=jnp.float32(0),
        slope=jnp.zeros(joints),
        matrix=weight * jnp.eye(joints),
    )
    return Objective(goal=goal, weight=jnp.float32(1), prior=prior)
