"""Joint goals on files of problems: what the hand holds, refusals, results, peers."""

import importlib.util
import json

import jax
import numpy as np
import pytest
from arm_cases import AWAY, BASE, GOAL, POST, START, arrays_of, fingertips, place
from scipy.spatial.transform import Rotation

import vrrt_jax
from vrrt_jax.bench import arm, arm_table, arm_trials, ompl_peers
from vrrt_jax.bench.arm_problems import problem_files, read_problems
from vrrt_jax.bench.arm_trials import Refusal, Trial, held_at_goal, pose_problem
from vrrt_jax.cli import main
from vrrt_jax.scene.verify import contacts, verify_path


def _can(position, name="can", size=(0.03, 0.05, 0.0)):
    position = tuple(map(float, position))
    return vrrt_jax.Obstacle(name=name, kind="cylinder", position=position, size=size)


def test_what_the_fingers_hold(panda):
    tips, elbow = fingertips(panda, GOAL), place(panda, GOAL, "link4")
    away = _can(AWAY, "away")
    assert held_at_goal(panda, [away, _can(tips)], GOAL) == 1
    assert held_at_goal(panda, [away], GOAL) is None  # nothing touches
    assert held_at_goal(panda, [_can(elbow)], GOAL) is None  # no hand
    assert held_at_goal(panda, [_can(tips), _can(tips, "second")], GOAL) is None
    assert held_at_goal(panda, [_can(tips), _can(elbow, "at the elbow")], GOAL) == 0
    assert held_at_goal(panda, [_can(tips, size=(0.03, 0.2, 0.0))], GOAL) is None  # too large


def test_both_ends_are_checked_and_the_check_is_named(panda, write):
    elbow = place(panda, START, "link4")
    # Off the elbow just so far that only the covering spheres touch the box.
    for off in np.arange(0.1, 0.3, 0.002):
        near = elbow + [0.0, 0.0, 0.3 + off]
        box = vrrt_jax.Obstacle(
            name="box", kind="box", position=tuple(map(float, near)), size=(0.03, 0.03, 0.3)
        )
        if not contacts(panda, [box], START):
            break
    assert contacts(panda, [box], START, geometry="spheres")
    far = panda.upper[0] + 0.05
    file = arrays_of(
        panda,
        [elbow, near, POST],
        [AWAY] * 3,
        goals=[GOAL, GOAL, [far, *GOAL[1:]]],
        vamp_valid=np.ones(3, bool),
    )
    problems = read_problems(write(file), panda)
    world = vrrt_jax.build_world(panda, [], num_slots=2)
    exact, spheres, limits = (pose_problem(panda, world, problems, k) for k in range(3))
    assert isinstance(exact, Refusal) and exact.kind == "exact"
    assert exact.reason.startswith("start: link") and "touches box_0" in exact.reason
    assert isinstance(spheres, Refusal) and spheres.kind == "spheres"
    assert spheres.reason.startswith("start: ") and "touches box_0" in spheres.reason
    assert isinstance(limits, Refusal) and limits.kind == "limits"
    assert "joint 'joint1'" in limits.reason


@pytest.fixture(scope="module")
def done(panda, arrays, tmp_path_factory):
    """A run of two files, and where it was written."""
    folder = tmp_path_factory.mktemp("problems")
    np.savez(folder / "first.npz", **arrays)
    np.savez(folder / "second.npz", **arrays)
    lines = []
    files = problem_files(folder, "panda")
    results = arm.run(_benchmark(panda), files, folder / "results.json", lines.append)
    assert lines == []
    return results, folder


def _benchmark(panda, **changes):
    return arm.ArmBenchmark(robot=panda, engine="closed_form", **changes)


def test_results_tell_all_that_matters(done):
    results, folder = done
    assert json.loads((folder / "results.json").read_text()) == results
    for name in ("cores", "processor"):
        assert name in results["machine"]
    assert results["seed"] == 0 and results["config"]["budget"] and results["versions"]["mujoco"]
    assert results["verified_with"] == "meshes"
    assert list(results["scenes"]) == ["first", "second"]
    scene = results["scenes"]["first"]
    assert (scene["n"], scene["solved"], scene["failed"]) == (3, 2, [])
    (refused,) = scene["refused"]
    assert (refused["index"], refused["kind"]) == (2, "file")
    assert scene["held_attached"] == 1 and scene["recompiled"] == 0
    assert [row["held_attached"] for row in scene["rows"]] == [False, True]
    for row in scene["rows"]:
        # A straight turn of the first joint meets the post.
        assert row["status"] == "SOLVED" and 1.2 < row["cost"] <= row["raw_cost"]
        assert 0 < sum(row["stages_ms"].values()) < row["wall_ms"]
    assert list(scene["stages_ms"]) == ["search", "shortcut", "verify"]
    assert scene["search_median_ms"] == scene["stages_ms"]["search"]
    assert 0 < scene["median_ms"] <= scene["p95_ms"]


def test_totals_of_all_files_stand_beside_them():
    def scene(num, rate, cost):
        rows = [{"index": k} for k in range(num)]
        peer = {"solved": num, "cost": cost, "rows": rows}
        return {
            "n": num,
            "refused": [],
            "rows": rows,
            "batch_problems_per_s": rate,
            "peers": {"RRTConnect": peer},
        }

    totals = arm._totals({"first": scene(10, 5.0, 1.0), "second": scene(20, 20.0, 2.0)})
    assert totals["batch_problems_per_s"] == 10.0  # 30 problems in 2 + 1 s
    peers = totals["peers"]["RRTConnect"]["scenes"]
    assert peers["second"] == {"n": 20, "refused": [], "solved": 20, "cost": 2.0}
    assert arm._totals({}) == {}


def test_the_table_has_a_row_for_each_file(done):
    results, _ = done
    text = arm_table.to_text(results)
    assert "| first | rrt-connect | 2/2 |" in text and "| second | rrt-connect | 2/2 |" in text
    assert "first: refused: file 1 of 3; the hand holds something in 1 of the others" in text


def test_a_run_goes_on_where_it_ended(panda, done, tmp_path, monkeypatch):
    results, folder = done
    files, file = problem_files(folder, "panda"), tmp_path / "results.json"
    solve, calls = arm_trials.solve, []

    def until_second(robot, trial, **settings):
        calls.append(trial.index)
        if len(calls) > 4:  # beyond the first file, where both plans compile once
            raise KeyboardInterrupt
        return solve(robot, trial, **settings)

    monkeypatch.setattr(arm_trials, "solve", until_second)
    with pytest.raises(KeyboardInterrupt):
        arm.run(_benchmark(panda), files, file)
    kept = json.loads(file.read_text())["scenes"]
    assert list(kept) == ["first"]
    calls.clear()
    whole = arm.run(_benchmark(panda), files, file)
    assert calls == [0, 1, 0, 1] and whole["scenes"]["first"] == kept["first"]
    costs = [row["cost"] for row in whole["scenes"]["second"]["rows"]]
    assert costs == [row["cost"] for row in results["scenes"]["second"]["rows"]]

    for other in ({"seed": 1}, {"limit": 2}, {"planner": "rrt"}, {"base": BASE}):
        with pytest.raises(ValueError, match="not mixed"):
            arm.run(_benchmark(panda, **other), files, file)
    whole["scenes"]["first"]["fingerprint"] = "another"
    file.write_text(json.dumps(whole))
    with pytest.raises(ValueError, match="results of different files are not mixed"):
        arm.run(_benchmark(panda), files, file)


@pytest.mark.parametrize(
    ("count", "limit", "chosen"),
    [(3, None, [0, 1, 2]), (100, 4, [0, 25, 50, 75]), (7, 3, [0, 2, 4]), (2, 5, [0, 1])],
)
def test_a_limit_takes_every_kth(count, limit, chosen):
    assert arm.evenly(count, limit) == chosen


def test_numbers_that_make_no_sense_are_refused(panda, done):
    _, folder = done
    for name in ("limit", "batch"):
        with pytest.raises(ValueError, match=f"--{name} is 0; expected at least 1"):
            arm.run(_benchmark(panda, **{name: 0}), problem_files(folder, "panda"), None)


def test_what_failed_and_what_was_not_tried_is_told():
    lost = {"index": 4, "status": "NO_PATH", "solved": False, "wall_ms": 30.0}
    won = {"index": 5, "status": "SOLVED", "solved": True, "wall_ms": 10.0}
    lost |= {"stages_ms": {"search": 15.0}, "raw_cost": None, "cost": None}
    won |= {"stages_ms": {"search": 5.0}, "raw_cost": 3.0, "cost": 2.0}
    rows = [lost, won]
    told = arm.summarize(rows)
    assert told["solved"] == 1 and told["failed"] == [{"index": 4, "status": "NO_PATH"}]
    assert (told["median_ms"], told["search_median_ms"]) == (20.0, 10.0)
    assert (told["raw_cost"], told["cost"]) == (3.0, 2.0)
    nothing = arm.summarize([])
    assert nothing["solved"] == 0 and nothing["median_ms"] is None and nothing["stages_ms"] == {}


def test_a_plan_in_a_moved_frame_is_valid(panda, arrays, write, capsys):
    """From the command line, with the base elsewhere; the path is checked in the file's frame."""
    turn = Rotation.from_euler("z", BASE[3])
    moved = {key: arrays[key][:1] for key in arrays if len(arrays[key]) == 3}
    moved = arrays | moved | {"box_pose": arrays["box_pose"][:1].copy()}
    moved["box_pose"][:, 0, :3] = turn.apply(moved["box_pose"][:, 0, :3]) + BASE[:3]
    moved["box_pose"][:, 0, 3:] = turn.as_quat(scalar_first=True)
    file = write(moved)
    results = file.parent / "results.json"
    base = ",".join(map(str, BASE))
    command = ["bench", "arm", "--problems", str(file.parent), "--robot", "panda"]
    assert main([*command, f"--base={base}", "--json", str(results)]) == 0
    assert "| posts | rrt-connect | 1/1 |" in capsys.readouterr().out
    (row,) = json.loads(results.read_text())["scenes"]["posts"]["rows"]
    assert row["cost"] > 1.2  # around the post, which is in the way there too
    assert main([*command, "--base=0,0,0,0", "--limit", "1", "--json", str(results)]) == 2
    assert "not mixed" in capsys.readouterr().err


def test_compilations_are_counted():
    count = arm_trials._compilations()
    double = jax.jit(lambda x: 2.5 * x)
    before = count[0]
    double(1.0)
    once = count[0]
    double(2.0)
    assert once > before and count[0] == once


def test_without_ompl_the_peers_say_what_to_install(panda, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vrrt-jax\[peers\]'"):
        _benchmark(panda, peers=True).header()


@pytest.mark.parametrize("name", ["RRTConnect", "AORRTC", "BITstar"])
def test_peers_find_paths_that_the_exact_check_grants(panda, arrays, write, monkeypatch, name):
    pytest.importorskip("ompl")
    monkeypatch.setitem(ompl_peers.PEERS, name, 0.3 if name != "RRTConnect" else 5.0)
    problems = read_problems(write(arrays), panda)
    world = vrrt_jax.build_world(panda, [], num_slots=2)
    trial = pose_problem(panda, world, problems, 0)
    assert isinstance(trial, Trial)
    assert not verify_path(panda, trial.world, np.stack([START, GOAL])).ok
    row = ompl_peers.solve(panda, trial, name=name, seed=0)
    assert row["found"] and row["solved"] and row["status"] == "solved"
    assert 1.2 < row["cost"] <= row["raw_cost"]
    assert row["wall_ms"] == pytest.approx(sum(row["stages_ms"].values()))
    assert (row["stages_ms"]["shortcut"] > 0) == (name == "RRTConnect")
