"""Joint-goal problems of arms as files: obstacles, a start and a goal each.

A file is a NumPy archive of ``N`` problems. ``docs/benchmarks.md`` lists its keys.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.results_file import fingerprint
from vrrt_jax.robots.mesh_sources import frozen_joints
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.obstacles import Obstacle, check_obstacle, floats

# What a file holds. Letters: N problems, J planned and F fixed joints; B boxes, C cylinders and S
# spheres a problem.
KEYS = {
    "joints": "J",  # names; the columns of start and goal
    "start": "NJ",  # [rad] or [m]
    "goal": "NJ",
    "joint_lower": "J",
    "joint_upper": "J",
    "fixed_joints": "F",
    "fixed_values": "NF",
    "box_pose": "NB7",  # xyz [m] and quaternion, w first
    "box_half": "NB3",  # half edges [m]
    "cyl_pose": "NC7",  # cylinders stand along their z axis
    "cyl_radius": "NC",
    "cyl_half": "NC",  # half their lengths [m]
    "sphere_pos": "NS3",
    "sphere_radius": "NS",
    "vamp_valid": "N",  # whether start and goal are free in the model of whoever wrote the file
}
OPTIONAL_KEYS = {
    "base_pose": "7",  # of the robot's base link in the frame of the obstacles
    "box_name": "1B",
    "cyl_name": "1C",
    "index": "N",
    "group": "",
}
_TEXTS = ("joints", "fixed_joints", "box_name", "cyl_name", "group")
# How joints of packaged robots are named in such files: what comes before and after the name that
# remains, and what comes before that name in the packaged robot.
_NAMING = {"panda": ("panda_", "", ""), "ur5e": ("", "_joint", ""), "fetch": ("", "", "robot0:")}
_TOLERANCE = 1e-3  # [rad] or [m] beyond which joints of the file and of the robot differ
_UNIT_TOLERANCE = 1e-3  # of the length of a quaternion


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmProblems:
    """N problems of one file, as the robot sees them."""

    name: str  # of the file
    fingerprint: str
    q_start: np.ndarray  # (N, D) float32
    q_goal: np.ndarray  # (N, D) float32
    obstacles: tuple[tuple[Obstacle, ...], ...]  # (N,) in the frame of the robot's own file
    is_valid: np.ndarray  # (N,) bool, as the file says
    differences: tuple[str, ...]  # between the file's robot and this one, in words


def problem_files(folder: str | Path, robot_name: str) -> list[Path]:
    """The files of a folder, or of the folder in it that is named as the robot.

    Raises:
        FileNotFoundError: there are none.
    """
    folder = Path(folder)
    for place in (folder, folder / robot_name):
        if files := sorted(place.glob("*.npz")):
            return files
    inside = sorted({file.parent.name for file in folder.glob("*/*.npz")})
    hint = f"one of the folders in it: {', '.join(inside)}" if inside else "the folder of the files"
    raise FileNotFoundError(
        f"no problems (*.npz) in '{folder}' or in '{folder / robot_name}'; give {hint}"
    )


def read_problems(
    file: str | Path, robot: Robot, base: Sequence[float] | None = None
) -> ArmProblems:
    """Read a file of problems for a robot.

    Args:
        file: a NumPy archive with :data:`KEYS`, and any of :data:`OPTIONAL_KEYS`.
        robot: whose joints the file plans, in any order.
        base: (4,) where the robot's base link stands in the frame of the obstacles: x, y, z [m] and
            yaw [rad]. Without it that is what the file's ``base_pose`` says; without that too, the
            frame is that of the robot's own file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is no such archive, a key is missing or unknown, an array has another shape
            or is not finite, or the joints are those of another robot.
    """
    file = Path(file)
    arrays = _read(file)
    if base is not None and "base_pose" in arrays:
        raise ValueError(f"'{file}' has a base_pose, and a base is given too; drop the base")
    columns = _columns(file, arrays, robot)
    to_robot = _Frame.of(robot, _base_pose(arrays, base))
    return ArmProblems(
        name=file.stem,
        fingerprint=fingerprint(file),
        q_start=arrays["start"][:, columns].astype(np.float32),
        q_goal=arrays["goal"][:, columns].astype(np.float32),
        obstacles=tuple(
            _obstacles(file, arrays, index, to_robot) for index in range(len(arrays["start"]))
        ),
        is_valid=arrays["vamp_valid"],
        differences=(*_limits(arrays, robot, columns), *_fixed(arrays, robot)),
    )


def _read(file: Path) -> dict[str, np.ndarray]:
    """The arrays of a file, with keys, types and shapes checked."""
    arrays = read_arrays(file)
    known = KEYS | OPTIONAL_KEYS
    missing, unknown = [k for k in KEYS if k not in arrays], [k for k in arrays if k not in known]
    if missing or unknown:
        raise ValueError(
            f"'{file}' lacks the keys {missing} and has the unknown keys {unknown}; expected "
            f"{', '.join(KEYS)}, and maybe {', '.join(OPTIONAL_KEYS)}"
        )
    sizes: dict[str, int] = {}
    for key, letters in known.items():
        if key in arrays:
            _check(file, key, arrays[key], letters, sizes)
    if sizes["N"] == 0:
        raise ValueError(f"'{file}' holds no problem; expected one at least")
    return arrays


def _check(file: Path, key: str, array: np.ndarray, letters: str, sizes: dict[str, int]) -> None:
    """Check type and shape of an array; letters that are new take their size from it."""
    kinds = "U" if key in _TEXTS else "b" if key == "vamp_valid" else "fiu"
    if array.dtype.kind not in kinds:
        wanted = {"U": "text", "b": "bool", "fiu": "numbers"}[kinds]
        raise ValueError(f"'{file}': {key} is of type {array.dtype}; expected {wanted}")
    sizes |= {letter: int(letter) for letter in letters if letter.isdigit()}
    if array.ndim == len(letters):
        for letter, size in zip(letters, array.shape, strict=True):
            sizes.setdefault(letter, size)
    wanted = [str(sizes.get(letter, letter)) for letter in letters]
    if list(map(str, array.shape)) != wanted:
        raise ValueError(
            f"'{file}': {key} has shape {array.shape}; expected ({', '.join(letters)}) = "
            f"({', '.join(wanted)})"
        )
    if kinds == "fiu" and not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(
            f"'{file}': {key}{where} is {array[tuple(where)]}; expected finite numbers"
        )


def _columns(file: Path, arrays: Mapping[str, np.ndarray], robot: Robot) -> list[int]:
    """Where the file has each joint of the robot, (D,)."""
    names = [_own_name(robot, str(name)) for name in arrays["joints"]]
    if sorted(names) != sorted(robot.joint_names):
        raise ValueError(
            f"'{file}' plans the joints {', '.join(arrays['joints'])}; expected those of "
            f"'{robot.name}', in any order: {', '.join(robot.joint_names)}. Give the robot of the "
            "file"
        )
    return [names.index(name) for name in robot.joint_names]


def _own_name(robot: Robot, name: str) -> str:
    """A joint's name in a file as the robot names it."""
    before, after, own = _NAMING.get(robot.name, ("", "", ""))
    if name in robot.joint_names:
        return name
    return own + name.removeprefix(before).removesuffix(after)


def _limits(arrays: Mapping[str, np.ndarray], robot: Robot, columns: Sequence[int]) -> list[str]:
    """Which limits are others than the robot's; joints that turn forever have none."""
    theirs = np.stack([arrays["joint_lower"], arrays["joint_upper"]])[:, columns]
    apart = np.abs(theirs - np.stack([robot.lower, robot.upper])).max(0)
    apart[robot.is_continuous] = 0.0
    names = [robot.joint_names[j] for j in np.flatnonzero(apart > _TOLERANCE)]
    if not names:
        return []
    return [f"the limits of {', '.join(names)} differ by up to {apart.max():.3f} rad or m"]


def _fixed(arrays: Mapping[str, np.ndarray], robot: Robot) -> list[str]:
    """Fixed joints that stand elsewhere than the robot's, or that it lacks."""
    own, said, unknown = frozen_joints(robot), [], []
    for name, values in zip(arrays["fixed_joints"], arrays["fixed_values"].T, strict=True):
        at = own.get(_own_name(robot, str(name)))
        if at is None:
            unknown.append(str(name))
        elif np.abs(values - at).max() > _TOLERANCE:
            low, high = values.min(), values.max()
            there = f"{low:g}" if high - low <= _TOLERANCE else f"{low:g} to {high:g}"
            said.append(f"{name} is fixed at {there} in the file, at {at:g} here")
    if unknown:
        said.append(f"the fixed joints {', '.join(unknown)} are not modeled here")
    return said


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Frame:
    """From the frame of a file to that of the robot."""

    rotation: Rotation
    shift: np.ndarray  # (3,) [m]

    @classmethod
    def of(cls, robot: Robot, base_pose: np.ndarray | None) -> "_Frame":
        """From where the base link stands in the file to where it stands in the robot's own."""
        if base_pose is None:
            return cls(rotation=Rotation.identity(), shift=np.zeros(3))
        model = mujoco.MjModel.from_xml_string(robot.xml)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        base = data.body(robot.link_names[0])
        rotation = _rotation(base.xquat) * _rotation(base_pose[3:]).inv()
        return cls(rotation=rotation, shift=base.xpos - rotation.apply(base_pose[:3]))

    def pose(self, pose: np.ndarray) -> dict[str, Any]:
        """Fields ``position`` and ``quaternion`` of a pose (7,) of the file."""
        turned = self.rotation * _rotation(pose[3:])
        return {
            "position": floats(self.rotation.apply(pose[:3]) + self.shift),
            "quaternion": floats(turned.as_quat(scalar_first=True)),
        }


def _rotation(quaternion: np.ndarray) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def _base_pose(arrays: Mapping[str, np.ndarray], base: Sequence[float] | None) -> np.ndarray | None:
    if base is None:
        return arrays.get("base_pose")
    if len(base) != 4 or not np.isfinite(base).all():
        raise ValueError(f"the base is {list(base)}; expected x, y, z [m] and yaw [rad]")
    *position, yaw = base
    return np.array([*position, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def _obstacles(
    file: Path, arrays: Mapping[str, np.ndarray], index: int, to_robot: _Frame
) -> tuple[Obstacle, ...]:
    """The obstacles of one problem, in the robot's frame."""
    own = {key: arrays[key][index] for key, letters in KEYS.items() if letters.startswith("N")}
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    rows = {
        "box": list(zip(own["box_pose"], own["box_half"], strict=True)),
        "cyl": [
            (pose, (radius, half, 0.0))
            for pose, radius, half in zip(
                own["cyl_pose"], own["cyl_radius"], own["cyl_half"], strict=True
            )
        ],
        "sphere": [
            (np.concatenate([position, upright]), (radius, 0.0, 0.0))
            for position, radius in zip(own["sphere_pos"], own["sphere_radius"], strict=True)
        ],
    }
    obstacles = []
    for short, placed in rows.items():
        names = arrays.get(f"{short}_name")
        for k, (pose, size) in enumerate(placed):
            name = f"{short}_{k}" if names is None else str(names[0, k])
            try:
                if abs(np.linalg.norm(pose[3:]) - 1.0) > _UNIT_TOLERANCE:
                    raise ValueError(f"'{name}' has the quaternion {pose[3:]}; expected length 1")
                kind = "cylinder" if short == "cyl" else short
                obstacle = Obstacle(name=name, kind=kind, size=floats(size), **to_robot.pose(pose))
                check_obstacle(obstacle)
            except ValueError as error:
                raise ValueError(f"'{file}', problem {index}: {error}") from None
            obstacles.append(obstacle)
    return tuple(obstacles)
