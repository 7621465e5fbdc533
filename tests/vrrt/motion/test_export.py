"""Files of trajectories say what the trajectory says."""

import csv
import json

import numpy as np
import pytest
import yaml

from vrrt_jax import save_trajectory, time_parameterize


@pytest.fixture(scope="module")
def timed(gantry, slow):
    return time_parameterize(gantry, np.array([[0.0, 0.0], [0.5, 1.0]]), limits=slow, period=0.03)


def test_arrays_and_lists(timed, tmp_path):
    for name in ("a.npz", "a.json"):
        save_trajectory(timed, tmp_path / name)
    lists = json.loads((tmp_path / "a.json").read_text())
    with np.load(tmp_path / "a.npz") as arrays:
        assert tuple(arrays["joint_names"]) == tuple(lists["joint_names"]) == ("x", "y")
        for kind in ("time", "positions", "velocities", "accelerations"):
            np.testing.assert_array_equal(arrays[kind], getattr(timed, kind))
            np.testing.assert_allclose(lists[kind], arrays[kind], atol=1e-9)


def test_tables(timed, tmp_path):
    save_trajectory(timed, tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for name, expected in (
        ("time", timed.time),
        ("y_position", timed.positions[:, 1]),
        ("x_velocity", timed.velocities[:, 0]),
        ("y_acceleration", timed.accelerations[:, 1]),
    ):
        np.testing.assert_allclose([float(row[name]) for row in rows], expected, atol=1e-9)


def test_ros_messages(timed, tmp_path):
    save_trajectory(timed, tmp_path / "a.yaml")
    message = yaml.safe_load((tmp_path / "a.yaml").read_text())
    assert set(message) == {"header", "joint_names", "points"}
    assert message["joint_names"] == ["x", "y"] and len(message["points"]) == len(timed.time)
    times = []
    for point, position in zip(message["points"], timed.positions, strict=True):
        at = point.pop("time_from_start")
        assert isinstance(at["sec"], int) and 0 <= at["nanosec"] < 10**9
        times.append(at["sec"] + at["nanosec"] * 1e-9)
        assert set(point) == {"positions", "velocities", "accelerations", "effort"}
        np.testing.assert_allclose(point["positions"], position, atol=1e-9)
    np.testing.assert_allclose(times, timed.time, atol=1e-9)
    assert times[-1] > 1  # both fields were asked for


def test_other_endings_are_refused(timed, tmp_path):
    with pytest.raises(ValueError, match="expected a name that ends with one of: .npz, .json"):
        save_trajectory(timed, tmp_path / "a.bag")
