"""Where the tasks of a benchmark come from: distances, any pairs, hard ones, files of problems."""

import numpy as np
import pytest

from vrrt_jax.bench import problem_tasks, protocol, runner, tables, tasks
from vrrt_jax.cli import main
from vrrt_jax.scene.verify import contacts
from vrrt_jax.scene.world import obstacle_list


def _benchmark(**changes):
    settings = {"levels": (0.5,), "tasks_per_level": 1, "seed": 3}
    return protocol.benchmark("visual", "panda", **{**settings, **changes})


def test_random_pairs_lie_anywhere_inside_the_limits():
    pairs = [tasks.make_task("panda", "random", index, 7, obstacles=False) for index in range(6)]
    apart = [np.linalg.norm(task.q_goal - task.q_start) for task in pairs]
    assert np.ptp(apart) > 1.0 and max(apart) > 5.0
    robot = tasks.bench_robot("panda")
    for task in pairs:
        assert np.all((task.q_goal >= robot.lower) & (task.q_goal <= robot.upper))
        assert not contacts(robot, [], task.q_goal)


def test_lines_are_blocked_in_hard_worlds():
    benchmark = _benchmark(worlds="hard")
    found = [benchmark.task(1.0, index) for index in range(3)]
    assert all(task.straight_is_blocked for task in found)
    for task in found:
        world = tasks.bench_world("panda", task.world)
        robot = tasks.bench_robot("panda")
        assert not any(contacts(robot, world, q) for q in (task.q_start, task.q_goal))


def test_a_problem_of_a_file_is_a_task(arrays, write, tmp_path):
    file = write(arrays)
    benchmark = _benchmark(problems=str(file.parent))
    assert benchmark.levels == (file.stem,)
    task = benchmark.task(file.stem, 0)
    number = problem_tasks.usable_problems(file, "panda")[0]
    problems = tasks.problems_of(str(file), "panda")
    np.testing.assert_array_equal(task.q_goal, problems.q_goal[number])
    listed = obstacle_list(tasks.bench_world("panda", task.world))
    assert {o.name for o in listed} == {o.name for o in problems.obstacles[number]}
    assert benchmark.header()["problems"] == {file.stem: problems.fingerprint}
    with pytest.raises(ValueError, match="lower tasks_per_level"):
        _benchmark(problems=str(file.parent), tasks_per_level=1000)


def test_levels_with_names_are_told_by_name():
    row = {
        "variant": "vrrt",
        "level": 2.5,
        "distance_rad": 2.5,
        "success": True,
        "cause": "",
        "time_s": 1.0,
        "path_length": 2.0,
        "path_over_reference": 1.1,
        "mean_error_rad": 0.01,
        "psnr_db": 30.0,
        "straight_is_blocked": True,
    }
    rows = [{**row, "level": "random", "distance_rad": 4.0}, row]
    summary = runner.summarize(rows)
    assert [level["level"] for level in summary["levels"]] == [2.5, "random"]
    assert [level["distance_rad"] for level in summary["levels"]] == [2.5, 4.0]
    text = tables.to_text({**_benchmark().header(), "tasks": rows, **summary})
    assert "| 2.5 |" in text and "| random |" in text


@pytest.mark.parametrize(
    "words, said",
    [
        (["--levels", "far"], "far"),
        (["--worlds", "easy"], "standard, hard"),
        (["--problems", "nowhere"], "no problems"),
        (["--problems", "nowhere", "--worlds", "hard"], "their own worlds"),
    ],
)
def test_unknown_sources_are_refused(capsys, words, said):
    assert main(["bench", "visual", "--robot", "panda", *words]) == 2
    assert said in capsys.readouterr().err
