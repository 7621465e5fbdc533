"""A picture that shows how well a self-model was fitted: MuJoCo's images above the self-model's."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from PIL import Image

from vrrt_jax.core.files import replacing
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.splat.calibrate import outermost
from vrrt_jax.splat.fit_config import FitConfig
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.mujoco_images import MeshRenderer
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.training_images import random_cameras, random_configurations

NUM = 4  # unseen poses, of which the last is a close-up of the outermost link
PANEL_PX = 256
BETWEEN_PX = 2
BACKGROUND = (0.68, 0.76, 0.86)  # that robots, most of them white or dark, stand out from


def save_fit_picture(
    robot, spec: mujoco.MjSpec, model: SelfModel, path: Path, *, seed: int, config: FitConfig
) -> None:
    """Write a picture of a few unseen poses, as MuJoCo and as the self-model draw them.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        spec: the robot with its visual meshes.
        model: its self-model.
        path: a ``.png`` file.
        seed: of poses and cameras.
        config: the cameras' ranges.

    Raises:
        RuntimeError: OpenGL is not available.
    """
    rng = np.random.default_rng(seed)
    q = random_configurations(robot, NUM, rng)
    cameras = random_cameras(robot, config, q, None, rng)
    cameras[-1] = random_cameras(robot, config, q, outermost(model), rng)[-1]
    renderer, columns = MeshRenderer(spec), []
    for index, camera in enumerate(cameras):
        is_close = index == NUM - 1
        level = model.close_up if is_close else model.level_for(camera.height)
        picture = renderer.picture(q[index], camera)
        poses = link_poses(robot.chain, jnp.asarray(q[index], jnp.float32))
        drawn = jax.jit(render)(level.splats, poses, camera)
        columns.append(
            np.concatenate([_panel(picture.rgb, picture.alpha), _panel(*map(np.asarray, drawn))])
        )
    with replacing(path) as file:
        Image.fromarray(np.concatenate(columns, axis=1)).save(file, "PNG")


def _panel(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """An image over the background (PANEL_PX, PANEL_PX, 3) uint8, with a white border."""
    pixels = np.clip(rgb + (1.0 - alpha[..., None]) * np.array(BACKGROUND), 0.0, 1.0)
    image = Image.fromarray(np.round(255 * pixels).astype(np.uint8))
    inner = PANEL_PX - 2 * BETWEEN_PX
    panel = np.full((PANEL_PX, PANEL_PX, 3), 255, np.uint8)
    resized = np.asarray(image.resize((inner, inner), Image.Resampling.BICUBIC))
    panel[BETWEEN_PX:-BETWEEN_PX, BETWEEN_PX:-BETWEEN_PX] = resized
    return panel
