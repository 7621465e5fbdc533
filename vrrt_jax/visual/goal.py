"""From images and settings to the policies that compare with them."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax import checks
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.search import Termination, make_termination
from vrrt_jax.robots.kinematics import batch_link_poses
from vrrt_jax.robots.robot import Robot
from vrrt_jax.splat.images import prepare_goal
from vrrt_jax.splat.lanes import LANES
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import Camera, SplatModel
from vrrt_jax.splat.windows import Windows, choose_windows
from vrrt_jax.visual.policy import Probing, VisualPolicy
from vrrt_jax.visual.polish import Closer, CloseUp, Polishing

LEAST_HEIGHT = 0.75  # of an image for a close-up, in units of the height that it is meant for


class Sight:
    """A robot's goal images, to be compared with at any resolution.

    Args:
        robot: the robot.
        self_model: how it looks.
        camera: of the goal image; or V of them.
        goal_image: as for :func:`vrrt_jax.plan`; or V of them.
        mask: pixels that are compared, None for all; or V of them.
    """

    def __init__(
        self,
        robot: Robot,
        self_model: SelfModel,
        camera: Camera | Sequence[Camera],
        goal_image: Any,
        mask: Any = None,
    ):
        """Raise a ValueError if the self-model is of another robot."""
        checks.check_self_model(robot, self_model)
        if isinstance(camera, Camera):
            camera, goal_image, mask = [camera], [goal_image], None if mask is None else [mask]
        self.robot, self.self_model = robot, self_model
        self.cameras, self.images, self.masks = camera, goal_image, mask

    def at(self, image_px: int, match_scale: float) -> tuple[dict[str, Any], float]:
        """Fields of a :class:`VisualPolicy` for images of a height, and the loss of a match.

        Raises:
            ValueError: the masks leave nothing of the robot.
        """
        goal, cameras = prepare_goal(self.images, self.cameras, image_px, self.masks)
        if not jnp.any(goal.valid * goal.alpha > 0):
            raise ValueError(
                f"the masks leave nothing of the robot on images of {goal.alpha.shape[1]} px; "
                "a larger image_px, probe_px and polish_px keep more where many pixels are hidden"
            )
        level = self.self_model.level_for(goal.alpha.shape[1])
        splats, windows = _windowed(self.robot, level.splats, cameras)
        covered = float(jnp.sum(goal.valid * goal.alpha) / jnp.sum(goal.valid))
        fields = {"splats": splats, "windows": windows, "cameras": cameras, "goal": goal}
        return fields, match_scale * level.match_threshold * covered

    def close_up(self, policy: VisualPolicy, image_px: int, match_scale: float) -> CloseUp | None:
        """How to look at a part of images of a height; not at all, where they are much smaller."""
        goal, cameras = prepare_goal(self.images, self.cameras, image_px, self.masks)
        if goal.alpha.shape[1] < LEAST_HEIGHT * image_px:
            return None
        level = self.self_model.close_up
        seen = {"splats": level.splats, "windows": None, "cameras": cameras, "goal": goal}
        return CloseUp(
            policy=dataclasses.replace(policy, **seen),
            px=level.size_px,
            match_threshold=match_scale * level.match_threshold,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setup:
    """A visual problem, ready to be searched."""

    policy: VisualPolicy
    goal_loss: float  # that counts as matched
    probing: Probing
    polishing: Polishing | None


def visual_setup(sight: Sight, q_start: np.ndarray, config: PlannerConfig) -> Setup:
    """All that :func:`vrrt_jax.plan` needs, at the resolutions of a configuration."""
    policy, goal_loss = visual_policy(sight, q_start, config)
    return Setup(
        policy=policy,
        goal_loss=goal_loss,
        probing=visual_probing(sight, policy, config),
        polishing=(
            visual_polishing(sight, policy, goal_loss, q_start, config)
            if config.hypotheses
            else None
        ),
    )


def visual_policy(
    sight: Sight, q_start: np.ndarray, config: PlannerConfig
) -> tuple[VisualPolicy, float]:
    """The policy of the search, and the loss that counts as matched."""
    fields, goal_loss = sight.at(config.image_px, config.match_scale)
    checks.check_cameras(sight.robot, fields["splats"], fields["cameras"], q_start)
    numbers = {
        "alpha": config.alpha,
        "epsilon": config.epsilon,
        "kappa": config.kappa,
        "eta": config.eta,
        "exploration": config.exploration,
        "beta1": config.beta1,
        "beta2": config.beta2,
        "anneal_loss": config.anneal * goal_loss,
        "rewire_radius": config.rewire_radius,
    }
    policy = VisualPolicy(
        **fields,
        **{name: jnp.float32(value) for name, value in numbers.items()},
        inherit=jnp.asarray(config.inherit),
        rewiring=config.rewiring,
        lanes=config.lanes,
    )
    return policy, goal_loss


def visual_probing(sight: Sight, policy: VisualPolicy, config: PlannerConfig) -> Probing:
    """Where to look before the search."""
    fields, _ = sight.at(config.probe_px, config.match_scale)
    coarse = dataclasses.replace(policy, **fields, alpha=jnp.float32(config.probe_alpha))
    kept = min(config.probes, config.probes_kept)
    parts = -(-kept // LANES)
    return Probing(
        policy=coarse,
        radius=jnp.float32(config.probe_radius),
        rounds=jnp.int32(config.probe_rounds),
        steps=jnp.int32(config.probe_steps),
        parts=parts,
        num=-(-config.probes // max(parts, 1)),
        kept=-(-kept // max(parts, 1)),
    )


def visual_polishing(
    sight: Sight,
    policy: VisualPolicy,
    coarse_goal_loss: float,
    q_start: np.ndarray,
    config: PlannerConfig,
) -> Polishing:
    """How matches are looked at after the search."""
    fields, goal_loss = sight.at(config.polish_px, config.match_scale)
    close_px, match_scale = config.close_px, config.match_scale

    def closer(policy: VisualPolicy, goal_loss: float) -> Closer:
        prior = jnp.float32(config.start_prior * goal_loss)
        return Closer(policy=policy, q_start=jnp.asarray(q_start), prior=prior)

    return Polishing(
        coarse=closer(policy, coarse_goal_loss),
        fine=closer(dataclasses.replace(policy, **fields), goal_loss),
        close_up=sight.close_up(policy, close_px, match_scale) if close_px else None,
        coarse_goal_loss=coarse_goal_loss,
        goal_loss=goal_loss,
        samples=config.polish_samples,
        lanes=config.polish_lanes,
        kept=config.polish_kept,
        rounds=config.polish_rounds,
        spread=config.polish_spread,
        steps=config.polish_steps,
    )


def visual_termination(config: PlannerConfig, goal_loss: float) -> Termination:
    """When the search ends."""
    return make_termination(
        goal_loss,
        settle=config.settle,
        max_iterations=config.max_iterations,
        patience=config.patience,
        min_improvement=config.min_improvement,
        min_ratio=config.min_ratio,
    )


def _windowed(
    robot: Robot, splats: SplatModel, cameras: Camera
) -> tuple[SplatModel, Windows | None]:
    """The splats in clusters, with windows of the image that hold most of them in every view."""
    rng = np.random.default_rng(0)
    q = jnp.asarray(rng.uniform(robot.lower, robot.upper, (64, robot.num_joints)), jnp.float32)
    poses = batch_link_poses(robot.chain, q)
    found = [
        choose_windows(splats, poses, jax.tree.map(lambda leaf: leaf[view], cameras))  # noqa: B023
        for view in range(len(cameras.focal))
    ]
    if any(windows is None for _, windows in found):
        return splats, None
    return max(found, key=lambda pair: pair[1].size_px if pair[1] is not None else 0)
