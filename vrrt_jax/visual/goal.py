"""Image goals: what users give, and what the planner compares with at one resolution."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.goal import LeastSquaresGoal
from vrrt_jax.core.types import pytree, static
from vrrt_jax.robots.kinematics import batch_link_poses
from vrrt_jax.robots.robot import Robot
from vrrt_jax.splat.images import View, check_views, mask_loss, outline_error_px, shrink_views
from vrrt_jax.splat.loss import (
    COLOR_WEIGHT,
    MATCH_COLOR_WEIGHT,
    block_means,
    weighted_goal,
    weighted_image,
)
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import Camera, GoalImage, SplatModel
from vrrt_jax.splat.windows import Windows, choose_windows

LEAST_HEIGHT = 0.75  # of an image for a close-up, in units of the height that it is meant for


@pytree
class ImageObjective(LeastSquaresGoal):
    """An image goal at one resolution: a goal of the kernel.

    A subclass may override :meth:`loss` or :meth:`residual`; see
    :class:`~vrrt_jax.core.goal.LeastSquaresGoal`.
    """

    splats: SplatModel
    windows: Windows | None  # how the rasterizer cuts its work, for these splats
    cameras: Camera  # leading axis V
    image: GoalImage
    threshold: Any  # () loss of a match
    color_weight: Any = COLOR_WEIGHT  # () of colors beside coverage
    blocks: tuple[int, ...] = static(default=())  # whose means are compared, instead of pixels [px]

    @property
    def judge(self) -> Self:
        """The same goal as it is judged: in other light than the self-model's a match stays one."""
        return dataclasses.replace(self, color_weight=jnp.float32(MATCH_COLOR_WEIGHT))

    def prediction(self, world: Any, q: jax.Array) -> jax.Array:
        """The rendered configuration (D,) as a weighted vector, in the goal's light.

        (V * H * W * 4,), or shorter where blocks are compared.
        """
        views = self.cameras, self.image
        seen = weighted_image(world.chain, self.splats, *views, q, self.windows, self.color_weight)
        return self._in_blocks(seen)

    def target(self) -> jax.Array:
        """The goal images as such a vector."""
        return self._in_blocks(weighted_goal(self.image, self.color_weight))

    def _in_blocks(self, seen: jax.Array) -> jax.Array:
        if not self.blocks:
            return seen
        return block_means(seen.reshape(*self.image.alpha.shape, 4), self.blocks)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CloseUp:
    """The goal images in full detail, of which a part around the outermost link is compared."""

    objective: ImageObjective  # of the whole images; its threshold is not used
    px: int  # height and width of the part
    threshold: float  # calibrated loss of a match, in units of the part's covered share
    outline_error_px: float  # how far off the robot's outline may be beyond that [px]
    match_scale: float  # of both


@dataclasses.dataclass(frozen=True)
class ImageGoal:
    """The robot should look like one image, or like several from several cameras.

    :func:`vrrt_jax.plan` checks it against the robot.
    """

    self_model: SelfModel  # how the robot looks
    camera: Camera | Sequence[Camera]  # the view of the image; or V of them
    # (H, W, 4) RGB and mask, or (H, W, 3) on a plain background; uint8, uint16, or float in
    # [0, 1]; or V
    image: np.ndarray | Sequence[np.ndarray]
    # (H, W) bool, or 0 and 1, or 0 and 255: true for the pixels that are compared, where not all
    # are; or V of them, None where all are
    mask: np.ndarray | Sequence[np.ndarray | None] | None = None
    # A subclass may change the loss. The threshold stays the one that is calibrated for the loss of
    # ImageObjective, times the setting match.scale.
    objective: type[ImageObjective] = ImageObjective

    @property
    def views(self) -> tuple[list[Camera], list[np.ndarray], list[np.ndarray | None] | None]:
        """Cameras, images and masks of V views."""
        if isinstance(self.camera, Camera):
            masks = None if self.mask is None else [np.asarray(self.mask)]
            return [self.camera], [self.image], masks  # type: ignore[list-item] - one image
        masks = None if self.mask is None else list(self.mask)
        return list(self.camera), list(self.image), masks

    @functools.cached_property
    def checked(self) -> list[View]:
        """The V views in full size; raises a ValueError if one of them makes no sense."""
        cameras, images, masks = self.views
        return check_views(images, cameras, masks)

    def at(
        self,
        robot: Robot,
        image_px: int,
        match_scale: float = 1.0,
        blocks: tuple[int, ...] = (),
    ) -> ImageObjective:
        """The goal on images of one height.

        Args:
            robot: whose goal it is.
            image_px: height that the images are shrunk to [px].
            match_scale: the threshold, in units of the self-model's calibrated one.
            blocks: whose means are compared, instead of pixels [px].

        Raises:
            ValueError: an image, a camera or a mask makes no sense, or the masks leave nothing of
                the robot.
        """
        image, shrunk_cameras = shrink_views(self.checked, image_px)
        if not jnp.any(image.valid * image.alpha > 0):
            raise ValueError(
                f"the masks leave nothing of the robot on images of {image.alpha.shape[1]} px; "
                "larger tree.image_px, polish.coarse_px and polish.px keep more of it"
            )
        level = self.self_model.level_for(image.alpha.shape[1])
        splats, windows = _windowed(robot, level.splats, shrunk_cameras)
        # The calibrated threshold is in units of the share of the image that the robot covers.
        covered = float(jnp.sum(image.valid * image.alpha) / jnp.sum(image.valid))
        expected = level.match_threshold * covered
        # At most as much again: a ragged mask or a tiny picture must not let everything match.
        expected += min(expected, mask_loss(image, outline_error_px(self.checked, image_px)))
        return self.objective(
            splats=splats,
            windows=windows,
            cameras=shrunk_cameras,
            image=image,
            threshold=match_scale * expected,
            color_weight=jnp.float32(COLOR_WEIGHT),
            blocks=blocks,
        )

    def close_up(self, image_px: int, match_scale: float = 1.0) -> CloseUp | None:
        """The goal for a close-up of the hand; None where the images are much smaller.

        Args:
            image_px: height of the whole images that the close-up is cut from [px].
            match_scale: see :meth:`at`.
        """
        image, shrunk_cameras = shrink_views(self.checked, image_px)
        if image.alpha.shape[1] < LEAST_HEIGHT * image_px:
            return None
        level = self.self_model.close_up
        objective = self.objective(
            splats=level.splats,
            windows=None,
            cameras=shrunk_cameras,
            image=image,
            threshold=0.0,
            color_weight=jnp.float32(COLOR_WEIGHT),
        )
        return CloseUp(
            objective=objective,
            px=level.size_px,
            threshold=level.match_threshold,
            outline_error_px=outline_error_px(self.checked, image_px),
            match_scale=match_scale,
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
