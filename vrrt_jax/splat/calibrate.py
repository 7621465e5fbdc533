"""The thresholds of a self-model: the loss of correct poses, however the goal image is taken.

The true meshes are rendered at random poses with random cameras, under the lamp of training and
under lamps from anywhere, and photographed in several ways. A threshold is met by 95 % of correct
poses in the hardest of these conditions.
"""

import contextlib
import dataclasses

import jax
import mujoco
import numpy as np
from tqdm import tqdm

from vrrt_jax.core.precision import single_precision
from vrrt_jax.splat.fit_config import FitConfig
from vrrt_jax.splat.images import View, shrink_views
from vrrt_jax.splat.loss import goal_loss
from vrrt_jax.splat.model import Level, SelfModel
from vrrt_jax.splat.mujoco_images import MeshRenderer
from vrrt_jax.splat.photographs import Photograph, photograph
from vrrt_jax.splat.training_images import random_cameras, random_configurations
from vrrt_jax.splat.types import Camera

PHOTOGRAPHS = {
    "as trained": Photograph(),
    "twice as bright": Photograph(brightness=2.0),
    "half as bright, noise, JPEG": Photograph(brightness=0.5, noise=0.05, jpeg=60),
    "estimated mask, JPEG": Photograph(jpeg=60, mask="estimated"),
}
BACKGROUNDS = ((0.1, 0.5, 0.2), (0.1, 0.2, 0.7), (0.8, 0.2, 0.6))  # of estimated masks, in turns
OTHER_LAMP = "another lamp"
LAMPS = 6  # that shine from far away, in turns
MATCHED = 0.95  # share of correct poses that match, in each condition
LEAST_COVERED = 1e-3  # share of an image


@single_precision
def calibrate(
    robot, spec: mujoco.MjSpec, model: SelfModel, *, seed: int, config: FitConfig
) -> SelfModel:
    """The same self-model with new thresholds.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        spec: the robot with its visual meshes.
        model: the self-model.
        seed: of poses, cameras, lamps and noise; another one than that of training.
        config: number of images (``num_validation``), their sizes and the cameras' ranges.

    Raises:
        RuntimeError: OpenGL is not available.
    """
    whole = losses(robot, spec, model.levels, None, seed=seed, config=config)
    near = losses(robot, spec, [model.close_up], outermost(model), seed=seed, config=config)
    *levels, close_up = (
        dataclasses.replace(level, match_threshold=_threshold(of_level))
        for level, of_level in zip((*model.levels, model.close_up), (*whole, *near), strict=True)
    )
    return dataclasses.replace(model, levels=tuple(levels), close_up=close_up)


def outermost(model: SelfModel) -> tuple[int, np.ndarray]:
    """The outermost link, and the middle (3,) of its splats in its frame [m]."""
    link = np.asarray(model.close_up.splats.link)
    return int(link[-1]), np.asarray(model.close_up.splats.mean)[link == link[-1]].mean(axis=0)


def losses(robot, spec, levels, tip, *, seed: int, config: FitConfig) -> list[dict[str, list]]:
    """Losses at correct poses, by level and condition, in units of the covered share.

    Args:
        robot: see :func:`calibrate`.
        spec: see :func:`calibrate`.
        levels: of detail.
        tip: a link and a point (3,) in its frame [m], for close-ups of it; None for whole images.
        seed: see :func:`calibrate`.
        config: see :func:`calibrate`.
    """
    rng = np.random.default_rng(seed)
    q = random_configurations(robot, config.num_validation, rng)
    config = dataclasses.replace(config, image_px=config.close_up_of_px)
    cameras = random_cameras(robot, config, q, tip, rng)
    trained = MeshRenderer(spec)
    others = [MeshRenderer(spec, shines=_downwards(rng)) for _ in range(LAMPS)]
    found: list[dict[str, list]] = [{} for _ in levels]

    def add(condition: str, view: View, q: np.ndarray) -> None:
        for level, of_level in zip(levels, found, strict=True):
            of_level.setdefault(condition, []).append(_loss(robot, level, view, q))

    for i, camera in enumerate(tqdm(cameras, desc="calibrating", unit="pose", leave=False)):
        picture = trained.picture(q[i], camera)
        for name, how in PHOTOGRAPHS.items():
            how = dataclasses.replace(how, background=BACKGROUNDS[i % len(BACKGROUNDS)])
            # The border of a close-up does not show the background. And a robot in its color is
            # nobody's goal image.
            with contextlib.suppress(ValueError):
                if tip is None or how.mask == "true":
                    add(name, _view(*photograph(picture, how, rng), camera), q[i])
        other = others[i % LAMPS].picture(q[i], camera)
        add(OTHER_LAMP, _view(other.rgb, other.alpha, camera), q[i])
    return found


def _downwards(rng: np.random.Generator) -> list[float]:
    """A random direction (3,) that does not point up."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    return [*direction[:2].tolist(), -abs(float(direction[2]))]


def _view(rgb: np.ndarray, alpha: np.ndarray, camera: Camera) -> View:
    return View(rgb=rgb, alpha=alpha, valid=np.ones_like(alpha), camera=camera)


def _loss(robot, level: Level, view: View, q: np.ndarray) -> float:
    goal, camera = shrink_views([view], level.size_px)
    loss = _goal_loss(robot.chain, level.splats, camera, goal, q.astype(np.float32))
    return float(loss) / max(float(goal.alpha.mean()), LEAST_COVERED)


_goal_loss = jax.jit(goal_loss)


def _threshold(of_level: dict[str, list]) -> float:
    hardest = max(float(np.quantile(losses, MATCHED)) for losses in of_level.values())
    return float(f"{hardest:.4g}")
