"""Joint goals on files of problems: reading, refusing, what the hand holds, results, peers."""

import importlib.util
import json

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vrrt_jax
from vrrt_jax.bench import arm, arm_table, arm_trials, ompl_peers
from vrrt_jax.bench.arm_problems import problem_files, read_problems
from vrrt_jax.bench.arm_trials import Refusal, Trial, held_at_goal, pose_problem
from vrrt_jax.cli import main
from vrrt_jax.scene.verify import contacts, verify_path

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
AWAY = (-0.6, -0.6, 0.1)  # where nothing is in the way
START = np.array([0.0, 0.0, 0.0, -1.57079, 0.0, 1.57079, -0.7853])
GOAL = START + np.array([1.2, 0, 0, 0, 0, 0, 0])
POST = (0.46, 0.31, 0.3)  # between the two
BASE = (0.3, -0.2, 0.9, 1.57)


def place(robot, q, body):
    """Where a body of the robot is, (3,)."""
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return data.body(body).xpos.copy()


def fingertips(robot, q):
    """Between the fingers, which point down at ``START`` and ``GOAL``."""
    fingers = [place(robot, q, f"{side}_finger") for side in ("left", "right")]
    return np.mean(fingers, axis=0) - np.array([0.0, 0.0, 0.045])


def arrays_of(robot, boxes, cans, goals=None, starts=None, **changes):
    """A file of problems with one box and one cylinder each, at these places (3,)."""
    count = len(boxes)
    pose = np.tile([0.0, 0.0, 0.0, *UPRIGHT], (count, 1, 1))
    box_pose, can_pose = pose.copy(), pose.copy()
    box_pose[:, 0, :3], can_pose[:, 0, :3] = boxes, cans
    arrays = {
        "joints": np.array([f"panda_joint{k}" for k in range(1, 8)]),
        "start": np.tile(START, (count, 1)) if starts is None else np.array(starts),
        "goal": np.tile(GOAL, (count, 1)) if goals is None else np.array(goals),
        "joint_lower": robot.lower,
        "joint_upper": robot.upper,
        "fixed_joints": np.array(["panda_finger_joint1", "panda_finger_joint2"]),
        "fixed_values": np.full((count, 2), 0.04),
        "box_pose": box_pose,
        "box_half": np.tile([0.03, 0.03, 0.3], (count, 1, 1)),
        "cyl_pose": can_pose,
        "cyl_radius": np.full((count, 1), 0.03),
        "cyl_half": np.full((count, 1), 0.05),
        "sphere_pos": np.zeros((count, 0, 3)),
        "sphere_radius": np.zeros((count, 0)),
        "vamp_valid": np.ones(count, bool),
    }
    return arrays | changes


@pytest.fixture(scope="module")
def arrays(panda):
    """Three problems: a post in between, a can in the fingers at the goal, an invalid one."""
    cans = [AWAY, fingertips(panda, GOAL), AWAY]
    valid = np.array([True, True, False])
    return arrays_of(panda, [POST] * 3, cans, vamp_valid=valid)


@pytest.fixture
def write(tmp_path):
    """Write a file of problems."""

    def to_file(arrays, name="posts"):
        np.savez(tmp_path / f"{name}.npz", **arrays)
        return tmp_path / f"{name}.npz"

    return to_file


def test_a_file_is_read_in_the_robots_order_and_names(panda, arrays, write):
    order = [3, 0, 1, 2, 6, 5, 4]
    shuffled = {key: arrays[key][..., order] for key in ("joints", "start", "goal")}
    shuffled |= {key: arrays[key][order] for key in ("joint_lower", "joint_upper")}
    names = {"box_name": np.array([["post"]]), "cyl_name": np.array([["can"]])}
    problems = read_problems(write(arrays | shuffled | names), panda)
    assert problems.name == "posts" and problems.differences == ()
    np.testing.assert_array_equal(problems.q_start, np.tile(START.astype(np.float32), (3, 1)))
    np.testing.assert_array_equal(problems.q_goal[0], GOAL.astype(np.float32))
    post, can = problems.obstacles[1]
    assert (post.name, post.kind, post.size) == ("post", "box", (0.03, 0.03, 0.3))
    assert (can.name, can.kind, can.size) == ("can", "cylinder", (0.03, 0.05, 0.0))
    np.testing.assert_allclose(post.position, POST)
    assert problems.is_valid.tolist() == [True, True, False]


def test_spheres_are_obstacles_too(panda, arrays, write):
    spheres = {"sphere_pos": np.full((3, 1, 3), 0.7), "sphere_radius": np.full((3, 1), 0.1)}
    *_, ball = read_problems(write(arrays | spheres), panda).obstacles[0]
    assert (ball.kind, ball.size, ball.position) == ("sphere", (0.1, 0.0, 0.0), (0.7, 0.7, 0.7))


def test_another_posture_of_the_files_robot_is_told(panda, arrays, write):
    upper = panda.upper.copy()
    upper[2] += 0.2
    values = np.array([[0.065, 0.04], [0.065, 0.04], [0.03, 0.04]])
    fixed = np.array(["panda_finger_joint1", "wheel"])
    changes = {"joint_upper": upper, "fixed_values": values, "fixed_joints": fixed}
    limits, finger, unknown = read_problems(write(arrays | changes), panda).differences
    assert limits == "the limits of joint3 differ by up to 0.200 rad or m"
    assert finger == "panda_finger_joint1 is fixed at 0.03 to 0.065 in the file, at 0.04 here"
    assert unknown == "the fixed joints wheel are not modeled here"


def _nan(array):
    array = array.copy()
    array.flat[8] = np.nan
    return array


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("goal", None, r"lacks the keys \['goal'\]"),
        ("base_poze", lambda _: np.zeros(7), r"unknown keys \['base_poze'\]"),
        ("goal", _nan, r"goal\[1, 1\] is nan"),
        ("goal", lambda a: a[:2], r"goal has shape \(2, 7\); expected \(N, J\) = \(3, 7\)"),
        ("box_half", lambda a: a[..., 0], r"expected \(N, B, 3\) = \(3, 1, 3\)"),
        ("cyl_pose", lambda a: a[..., :6], r"expected \(N, C, 7\)"),
        ("vamp_valid", lambda a: a.astype(int), "vamp_valid is of type int64; expected bool"),
        ("joints", lambda a: np.arange(7), "joints is of type int64; expected text"),
        ("joints", lambda a: a.astype(object), "no NumPy archive of plain arrays"),
        ("box_pose", lambda a: 2 * a, "problem 0: 'box_0' has the quaternion.*expected length 1"),
        ("cyl_radius", lambda a: -a, "problem 0: obstacle 'cyl_0'.*expected 2 positive numbers"),
        ("box_name", lambda _: np.array([["a", "b"]]), r"box_name has shape \(1, 2\)"),
    ],
)
def test_a_damaged_file_is_refused_by_name(panda, arrays, write, key, change, message):
    changed = {k: v for k, v in arrays.items() if k != key}
    if change is not None:
        changed[key] = change(arrays.get(key))
    with pytest.raises(ValueError, match=message):
        read_problems(write(changed), panda)


def test_what_is_no_archive_or_empty_or_missing_is_refused(panda, arrays, write, tmp_path):
    text, truncated = tmp_path / "text.npz", tmp_path / "truncated.npz"
    text.write_text("not an archive")
    truncated.write_bytes(write(arrays).read_bytes()[:600])
    array, empty = tmp_path / "array.npy", tmp_path / "empty.npz"
    np.save(array, np.zeros(3))
    empty.write_bytes(b"")
    for file in (text, truncated, array, empty, tmp_path):
        with pytest.raises(ValueError, match="no NumPy archive"):
            read_problems(file, panda)
    per_problem = [key for key, value in arrays.items() if len(value) == 3]
    nothing = arrays | {key: arrays[key][:0] for key in per_problem}
    with pytest.raises(ValueError, match="holds no problem"):
        read_problems(write(nothing), panda)
    with pytest.raises(FileNotFoundError, match="no problems at"):
        read_problems(tmp_path / "none.npz", panda)


def test_a_file_of_another_robot_is_refused(arrays, write):
    with pytest.raises(ValueError, match="panda_joint1, .*those of 'ur5e'.*shoulder_pan, "):
        read_problems(write(arrays), vrrt_jax.load_robot("ur5e"))


def test_files_are_found_in_the_folder_or_in_the_robots(arrays, tmp_path):
    (tmp_path / "panda").mkdir()
    np.savez(tmp_path / "panda" / "b.npz", **arrays)
    np.savez(tmp_path / "panda" / "a.npz", **arrays)
    for folder in (tmp_path, tmp_path / "panda"):
        assert [file.name for file in problem_files(folder, "panda")] == ["a.npz", "b.npz"]
    with pytest.raises(FileNotFoundError, match="one of the folders in it: panda"):
        problem_files(tmp_path, "fetch")


def test_a_base_that_stands_elsewhere_moves_the_obstacles(panda, arrays, write):
    """The same problems, told in a frame in which the base stands elsewhere."""
    turn, shift = Rotation.from_euler("z", BASE[3]), np.array(BASE[:3])
    moved = dict(arrays)
    for key in ("box_pose", "cyl_pose"):
        pose = arrays[key].copy()
        pose[:, 0, :3] = turn.apply(pose[:, 0, :3]) + shift
        pose[:, 0, 3:] = turn.as_quat(scalar_first=True)
        moved[key] = pose
    plain = read_problems(write(arrays, "plain"), panda)
    file = write(moved, "moved")
    base_pose = np.array([*shift, *turn.as_quat(scalar_first=True)])
    with_pose = write(moved | {"base_pose": base_pose}, "with_pose")
    for problems in (read_problems(file, panda, BASE), read_problems(with_pose, panda)):
        for own, same in zip(problems.obstacles, plain.obstacles, strict=True):
            for obstacle, other in zip(own, same, strict=True):
                np.testing.assert_allclose(obstacle.position, other.position, atol=1e-9)
                np.testing.assert_allclose(obstacle.quaternion, other.quaternion, atol=1e-9)
    with pytest.raises(ValueError, match="a base_pose, and a base is given too"):
        read_problems(with_pose, panda, BASE)
    with pytest.raises(ValueError, match="expected x, y, z"):
        read_problems(file, panda, BASE[:3])


def test_the_base_is_that_of_the_base_link(arrays, write):
    """The packaged UR5e turns its base by a quarter: there, that is where it stands already."""
    robot = vrrt_jax.load_robot("ur5e")
    own = {
        "joints": np.array([f"{name}_joint" for name in robot.joint_names]),
        "joint_lower": robot.lower,
        "joint_upper": robot.upper,
        **{key: np.zeros((3, 6)) for key in ("start", "goal")},
    }
    file = write(arrays | own)
    np.testing.assert_allclose(read_problems(file, robot).obstacles[0][0].position, POST)
    (post, _), *_ = read_problems(file, robot, (0.0, 0.0, 0.1, np.pi / 2)).obstacles
    np.testing.assert_allclose(post.position, np.array(POST) - [0, 0, 0.1], atol=1e-9)


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
    return arm.ArmBenchmark(robot=panda, **changes)


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
    assert scene["held_left_out"] == 1 and scene["recompiled"] == 0
    assert [row["held_left_out"] for row in scene["rows"]] == [False, True]
    for row in scene["rows"]:
        # A straight turn of the first joint meets the post.
        assert row["status"] == "SOLVED" and 1.2 < row["cost"] <= row["raw_cost"]
        assert 0 < sum(row["stages_ms"].values()) < row["wall_ms"]
    assert list(scene["stages_ms"]) == ["search", "shortcut", "verify"]
    assert scene["search_median_ms"] == scene["stages_ms"]["search"]
    assert 0 < scene["median_ms"] <= scene["p95_ms"]


def test_the_table_has_a_row_for_each_file(done):
    results, _ = done
    text = arm_table.to_text(results)
    assert "| first | rrt-connect | 2/2 |" in text and "| second | rrt-connect | 2/2 |" in text
    assert "first: refused: file 1 of 3; what the hand holds at the goal was left out of 1" in text


def test_a_run_goes_on_where_it_ended(panda, done, tmp_path, monkeypatch):
    results, folder = done
    files, file = problem_files(folder, "panda"), tmp_path / "results.json"
    solve, calls = arm_trials.solve, []

    def until_second(robot, trial, **settings):
        calls.append(trial.index)
        if len(calls) > 4:  # beyond the first file, whose first plan compiles
            raise KeyboardInterrupt
        return solve(robot, trial, **settings)

    monkeypatch.setattr(arm_trials, "solve", until_second)
    with pytest.raises(KeyboardInterrupt):
        arm.run(_benchmark(panda), files, file)
    kept = json.loads(file.read_text())["scenes"]
    assert list(kept) == ["first"]
    calls.clear()
    whole = arm.run(_benchmark(panda), files, file)
    assert calls == [0, 0, 1] and whole["scenes"]["first"] == kept["first"]
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
    assert not verify_path(panda, trial.obstacles, np.stack([START, GOAL])).ok
    row = ompl_peers.solve(panda, trial, name=name, seed=0)
    assert row["found"] and row["solved"] and row["status"] == "solved"
    assert 1.2 < row["cost"] <= row["raw_cost"]
    assert row["wall_ms"] == pytest.approx(sum(row["stages_ms"].values()))
    assert (row["stages_ms"]["shortcut"] > 0) == (name == "RRTConnect")
