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
from vrrt_jax.robots.frozen import freeze_joints

if TYPE_CHECKING:
    from vrrt_jax.robots.robot import Robot


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Source:
    """Where the model of a packaged robot comes from, and how it is cleaned."""

    packages: Mapping[str, str]  # installed packages that carry it, and the file inside
    menagerie: tuple[str, str] | None = None  # folder and file in MuJoCo Menagerie
    install: str  # what brings it
    freeze: Mapping[str, float]  # joints that are not planned [rad] or [m]
    root: str | None = None  # body that is the robot, put at the origin; the rest is scenery
    exclude: tuple[tuple[str, str], ...] = ()  # bodies that only touch as the hulls of their meshes
    hulls: bool = False  # collide the visual meshes, not the shipped shapes, which leave gaps
    tool: "_Source | None" = None  # what the robot holds, mounted at ``tool_site``
    tool_site: str = "attachment_site"


_MENAGERIE = "mujoco-menagerie, or point MENAGERIE_ROOT at a checkout of MuJoCo Menagerie"
_ROBOTIQ_2F85 = _Source(
    packages={"gym_hil": "assets/panda.xml"},  # a Panda that holds one
    menagerie=("robotiq_2f85", "2f85.xml"),
    install="--no-deps gym-hil==0.1.14",
    freeze={},  # rigid, and open
    root="base_mount",
)
_SOURCES = {
    "panda": _Source(
        packages={"genesis": "assets/xml/franka_emika_panda/panda.xml"},
        menagerie=("franka_emika_panda", "panda.xml"),
        install=_MENAGERIE,
        freeze={"finger_joint1": 0.04, "finger_joint2": 0.04},
    ),
    "ur5e": _Source(
        packages={"genesis": "assets/xml/universal_robots_ur5e/ur5e.xml"},
        menagerie=("universal_robots_ur5e", "ur5e.xml"),
        install=_MENAGERIE,
        freeze={},
        hulls=True,
        tool=_ROBOTIQ_2F85,  # a bare flange turns without being seen
    ),
    "fetch": _Source(
        packages={"gymnasium_robotics": "envs/assets/fetch/reach.xml"},
        install="--no-deps gymnasium-robotics==1.4.2",
        freeze={
            "robot0:slide0": 0.0,
            "robot0:slide1": 0.0,
            "robot0:slide2": 0.0,
            "robot0:head_pan_joint": 0.0,
            "robot0:head_tilt_joint": 0.06,
            "robot0:r_gripper_finger_joint": 0.04,
            "robot0:l_gripper_finger_joint": 0.04,
        },
        root="robot0:base_link",
        # The torso is hollow where the shoulder turns.
        exclude=(("robot0:torso_lift_link", "robot0:shoulder_lift_link"),),
    ),
}


def install_hint(mesh_source: str | None) -> str:
    """What brings the true geometry of a robot to this machine."""
    source = _SOURCES.get(str(mesh_source))
    if source is None:
        return f"put '{mesh_source}' there again" if mesh_source else "load the robot's own file"
    tool = f", and {source.tool.install}" if source.tool else ""
    return f"pip install {source.install}{tool}"


def frozen_joints(robot: "Robot") -> dict[str, float]:
    """Joints of the true geometry that are not planned, and where they are fixed [rad] or [m]."""
    source = _SOURCES.get(str(robot.mesh_source))
    return {**(source.freeze if source else {}), **robot.frozen}


def needed_mesh_spec(robot: "Robot", needing: str = "") -> mujoco.MjSpec:
    """The same as :func:`mesh_spec`, where nothing can be done without it.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        needing: what needs it, as "a goal image needs"; for the message.

    Raises:
        ValueError: it is nowhere on this machine, and what to install.
    """
    spec = mesh_spec(robot)
    if spec is None:
        what = (
            f"{needing} the meshes of '{robot.name}', which"
            if needing
            else (f"the meshes of '{robot.name}'")
        )
        raise ValueError(f"{what} are not on this machine: {install_hint(robot.mesh_source)}")
    return spec


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
    spec = mjcf.read_spec(path, visuals=visuals)
    source = _SOURCES.get(str(robot.mesh_source))
    if source and source.root:
        mjcf.keep_body(spec, source.root)
    if source and source.tool and source.tool.root:
        tool_path = tool_file(robot.mesh_source)
        if tool_path is None:
            return None
        mjcf.mount(spec, source.tool_site, mjcf.read_spec(tool_path), source.tool.root)
    if source and source.hulls:
        mjcf.collide_visuals(spec)
    mjcf.strip_spec(spec, visuals=visuals)
    freeze_joints(spec, frozen_joints(robot))
    for first, second in source.exclude if source else ():
        spec.add_exclude(bodyname1=first, bodyname2=second)
    return spec


def inertial_spec(robot: "Robot") -> mujoco.MjSpec | None:
    """The robot with its true masses, rotor inertias and damping, and the planned joints only.

    The largest torque of a joint is in its ``actfrcrange``, where the file has one for the joint
    or for an actuator of it. Bodies without masses in the file have those that MuJoCo infers from
    their shapes. Nothing else of the file is kept: no actuators, no contacts.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.

    Returns:
        A spec to edit and compile, new on every call; None if the file is nowhere on this machine.

    Raises:
        ValueError: the file found is unreadable.
    """
    path, source = mesh_file(robot.mesh_source), _SOURCES.get(str(robot.mesh_source))
    if path is None:
        return None
    spec = mjcf.read_inertial_spec(path)
    mjcf.keep_torque_ranges(spec)
    if source and source.root:
        mjcf.keep_body(spec, source.root)
    if source and source.tool and source.tool.root:
        tool_path = tool_file(robot.mesh_source)
        if tool_path is None:
            return None
        tool = mjcf.read_inertial_spec(tool_path)
        mjcf.keep_torque_ranges(tool)
        mjcf.mount(spec, source.tool_site, tool, source.tool.root, fold=False)
    mjcf.drop_shapes(spec)
    freeze_joints(spec, frozen_joints(robot))
    return spec


def mesh_file(mesh_source: str | None) -> Path | None:
    """The file with the true geometry of a robot.

    A robot of MuJoCo Menagerie is looked for in the checkout that the environment variable
    MENAGERIE_ROOT names, in the cache of the package ``mujoco-menagerie``, and in installed
    packages that carry a copy. If none has it and ``mujoco-menagerie`` is installed, that package
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
        return Path(mesh_source) if Path(mesh_source).is_file() else None
    return _found(_SOURCES[mesh_source])


def tool_file(mesh_source: str | None) -> Path | None:
    """The file with the true geometry of what a packaged robot holds, found likewise, or None."""
    source = _SOURCES.get(str(mesh_source))
    return _found(source.tool) if source and source.tool else None


def _found(source: _Source) -> Path | None:
    return _in_root(source) or _cached(source) or _in_packages(source) or _downloaded(source)


def _in_root(source: _Source) -> Path | None:
    root = os.environ.get("MENAGERIE_ROOT")
    if not root or source.menagerie is None:
        return None
    folder, file = source.menagerie
    path = Path(root).expanduser() / folder / file
    if not path.is_file():
        raise FileNotFoundError(
            f"MENAGERIE_ROOT is '{root}', which has no {folder}/{file}; expected a "
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
    if menagerie is None or source.menagerie is None:
        return None
    folder, file = source.menagerie
    entry, cache = menagerie.get(folder), menagerie.Cache()
    return cache.model_path(entry) / file if cache.is_cached(entry) else None


def _in_packages(source: _Source) -> Path | None:
    # found without importing them: the imports take many seconds and need a dozen packages
    for package, file in source.packages.items():
        found = importlib.util.find_spec(package)
        if found is not None and found.submodule_search_locations:
            path = Path(found.submodule_search_locations[0], file)
            if path.is_file():
                return path
    return None


def _downloaded(source: _Source) -> Path | None:
    # last, because it waits for minutes where the network is closed
    menagerie = _menagerie()
    if menagerie is None or source.menagerie is None:
        return None
    folder, file = source.menagerie
    try:
        return menagerie.get(folder).path() / file
    except menagerie.MenagerieError as error:
        warnings.warn(f"the meshes of {folder} were not found: {error}", stacklevel=4)
        return None
