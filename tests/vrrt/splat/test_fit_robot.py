"""A robot's file becomes a folder that plans are made with, in rounds of training."""

import dataclasses
import json
import shutil
import types

import numpy as np
import pytest
from PIL import Image

import vrrt_jax
from vrrt_jax import cli
from vrrt_jax.problems import self_model_path
from vrrt_jax.splat import fit, fit_level, fit_robot, training_images
from vrrt_jax.splat.fit_config import FitConfig, LevelConfig
from vrrt_jax.splat.fit_robot import PICTURE

pytestmark = pytest.mark.light_compilation

LEVEL = LevelConfig(num_splats=60, size_px=32, steps=40, batch=2)
FIRST = FitConfig(
    num_images=16,
    num_surface_images=12,
    num_validation=4,
    image_px=64,
    levels=(LEVEL,),
    close_up=LEVEL,
    close_up_of_px=128,
)
ROUNDS = FIRST, dataclasses.replace(FIRST, num_images=12)


@pytest.fixture(scope="module")
def made(arm, tmp_path_factory):
    """A folder, made of the arm in one round that was interrupted once; the file; what was told."""
    robot, _ = arm
    folder, told = tmp_path_factory.mktemp("made") / "my_arm", []
    file = robot.mesh_source
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "calibrate", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fit_robot.fit_robot(file, folder, minutes=0.0, rounds=ROUNDS)
    with pytest.raises(ValueError, match="no self-model yet"):
        vrrt_jax.load_robot(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "render_images", interrupted)  # they are there already
        fit_robot.fit_robot(file, folder, minutes=0.0, rounds=ROUNDS, progress=told.append)
    return folder, file, told


def interrupted(*_, **__):
    raise KeyboardInterrupt


def test_a_folder_has_all_that_planning_needs(made):
    folder, file, told = made
    assert {entry.name for entry in folder.iterdir()} == {
        "robot.json",
        "robot.xml",
        "self_model.npz",
        PICTURE,
    }
    robot = vrrt_jax.load_robot(folder)
    model = vrrt_jax.load_self_model(self_model_path(robot))
    assert model.robot == robot.name == "my_arm" and model.joint_names == robot.joint_names
    record = json.loads((folder / "robot.json").read_text())
    assert record["rounds"] == 1 and record["made_of"]["source"] == file
    levels = [*model.levels, model.close_up]
    assert [level["psnr_db"] for level in record["levels"]] == [level.psnr_db for level in levels]
    assert all(0 < level["match_threshold"] < 1 for level in record["levels"])
    assert min(level.psnr_db for level in levels) > 14
    assert len(told) == 1 and "round 1" in told[0]
    with Image.open(folder / PICTURE) as picture:
        above, below = np.split(np.asarray(picture, float), 2)
    assert above.std() > 10  # something is drawn, and the self-model draws much the same
    assert np.abs(above - below).mean() < 0.25 * np.abs(above - above.mean()).mean() + 4


def test_training_goes_on_where_it_was(made, tmp_path):
    made_folder, file, _ = made
    folder, told = tmp_path / "my_arm", []
    shutil.copytree(made_folder, folder)
    before = vrrt_jax.load_self_model(folder / "self_model.npz")
    # The time is up before the first step: nothing changes, and what was rendered is kept.
    # Other threads ask the same clock: only this module is told another time.
    clock = iter([0.0, 0.0, 0.0])
    told_time = types.SimpleNamespace(monotonic=lambda: next(clock, 100.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_robot, "time", told_time)
        record = fit_robot.fit_robot(file, folder, minutes=1.0, rounds=ROUNDS, progress=told.append)
    assert record.rounds == 1 and "time is up" in told[0]
    assert vrrt_jax.load_self_model(folder / "self_model.npz").info == before.info
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_level, "initial_splats", interrupted)  # its splats are those of before
        patch.setattr(fit_robot, "WORTH", 1e9)  # one round more
        record = fit_robot.fit_robot(file, folder, minutes=9.0, rounds=ROUNDS)
    after = vrrt_jax.load_self_model(folder / "self_model.npz")
    assert record.rounds == 2 and after.info["num_images"] == 28
    assert not np.array_equal(after.levels[0].splats.mean, before.levels[0].splats.mean)
    assert after.levels[0].psnr_db > before.levels[0].psnr_db - 0.1  # on the same images
    assert after.close_up.psnr_db > before.close_up.psnr_db - 0.1
    assert not list(folder.glob("*.work"))


def test_a_level_that_became_worse_stays_as_it_was(arm, made):
    robot, spec = arm
    level = vrrt_jax.load_self_model(made[0] / "self_model.npz").levels[0]
    held_out, _ = training_images.render_images(robot, spec, FIRST, 3, seed=7)
    splats = dataclasses.replace(level.splats, mean=level.splats.mean + 0.1)
    worse = dataclasses.replace(level, splats=splats, psnr_db=5.0)
    kept = fit_level.better(robot, held_out, level, worse)
    assert kept.splats is level.splats and 15 < kept.psnr_db < 40  # as the new images tell
    much_better = dataclasses.replace(worse, psnr_db=90.0)
    assert fit_level.better(robot, held_out, level, much_better) is much_better


def test_other_arguments_and_other_things_are_refused(made, tmp_path, capsys):
    folder, file, _ = made
    other = tmp_path / "other.xml"
    other.write_text(open(file).read().replace("0.15", "0.16"))
    filled = tmp_path / "filled"
    filled.mkdir()
    (filled / "letter.txt").write_text("dear")
    before = sorted(entry.read_bytes() for entry in folder.iterdir())
    for arguments, words in (
        ([other, "--out", folder], "was made with source"),
        ([file, "--out", folder, "--seed", 1], "was made with seed 0, not 1"),
        ([file, "--out", folder, "--freeze", "turn=0"], "was made with freeze {}"),
        ([file, "--out", filled], "holds other things (letter.txt)"),
        ([file, "--out", tmp_path / "arm.npz"], "names a file; expected a folder, such as"),
        ([file, "--out", tmp_path / "panda"], "the name of a packaged robot"),
        ([folder, "--out", tmp_path / "new"], "is a folder; expected an MJCF or URDF file"),
        ([tmp_path / "none.xml", "--out", tmp_path / "new"], "does not exist"),
        ([file, "--robot", "panda", "--out", tmp_path / "new"], "expected one robot"),
        (["--out", tmp_path / "new"], "expected one robot"),
        ([file, "--out", file], "cannot write to the folder"),
        ([file, "--out", tmp_path / "new", "--minutes", -1], "expected a number from 0"),
    ):
        assert cli.main(["fit", *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1, error
    assert sorted(entry.read_bytes() for entry in folder.iterdir()) == before


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<geom ", '<geom group="3" ', "nothing of 'arm' that moves is drawn"),
        ('<joint name="lift" axis="0 1 0" range="-120 120"/>', "<freejoint/>", "free"),
        ('mujoco model="arm"', "robot", "cannot read"),
    ],
)
def test_what_is_no_arm_or_is_not_seen_is_refused(arm, tmp_path, old, new, words):
    robot, _ = arm
    file = tmp_path / "arm.xml"
    file.write_text(open(robot.mesh_source).read().replace(old, new))
    with pytest.raises(ValueError, match=words):
        fit_robot.fit_robot(file, tmp_path / "out", minutes=0.0, rounds=ROUNDS)
    assert not list((tmp_path / "out").iterdir())  # nothing to go on with


BALLS = """
<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="lift" axis="0 1 0" range="-120 120"/>
      <geom size="0.05" pos="0 0 0.2"/>
      <body name="left" pos="0 0.1 0.4"><joint name="l" range="-1 1"/><geom size="0.03"/></body>
      <body name="right" pos="0 -0.1 0.4"><joint name="r" range="-1 1"/><geom size="0.03"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BALLS, "the robot ends in several links .left, right."),
        (
            BALLS.replace('r" range="-1 1"/><geom', 'r" range="-1 1"/><geom group="3"'),
            "joints r move nothing that is drawn",
        ),
    ],
)
def test_joints_that_no_image_tells_and_several_ends_are_named(tmp_path, text, words):
    (tmp_path / "balls.xml").write_text(text)
    with pytest.warns(UserWarning, match=words):
        fit_robot._visible(vrrt_jax.load_robot(tmp_path / "balls.xml"))


def test_a_random_goal_is_a_problem_of_the_folder(made, tmp_path, capsys):
    folder, _, _ = made
    common = ["plan", "--robot", str(folder), "--goal", "random", "--engine", "closed_form"]
    arguments = cli._parser().parse_args([*common, "--start", "0.1,0.2", "--seed", "3"])
    problem, again = cli._problem(arguments), cli._problem(arguments)
    np.testing.assert_allclose(problem.q_start, [0.1, 0.2])
    assert np.isclose(np.linalg.norm(problem.true_goal - problem.q_start), 1.0, atol=1e-5)
    np.testing.assert_array_equal(problem.goal_images[0], again.goal_images[0])
    assert problem.goal_images[0][..., 3].mean() > 0.005
    result = types.SimpleNamespace(target=problem.true_goal + np.array([0.25, 0.5], np.float32))
    result.joint_uncertainty = np.array([0.1, 3.0])
    assert cli._off_by(problem, result) == (
        "off from the true goal by 0.250 on average, at most 0.250 [rad or m]; without what the "
        "image hardly tells: turn by 0.50"
    )
    for wrong, words in (
        (["--camera", "c.json"], "has a camera and a mask of its own; drop --camera"),
        (["--box", "1,1,9,9"], "a mask of its own; drop --box"),
        (["--start", "9,9"], "start is outside the limits"),
        (["--start", "0.1"], "start has shape"),
        (["--world", "nowhere"], "no world at 'nowhere'"),
    ):
        assert cli.main([*common, "--out", str(tmp_path), *wrong]) == 2
        assert words in capsys.readouterr().err
    assert cli.main(["plan", "--goal", "random"]) == 2
    assert "missing --robot" in capsys.readouterr().err
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "robot.json").unlink()
    assert cli.main(["plan", "--robot", str(tmp_path / "copy"), "--goal", "random"]) == 2
    assert "it has no robot.json" in capsys.readouterr().err


def test_commands_take_the_folder_for_a_robot(made, tmp_path, capsys):
    folder, _, _ = made
    assert cli.main(["spheres", "--robot", str(folder), "--num", "100"]) == 0
    assert "covering" in capsys.readouterr().out
    from vrrt_jax.bench.tasks import Scenery, cameras, goal_images, make_task

    task = make_task(str(folder), 0.5, 0, 0, obstacles=False)
    image = goal_images(str(folder), task, Scenery())[0][0]
    assert image[..., 3].any() and cameras(str(folder), Scenery())[0].height == len(image)
