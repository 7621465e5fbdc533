"""Train the splats of one level of detail on images, with a checkpoint every 50 steps."""

import dataclasses
import math
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.files import replacing
from vrrt_jax.robots.kinematics import Chain, link_poses
from vrrt_jax.splat.fit_config import LevelConfig
from vrrt_jax.splat.initial_splats import initial_splats
from vrrt_jax.splat.loss import image_loss, psnr_db
from vrrt_jax.splat.model import Level
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.training_images import TrainingImages, shrink
from vrrt_jax.splat.types import SplatModel

CHECKPOINT_STEPS = 50
TRAINED = ("mean", "radius", "density", "rgb", "view_color_gradient", "tau")
ADAM = optax.scale_by_adam(b1=0.9, b2=0.99)
MIN_TAU = 0.03  # [m] the softness of occlusion stays above this


class OutOfTime(Exception):
    """The time for training is up; what was done is kept in a checkpoint."""


def fit_level(
    robot,
    train: TrainingImages,
    held_out: TrainingImages,
    points: np.ndarray,
    level: LevelConfig,
    *,
    learning_rate: float,
    seed: int,
    file: Path,
    trained: SplatModel | None = None,
    deadline: float = math.inf,
) -> Level:
    """Train the splats of one level of detail.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        train: images to train with.
        held_out: images to validate with.
        points: (m, 7) surface points that the splats start from.
        level: number of splats and steps, size of the images.
        learning_rate: of the first step.
        seed: of the start and the order of the images.
        file: the checkpoint. A training that was interrupted goes on from it.
        trained: splats of an earlier round to start from, instead of from the points.
        deadline: when the time is up, of :func:`time.monotonic` [s].

    Raises:
        OutOfTime: at the deadline; the checkpoint is written.
    """
    train, held_out = shrink(train, level.size_px), shrink(held_out, level.size_px)
    start = initial_splats(points, level.num_splats, seed) if trained is None else trained
    change = {name: jnp.zeros_like(getattr(start, name)) for name in TRAINED}
    rate = optax.cosine_decay_schedule(learning_rate, level.steps, 0.02)
    state = ADAM.init(change)

    # Each step takes the first images of an order of its own, which does not depend on where the
    # training was interrupted.
    rng = np.random.default_rng(seed)
    order = rng.permuted(np.tile(np.arange(len(train.q)), (level.steps, 1)), axis=1)
    first = 0
    if file.exists():
        change, state, first = restore_checkpoint(file, change, state)
    progress = tqdm(
        range(first, level.steps),
        desc=f"{level.num_splats} splats, {level.size_px} px",
        initial=first,
        total=level.steps,
        unit="step",
    )
    for i in progress:
        if time.monotonic() > deadline:
            _store_checkpoint(file, change, state, i)
            raise OutOfTime
        images = _batch(train, order[i, : level.batch])
        change, state, value = _step(robot.chain, start, change, state, rate(i), *images)
        if (i + 1) % CHECKPOINT_STEPS == 0 or i + 1 == level.steps:
            progress.set_postfix_str(f"{psnr_db(float(value)):.1f} dB")
            _store_checkpoint(file, change, state, i + 1)

    splats = jax.tree.map(jax.lax.stop_gradient, _assemble(start, change))
    losses = _validate(robot, splats, held_out)
    return Level(
        splats=splats,
        size_px=level.size_px,
        psnr_db=round(psnr_db(float(losses.mean())), 2),
        match_threshold=math.nan,  # until it is calibrated
    )


def better(robot, held_out: TrainingImages, before: Level | None, found: Level) -> Level:
    """Of two levels for images of one size, the one that does better on unseen images."""
    if before is None:
        return found
    losses = _validate(robot, before.splats, shrink(held_out, before.size_px))
    before = dataclasses.replace(before, psnr_db=round(psnr_db(float(losses.mean())), 2))
    return max(before, found, key=lambda level: level.psnr_db)


def _assemble(start: SplatModel, change: dict[str, jax.Array]) -> SplatModel:
    """Splats from unconstrained changes, scaled so that one learning rate suits all."""
    return dataclasses.replace(
        start,
        mean=start.mean + 0.02 * change["mean"],
        radius=start.radius * jnp.exp(0.5 * change["radius"]),
        density=start.density * jnp.exp(change["density"]),
        rgb=start.rgb + 0.5 * change["rgb"],
        view_color_gradient=start.view_color_gradient + 0.5 * change["view_color_gradient"],
        tau=MIN_TAU + (start.tau - MIN_TAU) * jnp.exp(change["tau"]),
    )


@jax.jit
def _step(chain: Chain, start: SplatModel, change, state, rate, *batch):
    """Changes, optimizer's state and the mean loss after a step on a batch of images.

    All numbers are arguments, so that one program serves all rounds of training.
    """

    def loss(change, *image):
        return _loss(chain, _assemble(start, change), *image)

    # One image after the other, with the memory of one.
    def add(total, image):
        return jax.tree.map(jnp.add, total, jax.value_and_grad(loss)(change, *image)), None

    zero = (jnp.float32(0), jax.tree.map(jnp.zeros_like, change))
    sums, _ = jax.lax.scan(add, zero, batch)
    value, gradient = jax.tree.map(lambda total: total / len(batch[0]), sums)
    updates, state = ADAM.update(gradient, state)
    change = jax.tree.map(lambda c, update: c - rate * update, change, updates)
    return change, state, value


def _batch(images: TrainingImages, rows: np.ndarray | int) -> tuple[Any, ...]:
    """Configurations, cameras, colors and alphas of some images, or of one."""
    return (
        jnp.asarray(images.q[rows], jnp.float32),
        jax.tree.map(lambda leaf: leaf[rows], images.cameras),
        jnp.asarray(images.rgb[rows]),
        jnp.asarray(images.alpha[rows]),
    )


def _validate(robot, splats: SplatModel, images: TrainingImages) -> np.ndarray:
    """Losses (n,) at the true poses, in the light of training."""
    views = (_batch(images, i) for i in range(len(images.q)))
    return np.array([float(_loss(robot.chain, splats, *view)) for view in views])


@jax.jit
def _loss(chain: Chain, splats: SplatModel, q, camera, rgb, alpha) -> jax.Array:
    image = render(splats, link_poses(chain, q), camera)
    return image_loss(*image, rgb, alpha, jnp.ones_like(alpha))


def _store_checkpoint(file: Path, change, state, steps: int) -> None:
    leaves: list[Any] = [np.asarray(leaf) for leaf in jax.tree.leaves((change, state))]
    with replacing(file) as handle:
        np.savez(handle, steps=steps, **{f"leaf_{i}": leaf for i, leaf in enumerate(leaves)})


def restore_checkpoint(file: Path, change, state):
    """Changes, optimizer's state and number of steps done; the arguments give the structure."""
    structure = jax.tree.structure((change, state))
    names = [f"leaf_{i}" for i in range(structure.num_leaves)]
    saved = read_arrays(file, "steps", *names)
    change, state = jax.tree.unflatten(structure, [jnp.asarray(saved[name]) for name in names])
    return change, state, int(saved["steps"])
