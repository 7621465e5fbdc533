"""Train a robot's self-model on MuJoCo's images of its true meshes.

Splats start on the visible surface, as depth images see it, and are refined photometrically, one
level of detail after the other. The last level is for a close-up of the outermost link, a hand or a
tool, whose turn an image of the whole robot hardly shows.
"""

import dataclasses
import hashlib
import json
import math
import time
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from vrrt_jax.core.files import write_text
from vrrt_jax.core.precision import single_precision
from vrrt_jax.robots.mesh_sources import mesh_file
from vrrt_jax.splat.calibrate import calibrate
from vrrt_jax.splat.fit_config import FitConfig, LevelConfig, check_fit_config
from vrrt_jax.splat.fit_level import better, fit_level
from vrrt_jax.splat.model import Level, SelfModel, save_self_model
from vrrt_jax.splat.training_images import (
    TrainingImages,
    outermost,
    read_images,
    render_images,
    write_images,
)

# Images to train and to validate with, and surface points (m, 7).
_Images = tuple[TrainingImages, TrainingImages, np.ndarray]


@single_precision
def fit_self_model(
    robot,
    spec: mujoco.MjSpec,
    path: str | Path,
    *,
    seed: int,
    config: FitConfig,
    earlier: SelfModel | None = None,
    deadline: float = math.inf,
) -> SelfModel:
    """Train a self-model and write it, level by level.

    Finished images and levels are kept beside ``path`` in ``<path>.work/`` until the end. A
    training that was interrupted goes on from there.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        spec: the robot with its visual meshes.
        path: where the ``.npz`` goes.
        seed: of poses, cameras and training.
        config: sizes and numbers of steps.
        earlier: a self-model of the robot whose splats are trained on. A level of it stays as it
            is if it does better on unseen images than what came of it.
        deadline: when the time is up, of :func:`time.monotonic` [s].

    Returns:
        The self-model.

    Raises:
        OutOfTime: at the deadline; the next call goes on.
        RuntimeError: OpenGL is not available.
        ValueError: a setting makes no sense, or ``<path>.work/`` belongs to another robot, seed or
            configuration.
    """
    check_fit_config(config)
    path, started = Path(path), time.perf_counter()
    work = path.with_name(path.name + ".work")
    _claim(work, robot, seed, config)

    def fit(images: _Images, level: LevelConfig, name: str, before: Level | None) -> Level:
        train, held_out, points = images
        found = fit_level(
            robot,
            train,
            held_out,
            points,
            level,
            learning_rate=config.learning_rate * (config.refining if before else 1.0),
            seed=seed,
            file=work / f"{name}.npz",
            trained=before.splats if before else None,
            deadline=deadline,
        )
        return better(robot, held_out, before, found)

    # Levels for images of the whole robot, and then the one for close-ups of the outermost link.
    # All rounds are validated with the same images, so that their figures can be compared.
    first = earlier.seed if earlier else seed
    images = _, _, points = _cached_images(robot, spec, config, work, (seed, first + 1), None)
    of_earlier = {level.size_px: level for level in (earlier.levels if earlier else ())}
    levels = []
    for level in config.levels:
        level = dataclasses.replace(level, num_splats=round(config.detail * level.num_splats))
        before = of_earlier.get(level.size_px)
        levels.append(fit(images, level, f"level_{len(levels)}", before))
    images = _cached_images(robot, spec, config, work, (seed, first + 1), outermost(points))
    close_up = fit(images, config.close_up, "close_up", earlier.close_up if earlier else None)

    uncalibrated = SelfModel(
        robot=robot.name,
        joint_names=robot.joint_names,
        levels=tuple(levels),
        close_up=close_up,
        seed=first,
        info=_info(config, earlier, time.perf_counter() - started),
    )
    model = calibrate(robot, spec, uncalibrated, seed=seed + 2, config=config)
    save_self_model(model, path)
    for file in work.iterdir():
        file.unlink()
    work.rmdir()
    return model


def _info(config: FitConfig, earlier: SelfModel | None, seconds: float) -> dict[str, Any]:
    """How a self-model was trained, in all rounds together."""
    before = earlier.info if earlier else {}
    return {
        "num_images": before.get("num_images", 0) + config.num_images,
        "num_validation": config.num_validation,
        "seconds": round(before.get("seconds", 0.0) + seconds, 1),
        "steps": [level.steps for level in (*config.levels, config.close_up)],  # of the last round
        "versions": {"jax": jax.__version__, "mujoco": mujoco.__version__},
    }


def _claim(work: Path, robot, seed: int, config: FitConfig) -> None:
    """Make the work folder ours, or check that it was already."""
    source = mesh_file(robot.mesh_source)
    what = robot.xml.encode() + (source.read_bytes() if source else b"")
    stamp = json.dumps(
        {
            "robot": robot.name,
            "content": hashlib.sha256(what).hexdigest(),
            "seed": seed,
            "config": dataclasses.asdict(config),
        },
        sort_keys=True,
    )
    work.mkdir(parents=True, exist_ok=True)
    file = work / "training.json"
    if file.exists() and file.read_text() != stamp:
        raise ValueError(
            f"'{work}' holds an unfinished training of another robot, seed or configuration; "
            "finish that one or delete the folder"
        )
    write_text(file, stamp)


def _cached_images(
    robot, spec, config: FitConfig, work: Path, seeds: tuple[int, int], tip
) -> _Images:
    """Images for training and for validation, and surface points; close-ups if there is a tip."""
    kind = "whole" if tip is None else "close_up"

    def cached(use: str, *numbers: int) -> tuple[TrainingImages, np.ndarray]:
        file = work / f"{kind}_{use}.npz"
        if not file.exists():
            write_images(file, *render_images(robot, spec, config, *numbers, tip=tip))
        return read_images(file)

    train, points = cached("train", config.num_images, seeds[0], config.num_surface_images)
    held_out, _ = cached("held_out", config.num_validation, seeds[1])
    return train, held_out, points
