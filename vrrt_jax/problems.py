"""Planning problems as folders: ``problem.json`` and the goal images beside it."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vrrt_jax.checks import check_limits
from vrrt_jax.core.data_file import of_file, read_json
from vrrt_jax.core.fields import check_fields
from vrrt_jax.core.files import replacing, write_text
from vrrt_jax.core.precision import single_precision
from vrrt_jax.robots import Robot, load_robot, robot_names, scenes_dir
from vrrt_jax.robots.robot_folder import SELF_MODEL
from vrrt_jax.scene.obstacles import load_obstacles, write_obstacles
from vrrt_jax.scene.world import World, build_world, held_names, obstacle_list
from vrrt_jax.splat.camera_fields import camera_to_dict
from vrrt_jax.splat.model import SelfModel, load_self_model, save_self_model
from vrrt_jax.splat.photo import Photo, load_photo
from vrrt_jax.splat.picture_file import read_image
from vrrt_jax.splat.types import Camera
from vrrt_jax.visual.goal import ImageGoal

FIELDS = ("robot", "world", "self_model", "start", "views", "true_goal")  # of problem.json
VIEW_FIELDS = ("image", "camera", "mask")  # of one of its views


@dataclasses.dataclass(frozen=True, kw_only=True)
class Problem:
    """All that :func:`vrrt_jax.plan` needs."""

    name: str
    robot: Robot
    world: World
    self_model: SelfModel
    cameras: tuple[Camera, ...]
    goal_images: tuple[np.ndarray, ...]  # (H, W, 3 or 4) float32
    q_start: np.ndarray  # (D,)
    true_goal: np.ndarray | None  # (D,) for scoring alone; the planner never sees it
    # (H, W) bool, True where a goal image is compared; None for all of it, or of all of them
    masks: tuple[np.ndarray | None, ...] | None = None

    @property
    def goal(self) -> ImageGoal:
        """The robot should look like the goal images."""
        return ImageGoal(self.self_model, self.cameras, self.goal_images, self.masks)


def problem_names() -> list[str]:
    """The packaged problems."""
    return sorted(p.parent.name for p in (scenes_dir() / "problems").glob("*/problem.json"))


@single_precision
def load_problem(name_or_path: str | Path, *, engine: str = "mjx") -> Problem:
    """Load a packaged problem by name, or any by its folder.

    Args:
        name_or_path: a packaged problem, or a folder with a ``problem.json``.
        engine: of its world, see :func:`build_world`.

    Raises:
        FileNotFoundError: there is no such problem, or one of its files is missing.
        ValueError: a file is damaged, a field is missing or unknown, or the engine does not exist.
    """
    folder = Path(name_or_path)
    if not (folder / "problem.json").is_file() and str(name_or_path) in problem_names():
        folder = scenes_dir() / "problems" / str(name_or_path)
    file = folder / "problem.json"
    if not file.is_file():
        raise FileNotFoundError(
            f"no problem at '{name_or_path}'; packaged ones: {', '.join(problem_names())}, or give "
            "a folder with a problem.json"
        )
    fields = read_json(file)
    check_fields(fields, FIELDS, f"'{file}'")
    if missing := [name for name in ("robot", "world", "start", "views") if name not in fields]:
        raise ValueError(f"'{file}' lacks the field {missing[0]}; see the packaged problems")
    with of_file(file):
        robot = load_robot(_beside(folder, fields["robot"], "robot"))
        self_model = fields.get("self_model")
        self_model = None if self_model is None else _beside(folder, self_model, "self_model")
        true_goal = fields.get("true_goal")
        views = _checked_views(fields["views"], file)
        photos = [_load_view(folder, view) for view in views]
        return Problem(
            name=folder.resolve().name,
            robot=robot,
            world=load_world(_beside(folder, fields["world"], "world"), robot, engine=engine),
            self_model=load_self_model(self_model_path(robot, self_model)),
            **views_of(photos),
            q_start=check_limits(robot, fields["start"], "start"),
            true_goal=None if true_goal is None else check_limits(robot, true_goal, "true_goal"),
        )


def save_problem(problem: Problem, folder: Path) -> None:
    """Write a problem as a folder of its own, for :func:`load_problem`.

    Goal images are written in 8 bits a channel. Meshes stay where they are.

    Raises:
        ValueError: the robot holds objects, which a folder has no place for.
    """
    if held := held_names(problem.world):
        raise ValueError(
            f"the robot holds {held}, which a problem's folder has no place for; detach them first"
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "robot.xml", problem.robot.xml)
    write_obstacles(obstacle_list(problem.world), folder / "world.xml")
    save_self_model(problem.self_model, folder / "self_model.npz")
    views = []
    for index, image in enumerate(problem.goal_images):
        name, pixels = f"goal_{index + 1}.png", np.round(255 * np.clip(image, 0, 1))
        Image.fromarray(pixels.astype(np.uint8)).save(folder / name)
        view = {"image": name, "camera": camera_to_dict(problem.cameras[index])}
        if problem.masks is not None and problem.masks[index] is not None:
            view["mask"] = f"mask_{index + 1}.png"
            pixels = 255 * np.asarray(problem.masks[index], np.uint8)
            Image.fromarray(pixels).save(folder / view["mask"])
        views.append(view)
    fields: dict[str, Any] = {
        "robot": "robot.xml",
        "world": "world.xml",
        "self_model": "self_model.npz",
        "start": np.asarray(problem.q_start, float).tolist(),
        "views": views,
    }
    if problem.true_goal is not None:
        fields["true_goal"] = np.asarray(problem.true_goal, float).tolist()
    # The file that makes it a problem comes last.
    with replacing(folder / "problem.json", "w") as file:
        file.write(json.dumps(fields, indent=1) + "\n")


@single_precision
def load_world(
    name_or_path: str | Path, robot: Robot, *, engine: str = "mjx", **settings: Any
) -> World:
    """Load a world of obstacles from an MJCF file, or a packaged one by name, for a robot.

    Args:
        name_or_path: a file, or the name of one in ``scenes/worlds``.
        robot: from :func:`load_robot`.
        engine: who answers what is free, see :func:`build_world`.
        settings: passed on to :func:`build_world`.

    Raises:
        FileNotFoundError: no such world.
        ValueError: the file is no MJCF, or holds what cannot be collided with, or the engine does
            not exist.
    """
    path = Path(name_or_path)
    packaged = scenes_dir() / "worlds" / f"{name_or_path}.xml"
    if not path.is_file() and packaged.is_file():
        path = packaged
    if not path.is_file():
        names = sorted(p.stem for p in (scenes_dir() / "worlds").glob("*.xml"))
        raise FileNotFoundError(
            f"no world at '{name_or_path}'; packaged ones: {', '.join(names)}, or give an MJCF file"
        )
    return build_world(robot, load_obstacles(path), engine=engine, **settings)


def self_model_path(robot: Robot, given: str | Path | None = None) -> Path:
    """Where a robot's self-model is: the given file, or the one of its folder.

    Raises:
        ValueError: none is given, and the robot was loaded from a file alone.
    """
    if given is not None:
        return Path(given)
    if robot.folder is not None:
        return robot.folder / SELF_MODEL
    if robot.mesh_source not in robot_names():
        raise ValueError(
            f"the robot '{robot.name}' comes without a self-model; make a folder with one with: "
            "vrrt fit, and give that as the robot; or give --self-model"
        )
    return scenes_dir() / "robots" / robot.name / SELF_MODEL


def views_of(photos: Sequence[Photo]) -> dict[str, Any]:
    """What a :class:`Problem` has of its photographs, by the names of its fields."""
    masks = tuple(photo.mask for photo in photos)
    return {
        "cameras": tuple(photo.camera for photo in photos),
        "goal_images": tuple(photo.image for photo in photos),
        "masks": None if all(mask is None for mask in masks) else masks,
    }


def _load_view(folder: Path, view: dict[str, Any]) -> Photo:
    """A view of a problem's folder."""
    camera = view["camera"]
    camera = camera if isinstance(camera, dict) else _file_beside(folder, camera, "camera")
    image = read_image(_file_beside(folder, view["image"], "image"))
    mask = view.get("mask")
    mask = None if mask is None else read_image(_file_beside(folder, mask, "mask"))
    return load_photo(image, camera, mask=mask)


def _checked_views(views: Any, file: Path) -> list[dict[str, Any]]:
    """The views of a problem's file, each with an image and a camera.

    Raises:
        ValueError: there is none, or one has other fields.
    """
    if not isinstance(views, list) or not views:
        raise ValueError(f"views of '{file}' is {views!r}; expected a list of images and cameras")
    for index, view in enumerate(views):
        check_fields(view, VIEW_FIELDS, f"view {index} of '{file}'")
        if missing := [name for name in VIEW_FIELDS[:2] if name not in view]:
            raise ValueError(f"view {index} of '{file}' lacks the field {missing[0]}")
    return views


def _file_beside(folder: Path, name: Any, what: str) -> str:
    """See :func:`_beside`; here it must be a file that is there.

    Raises:
        FileNotFoundError: it is not.
    """
    path = _beside(folder, name, what)
    if not Path(path).exists():
        raise FileNotFoundError(
            f"the {what} '{name}' of the problem in '{folder}' is neither there nor at that path"
        )
    return path


def _beside(folder: Path, name: Any, what: str) -> str:
    """A file or folder beside a problem's file, if it is there; otherwise the name as it is.

    Raises:
        ValueError: it is no text.
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"{what} is {name!r}; expected a name or a path")
    return str(folder / name) if (folder / name).exists() else name
