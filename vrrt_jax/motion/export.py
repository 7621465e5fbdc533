"""Trajectories as files: arrays, tables, and messages of ROS 2."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vrrt_jax.core.files import replacing
from vrrt_jax.motion.trajectory import Trajectory

_NANO = 1_000_000_000
_DIGITS = 9  # after the point, in text


def save_trajectory(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory; the ending of the name says how.

    * ``.npz``: arrays ``joint_names``, ``time``, ``positions``, ``velocities``, ``accelerations``.
    * ``.json``: the same as lists.
    * ``.csv``: a row a time; columns ``time``, then position, velocity and acceleration of each
      joint, as in ``joint1_velocity``.
    * ``.yaml``: a message ``trajectory_msgs/msg/JointTrajectory`` of ROS 2, for controllers such as
      ``joint_trajectory_controller``.

    The file appears whole or not at all. A robot may have other names for its joints:
    ``dataclasses.replace(trajectory, joint_names=(...))``.

    Args:
        trajectory: from :func:`vrrt_jax.time_parameterize`.
        path: of the file.

    Raises:
        ValueError: the ending is unknown.
        OSError: the file cannot be written.
    """
    path = Path(path)
    write, mode = _WRITERS[checked_suffix(path)]
    with replacing(path, mode) as file:
        write(trajectory, file)


def checked_suffix(path: str | Path) -> str:
    """The ending of a name, one of those that trajectories have.

    Raises:
        ValueError: it is another one.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _WRITERS:
        raise ValueError(
            f"the trajectory file is '{path}'; expected a name that ends with one of: "
            f"{', '.join(_WRITERS)}"
        )
    return suffix


def joint_trajectory_message(trajectory: Trajectory) -> dict[str, Any]:
    """The fields of a ``trajectory_msgs/msg/JointTrajectory``, in plain Python.

    A stamp of zero lets a controller begin at once.
    """
    nanoseconds = np.round(trajectory.time * _NANO).astype(int)
    states = trajectory.positions, trajectory.velocities, trajectory.accelerations
    points = [
        {
            "positions": position,
            "velocities": velocity,
            "accelerations": acceleration,
            "effort": [],
            "time_from_start": {"sec": int(at // _NANO), "nanosec": int(at % _NANO)},
        }
        for at, position, velocity, acceleration in zip(
            nanoseconds, *map(_rounded, states), strict=True
        )
    ]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(trajectory.joint_names),
        "points": points,
    }


def _arrays(trajectory: Trajectory) -> dict[str, Any]:
    names = ("time", "positions", "velocities", "accelerations")
    return {name: getattr(trajectory, name) for name in names}


def _rounded(array: np.ndarray) -> list[Any]:
    return np.round(array, _DIGITS).tolist()


def _write_npz(trajectory: Trajectory, file: Any) -> None:
    names = np.array(trajectory.joint_names)
    np.savez_compressed(file, joint_names=names, **_arrays(trajectory))


def _write_json(trajectory: Trajectory, file: Any) -> None:
    lists = {name: _rounded(array) for name, array in _arrays(trajectory).items()}
    json.dump({"joint_names": list(trajectory.joint_names), **lists}, file)
    file.write("\n")


def _write_csv(trajectory: Trajectory, file: Any) -> None:
    arrays, rows = _arrays(trajectory), csv.writer(file, lineterminator="\n")
    kinds = ("position", "velocity", "acceleration")
    rows.writerow(["time", *(f"{n}_{kind}" for kind in kinds for n in trajectory.joint_names)])
    table = np.concatenate([arrays.pop("time")[:, None], *arrays.values()], axis=1)
    rows.writerows(_rounded(table))


def _write_yaml(trajectory: Trajectory, file: Any) -> None:
    message = joint_trajectory_message(trajectory)
    yaml.safe_dump(message, file, sort_keys=False, default_flow_style=None, width=1000)


_WRITERS: dict[str, tuple[Callable[[Trajectory, Any], None], str]] = {
    ".npz": (_write_npz, "wb"),
    ".json": (_write_json, "w"),
    ".csv": (_write_csv, "w"),
    ".yaml": (_write_yaml, "w"),
}
