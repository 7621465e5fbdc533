"""The goal image beside the robot where a path ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import PlanResult
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.robots.robot import Robot
from vrrt_jax.splat.raster import render
from vrrt_jax.visual.goal import ImageGoal

PICTURE_PX = 160  # height of the two pictures
_PAPER = 0.97  # gray behind the robot


@dataclasses.dataclass(frozen=True)
class EndPicture:
    """Draws a result: the first goal image, and the end of the path as the self-model sees it."""

    goal: ImageGoal
    robot: Robot
    caption = "the goal image, and the end of the path"

    @single_precision
    def __call__(self, result: PlanResult) -> np.ndarray:
        """The two pictures side by side: (H, W, 3) uint8."""
        view = self.goal.at(self.robot, PICTURE_PX)
        camera = jax.tree.map(lambda leaf: leaf[0], view.cameras)
        end = link_poses(self.robot.chain, jnp.asarray(result.path[-1], jnp.float32))
        pictures = [(view.image.rgb[0], view.image.alpha[0])]
        pictures.append(jax.jit(render)(view.splats, end, camera))
        over = [np.asarray(rgb + _PAPER * (1 - alpha[..., None])) for rgb, alpha in pictures]
        return np.round(255 * np.concatenate(over, axis=1).clip(0, 1)).astype(np.uint8)
