"""The command, as a user runs it, on the packaged problems."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import vrrt_jax
from vrrt_jax import cli
from vrrt_jax.robots import scenes_dir

PROBLEMS = vrrt_jax.problem_names()


def vrrt(*arguments, **environment):
    variables = {**os.environ, "MENAGERIE_ROOT": "", **environment}
    variables.setdefault("JAX_COMPILATION_CACHE_DIR", os.path.expanduser("~/.cache/vrrt_jax_tests"))
    return subprocess.run(
        [sys.executable, "-m", "vrrt_jax.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        env=variables,
        timeout=500,
    )


def test_there_are_three_problems():
    assert len(PROBLEMS) >= 3


def test_packaged_problems_are_solved_and_without_time_they_are_not(tmp_path, capsys):
    # The default engine, which compiles for longer, is what the README's example runs with.
    fast = ["--engine", "closed_form"]
    for name in PROBLEMS:  # in one process: they share compiled programs
        out = tmp_path / name
        options = [*fast, "--trajectory", str(out / "trajectory.npz")]
        drawn = name == PROBLEMS[0]
        options += ["--set", "match.scale=1.5", "budget.attempts=2"] if drawn else ["--no-pictures"]
        assert cli.main(["plan", "--problem", name, "--out", str(out), *options]) == 0
        result = json.loads((out / "result.json").read_text())
        assert result["status"] == "SOLVED" and result["verified"]
        assert set(result["timing"]) == {"compile_s", "search_s", "shortcut_s", "verify_s"}
        assert result["error_rad"]["mean"] < 0.02
        problem = vrrt_jax.load_problem(name)
        path = np.load(out / "path.npz")["path"]
        np.testing.assert_allclose(path[0], problem.q_start, atol=1e-5)
        with np.load(out / "trajectory.npz") as trajectory:
            np.testing.assert_allclose(trajectory["positions"][[0, -1]], path[[0, -1]], atol=1e-5)
            assert 0.3 < trajectory["time"][-1] < 10
        obstacles = vrrt_jax.obstacle_list(problem.world)
        assert vrrt_jax.verify_path(problem.robot, obstacles, path, step=0.002).ok
        assert (out / "figure.png").exists() == drawn
        assert result["config"]["match"]["scale"] == (1.5 if drawn else 1.0)
        if not drawn:
            continue
        with Image.open(out / "figure.png") as figure:
            assert np.asarray(figure).std() > 20
        with Image.open(out / "animation.gif") as animation:
            assert animation.n_frames > 10
            first = np.asarray(animation.convert("RGB"), float)
            animation.seek(animation.n_frames - 1)
            moved = np.abs(np.asarray(animation.convert("RGB"), float) - first).max(axis=2) > 40
            assert moved.mean() > 0.003
    command = ["plan", "--problem", PROBLEMS[0], "--out", str(tmp_path), *fast, "--no-pictures"]
    assert cli.main([*command, "--time-limit", "0"]) == 1
    told = capsys.readouterr().err
    assert "TIME_LIMIT" in told and "raise budget.time_limit_s" in told
    assert json.loads((tmp_path / "result.json").read_text())["status"] == "TIME_LIMIT"


def test_limits_of_motion_are_asked_for_before_the_plan(tmp_path, capsys):
    """Each with one line, and before anything is compiled."""
    (tmp_path / "limits.json").write_text('{"speed": 1.0}')
    command = ["plan", "--problem", PROBLEMS[0], "--out", tmp_path, "--engine", "closed_form"]
    for options, told in (
        (["--limits", tmp_path / "limits.json"], "--limits is for --trajectory"),
        (["--trajectory", tmp_path / "a.bag"], "expected a name that ends with one of: .npz"),
        (
            ["--trajectory", tmp_path / "a.csv", "--limits", tmp_path / "limits.json"],
            "expected some of velocity, acceleration, jerk",
        ),
    ):
        code, error = bad(capsys, *command, *options)
        assert code == 2 and told in error


def test_a_process_ends_with_the_exit_code():
    done = vrrt("plan", "--problem", "nowhere")
    assert done.returncode == 2 and "no problem at 'nowhere'" in done.stderr


def bad(capsys, *arguments):
    code = cli.main(list(map(str, arguments)))
    return code, capsys.readouterr().err


@pytest.fixture
def problem_copy(tmp_path):
    folder = tmp_path / "mine"
    shutil.copytree(scenes_dir() / "problems" / PROBLEMS[0], folder)
    file = folder / "problem.json"
    fields = json.loads(file.read_text())
    fields["world"] = str(scenes_dir() / "worlds" / "open.xml")

    def change(**changes):
        file.write_text(json.dumps({**fields, **changes}))
        return folder

    change()
    return folder, change, fields


def test_bad_input_is_one_clear_line_and_writes_nothing(tmp_path, problem_copy, capsys):
    folder, change, fields = problem_copy
    out = tmp_path / "out"
    out.mkdir()
    (out / "result.json").write_text("precious")

    def expect(message, *arguments):
        code, error = bad(capsys, "plan", "--out", out, *arguments)
        assert code == 2 and error.count("\n") == 1 and message in error, error
        assert (out / "result.json").read_text() == "precious"

    expect("no problem at 'nowhere'; packaged ones: ", "--problem", "nowhere")
    expect("missing --world", "--robot", "panda")
    expect("not both", "--problem", folder, "--robot", "panda")
    expect("--problem or --self-model", "--problem", folder, "--self-model", "arm.npz")
    expect("--capacity: '0'; expected", "--problem", folder, "--capacity", 0)
    expect("--time-limit: '-1'; expected", "--problem", folder, "--time-limit", -1)
    for wrong, message in (
        ("match.scale", "'match.scale' is not a setting such as"),
        ("match.scale=one", "is not a setting such as"),
        ("match.scal=1", "unknown setting 'match.scal'; have: match.scale"),
        ("match.scale=-1", "match.scale=-1 is out of range"),
        ("budget.attempts=1.5", "budget.attempts=1.5; expected a whole number"),
        ("match=1", "match=1; expected a MatchConfig"),
    ):
        expect(message, "--problem", folder, "--set", wrong)
    outside = [3.0, *fields["start"][1:]]
    expect("joint1' is at 3.0000, its bounds", "--problem", change(start=outside))
    expect("has shape (3,)", "--problem", change(start=fields["start"][:3]))
    folded = [0.0, 1.7, 0.0, -0.1, 0.0, 1.6, 0.8]
    expect("start is in collision: ", "--problem", change(start=folded))
    away = {"position": [9, 9, 1], "target": [20, 20, 1], "fovy_deg": 45}
    view = {**fields["views"][0], "camera": away}
    expect("does not see the robot", "--problem", change(views=[view]))
    expect("unknown robot", "--problem", change(robot="pandaa"))
    expect("no world at", "--problem", change(world="none.xml"))
    expect("lacks the field start", "--problem", change(start=None) and _without(folder, "start"))
    (folder / "problem.json").write_text('{"robot": ')
    expect("not valid JSON", "--problem", folder)


def _without(folder, field):
    file = folder / "problem.json"
    fields = json.loads(file.read_text())
    del fields[field]
    file.write_text(json.dumps(fields))
    return folder


def test_other_robots_and_damaged_self_models_are_refused(tmp_path, problem_copy, capsys):
    folder, change, _ = problem_copy
    packed = vrrt_jax.load_self_model(scenes_dir() / "robots" / "panda" / "self_model.npz")
    import dataclasses

    other = dataclasses.replace(packed, robot="ur5e")
    vrrt_jax.save_self_model(other, tmp_path / "other.npz")
    change(self_model=str(tmp_path / "other.npz"))
    code, error = bad(capsys, "plan", "--problem", folder, "--out", tmp_path / "out")
    assert code == 2 and "self-model is of 'ur5e'" in error
    data = (tmp_path / "other.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    change(self_model=str(tmp_path / "cut.npz"))
    code, error = bad(capsys, "plan", "--problem", folder, "--out", tmp_path / "out")
    assert code == 2 and "cut.npz' is no readable .npz" in error
    change(self_model=str(tmp_path / "none.npz"))
    code, error = bad(capsys, "plan", "--problem", folder, "--out", tmp_path / "out")
    assert code == 2 and "no self-model at" in error


def test_a_folder_that_cannot_be_written_to(tmp_path, capsys):
    blocker = tmp_path / "file"
    blocker.write_text("")
    code, error = bad(capsys, "plan", "--problem", PROBLEMS[0], "--out", blocker / "out")
    assert code == 2 and "cannot write to the folder" in error


def test_self_models_come_back(tmp_path):
    packed = vrrt_jax.load_self_model(scenes_dir() / "robots" / "panda" / "self_model.npz")
    vrrt_jax.save_self_model(packed, tmp_path / "copy.npz")
    copy = vrrt_jax.load_self_model(tmp_path / "copy.npz")
    assert copy.info == packed.info and copy.joint_names == packed.joint_names
    of_packed, of_copy = (*packed.levels, packed.close_up), (*copy.levels, copy.close_up)
    for a, b in zip(of_packed, of_copy, strict=True):
        assert (a.size_px, a.psnr_db, a.match_threshold) == (
            b.size_px,
            b.psnr_db,
            b.match_threshold,
        )
        np.testing.assert_allclose(a.splats.mean, b.splats.mean, atol=1e-3)
    assert [level.size_px for level in packed.levels] == [32, 64, 128, 256]
    assert packed.level_for(40).size_px == 64 and packed.level_for(900).size_px == 256
    assert packed.level_for(64).psnr_db >= 35 and packed.level_for(256).psnr_db >= 30


def test_the_doctor_says_what_there_is(capsys, monkeypatch):
    assert cli.main(["doctor"]) == 0
    told = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert told["OpenGL"].endswith("draws") and "jax" in told["versions"]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("vrrt_jax.doctor.mesh_spec", lambda *_, **__: None)
    assert cli.main(["doctor"]) == 0
    told = capsys.readouterr().out
    assert 'pip install "vrrt-jax[view]"' in told and "gymnasium-robotics" in told
