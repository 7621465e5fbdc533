"""Where the true geometry of a robot is: needed to render it, to fit spheres and to verify."""

import dataclasses
import importlib
import importlib.util
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import mujoco

from vrrt_jax.robots import mjcf

if TYPE_CHECKING:
    from vrrt_jax.robots.robot import Robot


@dataclasses.dataclass(frozen=True)
class _Source:
    """A model of MuJoCo Menagerie."""

    folder: str
    file: str
    freeze: Mapping[str, float]  # joints that are not planned [rad] or [m]


_SOURCES = {
    "panda": _Source(
        "franka_emika_panda", "panda.xml", {"finger_joint1": 0.04, "finger_joint2": 0.04}
    )
}


def mesh_spec(robot: "Robot", *, visuals: bool = True) -> mujoco.MjSpec | None:
    """The robot with its true geometry and the planned joints only.

    Collision geoms have contype or conaffinity; the others are for the eye, with their materials.
    Bodies are named as in the source, and all have some explicit inertia.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        visuals: keep the geoms that never collide; without them it compiles faster.

    Returns:
        A spec to edit and compile, new on every call; None if the geometry is nowhere on this
        machine: see :func:`mesh_file`.

    Raises:
        ValueError: the file found is unreadable.
    """
    path = mesh_file(robot.mesh_source)
    if path is None:
        return None
    spec = mjcf.read_spec(path)
    mjcf.strip_spec(spec, visuals=visuals)
    source = _SOURCES.get(str(robot.mesh_source))
    fixed = source.freeze if source else {}
    mjcf.freeze_joints(spec, {**fixed, **robot.frozen})
    return spec


def mesh_file(mesh_source: str | None) -> Path | None:
    """The file with the true geometry of a robot.

    A packaged robot is looked for in the checkout of MuJoCo Menagerie that the environment
    variable MENAGERIE_ROOT names, in the cache of the package ``mujoco-menagerie``, and in an
    installed ``genesis-world``. If none has it and ``mujoco-menagerie`` is installed, that package
    downloads it, once (3 MB).

    Args:
        mesh_source: ``Robot.mesh_source``.

    Returns:
        The MJCF or URDF file, or None.

    Raises:
        FileNotFoundError: MENAGERIE_ROOT is set, but the robot is not there.
    """
    if mesh_source is None:
        return None
    if mesh_source not in _SOURCES:
        return Path(mesh_source)
    source = _SOURCES[mesh_source]
    return _in_root(source) or _cached(source) or _in_genesis(source) or _downloaded(source)


def _in_root(source: _Source) -> Path | None:
    root = os.environ.get("MENAGERIE_ROOT")
    if not root:
        return None
    path = Path(root).expanduser() / source.folder / source.file
    if not path.is_file():
        raise FileNotFoundError(
            f"MENAGERIE_ROOT is '{root}', which has no {source.folder}/{source.file}; expected a "
            "checkout of MuJoCo Menagerie: correct the variable, or unset it"
        )
    return path


def _menagerie() -> ModuleType | None:
    """The package ``mujoco-menagerie`` if it is installed."""
    if importlib.util.find_spec("mujoco_menagerie") is None:
        return None
    return importlib.import_module("mujoco_menagerie")


def _cached(source: _Source) -> Path | None:
    menagerie = _menagerie()
    if menagerie is None:
        return None
    entry, cache = menagerie.get(source.folder), menagerie.Cache()
    return cache.model_path(entry) / source.file if cache.is_cached(entry) else None


def _in_genesis(source: _Source) -> Path | None:
    # found without importing it: the import takes many seconds and needs a dozen packages
    found = importlib.util.find_spec("genesis")
    if found is None or not found.submodule_search_locations:
        return None
    path = Path(found.submodule_search_locations[0], "assets/xml", source.folder, source.file)
    return path if path.is_file() else None


def _downloaded(source: _Source) -> Path | None:
    # last, because it waits for minutes where the network is closed
    menagerie = _menagerie()
    if menagerie is None:
        return None
    try:
        return menagerie.get(source.folder).path() / source.file
    except menagerie.MenagerieError as error:
        warnings.warn(f"the meshes of {source.folder} were not found: {error}", stacklevel=4)
        return None
