"""The thresholds of a self-model: the loss of correct poses, however the goal image is taken.

The true meshes are rendered at random poses with random cameras, under the lamp of training and
under lamps from anywhere, and photographed in several ways. A threshold is met by 95 % of correct
poses in the hardest of these conditions.
"""

import contextlib
import dataclasses
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from tqdm import tqdm

from vrrt_jax.core.precision import single_precision
from vrrt_jax.robots.kinematics import Chain, link_poses
from vrrt_jax.splat.fit_config import FitConfig
from vrrt_jax.splat.images import View, shrink_views
from vrrt_jax.splat.loss import MATCH_COLOR_WEIGHT, weighted, weighted_goal
from vrrt_jax.splat.model import Level, SelfModel
from vrrt_jax.splat.mujoco_images import MeshRenderer
from vrrt_jax.splat.photographs import Photograph, photograph
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.training_images import random_cameras, random_configurations
from vrrt_jax.splat.types import Camera, GoalImage, SplatModel

PHOTOGRAPHS = {
    "as trained": Photograph(),
    "twice as bright": Photograph(brightness=2.0),
    "half as bright, noise, JPEG": Photograph(brightness=0.5, noise=0.05, jpeg=60),
    "estimated mask": Photograph(mask="estimated"),
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

    for i, camera in enumerate(tqdm(cameras, desc="calibrating", unit="pose", leave=False)):
        views = {}
        picture = trained.picture(q[i], camera)
        for name, how in PHOTOGRAPHS.items():
            how = dataclasses.replace(how, background=BACKGROUNDS[i % len(BACKGROUNDS)])
            # The border of a close-up does not show the background. And a robot in its color is
            # nobody's goal image.
            with contextlib.suppress(ValueError):
                if tip is None or how.mask == "true":
                    views[name] = _view(*photograph(picture, how, rng), camera)
        other = others[i % LAMPS].picture(q[i], camera)
        views[OTHER_LAMP] = _view(other.rgb, other.alpha, camera)
        for level, of_level in zip(levels, found, strict=True):
            for name, loss in zip(views, _losses(robot, level, views.values(), q[i]), strict=True):
                of_level.setdefault(name, []).append(loss)
    return found


def _downwards(rng: np.random.Generator) -> list[float]:
    """A random direction (3,) that does not point up."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    return [*direction[:2].tolist(), -abs(float(direction[2]))]


def _view(rgb: np.ndarray, alpha: np.ndarray, camera: Camera) -> View:
    return View(rgb=rgb, alpha=alpha, valid=np.ones_like(alpha), camera=camera)


def _losses(robot, level: Level, views: Iterable[View], q: np.ndarray) -> list[float]:
    """Losses of views of one camera at their configuration (D,), which is drawn once."""
    goals, cameras = zip(*(shrink_views([view], level.size_px) for view in views), strict=True)
    image = _draw(robot.chain, level.splats, cameras[0], jnp.asarray(q, jnp.float32))
    covered = (max(float(goal.alpha.mean()), LEAST_COVERED) for goal in goals)
    return [float(_loss(image, goal)) / share for goal, share in zip(goals, covered, strict=True)]


@jax.jit
def _draw(chain: Chain, splats: SplatModel, cameras: Camera, q: jax.Array):
    camera = jax.tree.map(lambda leaf: leaf[0], cameras)
    return jax.tree.map(lambda a: a[None], render(splats, link_poses(chain, q), camera))


@jax.jit
def _loss(image: tuple[jax.Array, jax.Array], goal: GoalImage) -> jax.Array:
    drawn = weighted(*image, goal, MATCH_COLOR_WEIGHT)
    return jnp.sum((drawn - weighted_goal(goal, MATCH_COLOR_WEIGHT)) ** 2)


def _threshold(of_level: dict[str, list]) -> float:
    hardest = max(float(np.quantile(losses, MATCHED)) for losses in of_level.values())
    return float(f"{hardest:.4g}")
