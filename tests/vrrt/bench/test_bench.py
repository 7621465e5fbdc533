"""The benchmark: tasks, judging, resuming, tables; and the baselines."""

import dataclasses
import json
import signal

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import vrrt_jax
from vrrt_jax.bench import (
    baselines,
    methods,
    pose_ambiguity,
    protocol,
    runner,
    tables,
    tasks,
    worlds,
)
from vrrt_jax.cli import main
from vrrt_jax.core.edges import joint_error
from vrrt_jax.scene.obstacles import load_obstacles, write_obstacles
from vrrt_jax.scene.verify import contacts
from vrrt_jax.scene.world import obstacle_list

ROBOTS = tasks.ROBOTS


@pytest.fixture(scope="module", autouse=True)
def renderers():
    """Renderers keep the meshes of a robot: hundreds of megabytes, of no use to other files."""
    yield
    tasks._renderer.cache_clear()


@pytest.fixture(scope="module")
def near_task():
    return tasks.make_task("panda", 0.5, 0, 0, obstacles=True)


@pytest.mark.parametrize("robot", ROBOTS)
def test_packaged_worlds_hold_what_they_should(robot):
    for k in range(1, tasks.WORLDS_PER_ROBOT + 1):
        obstacles = obstacle_list(tasks.bench_world(robot, f"{robot}_{k}"))
        assert 5 <= sum(o.kind != "plane" for o in obstacles) <= 10
        assert not contacts(tasks.bench_robot(robot), obstacles, tasks.bench_robot(robot).home)


def test_random_worlds_repeat_and_survive_their_file(panda, tmp_path):
    obstacles = worlds.random_world(panda, 1)
    write_obstacles(obstacles, tmp_path / "w.xml", "a comment")
    for written, read in zip(obstacles, load_obstacles(tmp_path / "w.xml"), strict=True):
        assert (written.name, written.kind) == (read.name, read.kind)
        np.testing.assert_allclose(written.position, read.position, atol=1e-6)
        np.testing.assert_allclose(written.size[:1], read.size[:1], atol=1e-6)
    packaged = obstacle_list(tasks.bench_world("panda", "panda_1"))
    assert [o.name for o in packaged] == [o.name for o in obstacles]


@pytest.mark.parametrize("robot", ROBOTS)
def test_tasks_are_free_at_the_right_distance_and_repeat(robot):
    for level in (0.5, 2.5):
        task = tasks.make_task(robot, level, 1, 7, obstacles=True)
        again = tasks.make_task(robot, level, 1, 7, obstacles=True)
        np.testing.assert_array_equal(task.q_goal, again.q_goal)
        other = tasks.make_task(robot, level, 1, 8, obstacles=True)
        assert not np.array_equal(task.q_goal, other.q_goal)
        world = tasks.bench_world(robot, task.world)
        error = joint_error(world, task.q_start, task.q_goal)
        assert np.linalg.norm(error) == pytest.approx(level, abs=1e-3)
        for q in (task.q_start, task.q_goal):
            assert not contacts(tasks.bench_robot(robot), obstacle_list(world), q)


def test_occluded_pixels_are_masked(near_task):
    plain, none = tasks.goal_images("panda", near_task, tasks.Scenery())
    hidden, masks = tasks.goal_images("panda", near_task, tasks.Scenery(occluded=True))
    assert none is None and masks is not None
    assert 0.5 < masks[0].mean() < 0.999
    # Where nothing is in the way both pictures are the same, but for single pixels at edges.
    apart = np.abs(hidden[0][masks[0]] - plain[0][masks[0]]).max(axis=-1)
    assert np.mean(apart > 0.02) < 1e-4 and apart.max() < 0.1


def test_goal_images_are_taken_as_told(near_task):
    def taken(**scenery):
        return tasks.goal_images("panda", near_task, tasks.Scenery(**scenery))[0][0]

    plain, half, side = taken(), taken(light=0.5), taken(light="side")
    inside = plain[..., 3] == 1
    np.testing.assert_allclose(half[inside], plain[inside] * [0.5, 0.5, 0.5, 1.0], atol=1e-6)
    np.testing.assert_array_equal(side[..., 3], plain[..., 3])
    assert np.abs(side - plain)[inside].max() > 0.3
    rough = taken(noise=0.05, jpeg=60, mask="estimated")
    np.testing.assert_array_equal(rough, taken(noise=0.05, jpeg=60, mask="estimated"))
    assert 0.01 < np.abs(rough - plain)[inside].mean() < 0.1
    assert set(np.unique(rough[..., 3])) == {0.0, 1.0}


def test_psnr_is_highest_at_the_goal(near_task):
    scenery = tasks.Scenery(views=2)
    images, _ = tasks.goal_images("panda", near_task, scenery)
    at_goal = tasks.image_psnr("panda", near_task.q_goal, images, scenery)
    at_start = tasks.image_psnr("panda", near_task.q_start, images, scenery)
    assert at_goal > 60 > at_start


def test_twins_look_alike(near_task, tmp_path, monkeypatch, capsys):
    q = pose_ambiguity.twin("panda", near_task).q_goal
    assert abs(q[-1] - near_task.q_goal[-1]) == pytest.approx(np.pi, abs=1e-5)
    np.testing.assert_array_equal(q[:-1], near_task.q_goal[:-1])
    assert not pose_ambiguity._is_nearer(
        "panda", near_task
    )  # the goal is half a radian from the start

    tasks._renderer.cache_clear()  # those of the Panda
    monkeypatch.setattr(pose_ambiguity, "ROBOTS", ("ur5e",))
    monkeypatch.setattr(pose_ambiguity, "LEVELS", (2.5,))
    monkeypatch.setattr(pose_ambiguity, "NUM_COMPARED", 1)
    figure = tmp_path / "twins.png"
    assert main(["bench", "twins", "--tasks-per-level", "9", "--figure", str(figure)]) == 0
    (level,) = json.loads(capsys.readouterr().out)["ur5e"]
    assert level["n"] == 9 and level["psnr_db"] > 45  # its gripper is the same half a turn on
    assert level["twin_is_nearer"] == pytest.approx(2 / 9)
    assert figure.stat().st_size > 10_000


@pytest.mark.parametrize("occluded", [False, True])
def test_one_measure_says_whether_poses_look_the_same(near_task, occluded):
    """Also where obstacles hide a part of the robot: it is hidden in both images."""
    scenery = tasks.Scenery(occluded=occluded)
    model = methods._self_model("panda")

    def alike(q):
        return pose_ambiguity.looks_the_same("panda", near_task, q, model, scenery, 128)

    assert alike(near_task.q_goal) and not alike(near_task.q_start)
    images, masks = tasks.goal_images("panda", near_task, scenery)
    assert tasks.image_psnr("panda", near_task.q_goal, images, scenery, masks) > 50
    nudged = near_task.q_goal + np.float32(0.001)
    assert alike(nudged)


def _attempt(**changes):
    fields = {
        "path": np.zeros((2, 7)),
        "matched": True,
        "has_path": True,
        "out_of_time": False,
        "loss": 0.0,
        "search_s": 1.0,
    }
    return methods.Attempt(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "judged", "cause"),
    [
        ({"matched": False}, {}, "no match found"),
        ({}, {}, "matched the wrong pose"),
        ({}, {"alike": True}, "wrong pose that looks the same"),
        ({"has_path": False}, {"right": True, "alike": True}, "right pose, no path"),
        ({"has_path": False}, {"right": True, "known": False}, "right pose, no path known"),
        ({"out_of_time": True}, {"right": True}, "out of time"),
        ({}, {"right": True, "valid": False}, "invalid path"),
    ],
)
def test_causes(changes, judged, cause):
    judged = {"right": False, "valid": True, "alike": False, "known": True} | judged
    assert methods._cause(_attempt(**changes), **judged) == cause
    assert cause in methods.CAUSES


def _benchmark(**changes):
    settings = {"levels": (0.5,), "tasks_per_level": 2, "seed": 3, "method": "dr-robot"}
    return protocol.benchmark("visual", "panda", **{**settings, **changes})


def test_results_stream_resume_and_are_not_mixed(tmp_path, monkeypatch):
    file = tmp_path / "results.json"
    runner.run(_benchmark(tasks_per_level=1), file)
    first = json.loads(file.read_text())["tasks"]
    assert len(first) == 1

    solved = []
    original = runner.solve
    monkeypatch.setattr(
        runner, "solve", lambda *a, **k: solved.append(a[1].index) or original(*a, **k)
    )
    results = runner.run(_benchmark(), file)
    assert solved == [1]  # the other one was in the file
    assert results["tasks"][0] == first[0]
    assert results["levels"][0]["n"] == 2
    for other in ({"seed": 4}, {"method": "prof-robot"}, {"time_limit_s": 5.0}):
        with pytest.raises(ValueError, match="not mixed"):
            runner.run(_benchmark(**other), file)
    for other in ({"versions": {"jax": "0.0"}}, {"self_model": "of another training"}):
        file.write_text(json.dumps(results | other))
        with pytest.raises(ValueError, match="not mixed"):
            runner.run(_benchmark(), file)


def test_full_disk_keeps_what_was_done(tmp_path, monkeypatch):
    file = tmp_path / "results.json"
    runner.run(_benchmark(tasks_per_level=1), file)
    before = file.read_text()

    def full(self, *args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(file), "replace", full)
    with pytest.raises(OSError, match="No space left.*goes on from there"):
        runner.run(_benchmark(), file)
    assert file.read_text() == before and list(tmp_path.iterdir()) == [file]


def test_summary():
    row = {
        "variant": "vrrt",
        "level": 0.5,
        "success": True,
        "cause": "",
        "time_s": 1.0,
        "path_length": 2.0,
        "path_over_reference": 1.1,
        "mean_error_rad": 0.01,
        "psnr_db": 30.0,
        "straight_is_blocked": False,
    }
    lost = {**row, "success": False, "cause": "no match found", "time_s": 3.0}
    summary = runner.summarize([row, lost, {**row, "level": 1.0}])
    assert summary["average_success"] == pytest.approx(0.75)
    level = summary["levels"][0]
    assert (level["n"], level["success"], level["median_time_s"]) == (2, 0.5, 2.0)
    assert level["causes"] == {"no match found": 1}
    assert (level["path_length"], level["path_over_reference"]) == (2.0, 1.1)  # of solved tasks


def test_unknown_names_list_the_known(capsys):
    for words, known in (
        (["--robot", "pr2"], "panda, ur5e, fetch"),
        (["--robot", "panda", "--method", "magic"], "vrrt, dr-robot"),
        (["--robot", "panda", "--config", "best"], "default, paper"),
        (["--robot", "panda", "--levels", "0"], "above 0"),
    ):
        assert main(["bench", "visual", *words]) == 2
        assert known in capsys.readouterr().err


def test_page_has_tables_and_figures(tmp_path):
    file = tmp_path / "results.json"
    runner.run(_benchmark(), file)
    page = tables.write_page([file], tmp_path)
    text = page.read_text()
    assert "19.3" in text and "RTX 4090" in text  # the paper's, labeled
    assert "--method dr-robot" in text
    assert (tmp_path / "visual_panda.png").stat().st_size > 10_000
    with pytest.raises(ValueError, match=r"README.md' is not valid JSON"):
        tables.write_page([page], tmp_path)


@pytest.mark.parametrize("config", ["paper", "default"])
def test_ablations_vary_one_setting_each(config):
    make = {"paper": vrrt_jax.PlannerConfig.paper, "default": vrrt_jax.PlannerConfig}[config]
    base = make().changed({"budget.time_limit_s": 60.0})
    variants = protocol.benchmark(
        "ablation", "panda", levels=(1.5,), tasks_per_level=1, seed=0, config=config
    ).variants
    assert len({variant.name for variant in variants}) == len(variants)
    for variant in variants:
        a, b = (
            {
                f"{stage}.{name}": value
                for stage, fields in dataclasses.asdict(settings).items()
                for name, value in fields.items()
            }
            for settings in (variant.config, base)
        )
        assert sum(a[name] != b[name] for name in a) <= 1


def test_dr_robot_is_a_plain_adam_chain(near_task):
    robot, world = tasks.bench_robot("panda"), tasks.bench_world("panda", near_task.world)
    images, _ = tasks.goal_images("panda", near_task, tasks.Scenery())
    inputs = (methods._self_model("panda"), tasks.cameras("panda", tasks.Scenery()), images)
    found = baselines.dr_robot(
        robot, world, *inputs, near_task.q_start, config=baselines.ChainConfig(steps=12)
    )
    goal = vrrt_jax.ImageGoal(*inputs).at(robot, vrrt_jax.TreeConfig().image_px)
    gradient = jax.jit(jax.grad(lambda q: goal.loss(world, q)))
    adam = optax.adam(0.04, b1=0.9, b2=0.9)
    q, path = jnp.asarray(near_task.q_start), []
    state = adam.init(q)
    for _ in range(12):
        path.append(np.asarray(q))
        updates, state = adam.update(gradient(q), state)
        q = jnp.clip(optax.apply_updates(q, updates), world.lower, world.upper)
    np.testing.assert_allclose(found.path, np.stack(path)[: len(found.path)], atol=2e-2)
    assert found.loss <= float(goal.loss(world, jnp.asarray(near_task.q_start)))


@pytest.mark.light_compilation
def test_rrt_star_arrives_where_joints_wrap():
    robot, world = tasks.bench_robot("fetch"), tasks.bench_world("fetch", "")
    joint = int(np.flatnonzero(robot.is_continuous)[-1])
    path = np.stack([robot.home, robot.home]).astype(np.float32)
    path[:, joint] = 3.0, -3.0
    estimate = baselines.BaselineResult(
        path=path, loss=0.0, match_threshold=1.0, found_path=True, search_s=0.0
    )
    found = baselines.rrt_star_to_estimate(
        robot, world, estimate, key=jax.random.key(0), iterations=3
    )
    assert found.found_path
    assert found.path[-1, joint] == pytest.approx(2 * np.pi - 3.0, abs=1e-3)


def test_an_interrupted_task_is_not_recorded(tmp_path, monkeypatch):
    def interrupted(*args, **kwargs):
        signal.raise_signal(signal.SIGINT)  # as the planner's blocks see it: a flag
        return {"success": False}

    file = tmp_path / "results.json"
    monkeypatch.setattr(runner, "solve", interrupted)
    with pytest.raises(KeyboardInterrupt):
        runner.run(_benchmark(), file)
    assert json.loads(file.read_text())["tasks"] == []


def test_classifier_learns_the_scene(monkeypatch):
    for name, value in (("SAMPLES", 20_000), ("TRAIN_STEPS", 300), ("TRAIN_BATCH", 1024)):
        monkeypatch.setattr(baselines, name, value)
    robot, world = tasks.bench_robot("panda"), tasks.bench_world("panda", "panda_5")
    classifier, accuracy = baselines.train_classifier(robot, world)
    assert accuracy > 0.7
    q = jnp.asarray(np.random.default_rng(1).uniform(robot.lower, robot.upper, (200, 7)))
    slope = jnp.linalg.norm(jax.vmap(jax.grad(classifier))(q), axis=1)
    assert 0.1 < float(jnp.median(slope)) < 2.0  # the Eikonal term keeps a gradient everywhere
