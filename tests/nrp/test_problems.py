"""Problems in homes: the packaged ones, folders, and errors."""

import json

import numpy as np
import pytest

import nrp_jax
from nrp_jax.cli import main
from nrp_jax.problems import load_problem, problem_names
from nrp_jax.scene.configurations import check_configuration


@pytest.mark.parametrize("name", ["home_1", "home_fetch"])
def test_packaged_problems_begin_and_end_free(name):
    problem = load_problem(name)
    world = nrp_jax.build_world(problem.robot, problem.grid)
    for what, q in (("start", problem.q_start), ("goal", problem.q_goal)):
        check_configuration(problem.robot, world, q, what)
    # Worth a plan: far apart, and in different places of the home.
    assert np.linalg.norm(problem.q_goal[:2] - problem.q_start[:2]) > 5.0
    assert name in problem_names()


def test_a_folder_of_ones_own(tmp_path):
    nrp_jax.Grid(occupied=np.zeros((30, 30), bool)).save(tmp_path / "map.npz")
    fields = {"robot": "snake", "map": "map.npz", "start": [1.0] * 8, "goal": [2.0] * 8}
    (tmp_path / "problem.json").write_text(json.dumps(fields))
    problem = load_problem(tmp_path)
    assert problem.name == tmp_path.name and problem.map_file == tmp_path / "map.npz"
    np.testing.assert_array_equal(problem.q_goal, [2.0] * 8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not valid JSON"),
        ("[]", "is a list; expected an object"),
        ('{"robot": "snake", "gaol": []}', "unknown fields: gaol; known ones: robot, map"),
        ('{"robot": "snake", "map": "map.npz", "start": []}', "lacks the field 'goal'"),
        (
            '{"robot": "snake", "map": "map.npz", "start": [1], "goal": [1]}',
            r"the start has shape \(1,\); expected \(8,\)",
        ),
    ],
)
def test_bad_problems(tmp_path, text, message):
    (tmp_path / "problem.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_problem(tmp_path)


def test_a_problem_that_is_not_there_names_those_that_are(tmp_path):
    with pytest.raises(FileNotFoundError, match="packaged ones: home_1, home_fetch"):
        load_problem(tmp_path / "home_2")


def test_command_line_plans_a_packaged_problem(tmp_path, capsys):
    command = ["plan", "--problem", "home_1", "--out", str(tmp_path), "--no-pictures"]
    assert main(command) == 0
    record = json.loads((tmp_path / "path.json").read_text())
    assert record["robot"] == "snake" and record["verified"]
    assert main([*command, "--robot", "fetch"]) == 2
    assert "got both --problem and --robot" in capsys.readouterr().err
    assert main(["plan", "--out", str(tmp_path)]) == 2
    assert "--map is missing; expected --map" in capsys.readouterr().err
