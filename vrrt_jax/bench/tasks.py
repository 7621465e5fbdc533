"""The paper's protocol: seeded tasks at set distances, goal images from the true meshes."""

import dataclasses
import functools
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from vrrt_jax.bench.arm_problems import ArmProblems, read_problems
from vrrt_jax.bench.arm_trials import Refusal, pose_problem
from vrrt_jax.bench.worlds import random_world
from vrrt_jax.problems import load_world
from vrrt_jax.random_problem import AZIMUTH_DEG, free_pairs, front_camera
from vrrt_jax.robots import Robot, load_robot
from vrrt_jax.robots.mesh_sources import needed_mesh_spec
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import verify_path
from vrrt_jax.scene.world import (
    World,
    build_world,
    obstacle_list,
)
from vrrt_jax.splat.images import View
from vrrt_jax.splat.mujoco_images import MeshRenderer, Picture
from vrrt_jax.splat.photographs import Photograph, photograph
from vrrt_jax.splat.types import Camera

ROBOTS = ("panda", "ur5e", "fetch")
WORLDS_PER_ROBOT = 6
NUM_SLOTS = 12  # one shape for all worlds, so that none re-compiles
AZIMUTHS_DEG = (AZIMUTH_DEG, 90.0)  # of the first and the second view: the front, the right
SIDE = "side"  # the light of a lamp far away, to the left of the robot
SHINES = (0.0, -0.87, -0.5)  # where that lamp shines
RANDOM = "random"  # the level of pairs drawn anywhere inside the limits


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scenery:
    """What goal images look like."""

    views: int = 1
    azimuth_deg: float = 0.0  # added to the cameras' own
    light: float | str = 1.0  # brightness of the lamp on the camera; or SIDE, for one elsewhere
    noise: float = 0.0  # standard deviation of each channel of each pixel, of 1 for white
    jpeg: int | None = None  # quality of the file
    mask: str = "true"  # or "estimated", from a plain background
    occluded: bool = False  # obstacles are drawn, and the pixels that they take masked out

    @property
    def photograph(self) -> Photograph:
        """How the goal images are taken."""
        brightness = 1.0 if isinstance(self.light, str) else self.light
        return Photograph(brightness=brightness, noise=self.noise, jpeg=self.jpeg, mask=self.mask)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """Where from and where to; ``q_goal`` is for rendering and scoring alone."""

    level: float | str  # distance from start to goal [rad], RANDOM, or the name of a problems file
    index: int
    world: str  # its packaged name, "" for none, or FILE#INDEX of a problem in a file
    q_start: np.ndarray  # (D,)
    q_goal: np.ndarray  # (D,)
    straight_is_blocked: bool


@functools.cache
def bench_robot(name: str) -> Robot:
    """A robot of the benchmark: one of :data:`ROBOTS`, or a folder of ``vrrt fit``.

    Raises:
        ValueError: the name is unknown, or the folder is not whole.
    """
    if name not in ROBOTS and not Path(name).expanduser().is_dir():
        raise ValueError(
            f"unknown robot '{name}'; have: {', '.join(ROBOTS)}, or give a folder of vrrt fit"
        )
    return load_robot(name)


@functools.cache
def bench_world(robot: str, name: str, engine: str = "closed_form") -> World:
    """A packaged world with the benchmark's number of slots, a random or an empty one.

    Tasks are drawn in the world of the fast engine, so that they are the same for all engines.
    """
    settings: dict[str, Any] = {"engine": engine, "num_slots": NUM_SLOTS}
    file, of_file, index = name.partition("#")
    if of_file:
        empty = build_world(bench_robot(robot), [], **settings)
        trial = pose_problem(bench_robot(robot), empty, problems_of(file, robot), int(index))
        if isinstance(trial, Refusal):
            raise ValueError(f"problem {index} of '{file}': {trial.reason}; take another")
        return trial.world
    if not name:
        return build_world(bench_robot(robot), [], **settings)
    if robot not in ROBOTS:  # no worlds are packaged for it
        seed = int(name.rpartition("_")[2])
        return build_world(bench_robot(robot), random_world(bench_robot(robot), seed), **settings)
    return load_world(name, bench_robot(robot), **settings)


def make_task(
    robot_name: str,
    level: float | str,
    index: int,
    seed: int,
    *,
    obstacles: bool,
    hard: bool = False,
) -> Task:
    """Draw a task: free ends inside the limits, a set distance apart.

    Tasks take turns among the robot's worlds. The same arguments always give the same task.

    Args:
        robot_name: one of :data:`ROBOTS`.
        level: distance from start to goal [rad]; :data:`RANDOM` draws both ends alike.
        index: of the task at this level.
        seed: of the benchmark.
        obstacles: whether there are any.
        hard: whether only tasks count whose straight line from start to goal is blocked.

    Raises:
        ValueError: there seems to be no such task.
    """
    robot = bench_robot(robot_name)
    name = f"{robot.name}_{1 + index % WORLDS_PER_ROBOT}" if obstacles else ""
    world = bench_world(robot_name, name)
    key = f"{robot.name} {level_name(level)} {index} {obstacles}"
    rng = np.random.default_rng([seed, zlib.crc32(key.encode())])
    distance = None if isinstance(level, str) else level
    for ends in free_pairs(robot, world, rng, distance):
        is_blocked = straight_is_blocked(robot, world, *ends)
        if hard and not is_blocked:
            continue
        return Task(
            level=level,
            index=index,
            world=name,
            q_start=ends[0],
            q_goal=ends[1],
            straight_is_blocked=is_blocked,
        )
    raise ValueError(
        f"found no free start and goal of '{robot_name}' for the level {level_name(level)}; "
        "expected levels such as the paper's, 0.5 to 2.5 rad"
    )


def level_name(level: float | str) -> str:
    """A level in the keys of random numbers."""
    return level if isinstance(level, str) else f"{level:.3f}"


def straight_is_blocked(
    robot: Robot, world: World, q_start: np.ndarray, q_goal: np.ndarray
) -> bool:
    """Whether C MuJoCo finds the straight line between two configurations (D,) blocked."""
    return not verify_path(robot, world, np.stack([q_start, q_goal]), step=0.02).ok


@functools.lru_cache(maxsize=8)
def problems_of(file: str, robot_name: str) -> ArmProblems:
    """The problems of a file, read once."""
    return read_problems(file, bench_robot(robot_name))


@functools.cache
def cameras(robot_name: str, scenery: Scenery) -> tuple[Camera, ...]:
    """The views of a robot's workspace."""
    robot = bench_robot(robot_name)
    return tuple(
        front_camera(robot, azimuth + scenery.azimuth_deg)
        for azimuth in AZIMUTHS_DEG[: scenery.views]
    )


def goal_images(
    robot_name: str, task: Task, scenery: Scenery
) -> tuple[list[np.ndarray], list[np.ndarray] | None]:
    """Images (H, W, 4) of the robot at the goal, and masks (H, W) of what may be compared.

    Raises:
        ValueError: the robot's meshes are not on this machine, or a light or mask is unknown.
        RuntimeError: OpenGL is not available.
    """
    world = bench_world(robot_name, task.world)
    # The floor is behind the robot, and as plain a background as any.
    standing = tuple(o for o in obstacle_list(world) if o.kind != "plane")
    hiding = standing if scenery.occluded else ()
    renderer = _renderer(robot_name, hiding, scenery.light == SIDE)
    rng = np.random.default_rng([task.index, zlib.crc32(level_name(task.level).encode())])
    images, masks = [], []
    for camera in cameras(robot_name, scenery):
        picture = renderer.picture(task.q_goal, camera)
        rgb, alpha = photograph(picture, scenery.photograph, rng)
        images.append(np.concatenate([rgb, alpha[..., None]], axis=-1))
        masks.append(picture.valid)
    # The robot comes over black; a goal image has straight colors beside its mask.
    for image in images:
        image[..., :3] /= np.maximum(image[..., 3:], 1e-3)
        np.clip(image, 0.0, 1.0, out=image)
    return images, masks if scenery.occluded else None


@functools.lru_cache(maxsize=2)
def _renderer(robot_name: str, hiding: tuple[Obstacle, ...], from_side: bool) -> MeshRenderer:
    robot = bench_robot(robot_name)
    spec = needed_mesh_spec(robot, "goal images need")
    return MeshRenderer(spec, hiding, shines=SHINES if from_side else None)


def image_psnr(
    robot_name: str,
    q: np.ndarray,
    images: list[np.ndarray],
    scenery: Scenery,
    masks: list[np.ndarray] | None = None,
) -> float:
    """PSNR of the true meshes at ``q`` against the goal images, over white, where masks are true.

    Arguments but ``q`` (D,) are those, and what came of them, of :func:`goal_images`.

    Returns:
        The PSNR over all views [dB].
    """
    errors = []
    pictures = _pictures(robot_name, q, scenery)
    for view, (picture, image) in enumerate(zip(pictures, images, strict=True)):
        over_white = picture.rgb + 1.0 - picture.alpha[..., None]
        goal = image[..., :3] * image[..., 3:] + 1.0 - image[..., 3:]
        error = (over_white - goal) ** 2
        errors.append(np.mean(error if masks is None else error[masks[view]]))
    return float(-10.0 * np.log10(max(np.mean(errors), 1e-10)))


def robot_views(
    robot_name: str, q: np.ndarray, scenery: Scenery, masks: list[np.ndarray] | None = None
) -> list[View]:
    """The true meshes at ``q`` (D,) in each view, with nothing before them, where masks say so.

    They are drawn in the light of the goal images, as bright as in training and without noise.
    """
    views = []
    for index, picture in enumerate(_pictures(robot_name, q, scenery)):
        valid = np.ones_like(picture.alpha) if masks is None else masks[index].astype(np.float32)
        views.append(
            View(
                rgb=picture.rgb * valid[..., None],
                alpha=picture.alpha * valid,
                valid=valid,
                camera=cameras(robot_name, scenery)[index],
            )
        )
    return views


def _pictures(robot_name: str, q: np.ndarray, scenery: Scenery) -> list[Picture]:
    renderer = _renderer(robot_name, (), scenery.light == SIDE)
    return [renderer.picture(q, camera) for camera in cameras(robot_name, scenery)]
