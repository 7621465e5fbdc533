"""Photographs in DREAM's format: read, placed by PnP, planned to, and gone on with."""

import json
import shutil

import numpy as np
import pytest
from photo_cases import before, clutter, dream_folder, overlap, taken
from pictures import HALF_TURNED, Q_GOAL, picture
from PIL import Image

import vrrt_jax
from vrrt_jax.bench import dream, dream_data, dream_table
from vrrt_jax.cli import main
from vrrt_jax.problems import self_model_path
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.mujoco_images import Picture


@pytest.fixture(scope="module")
def folder(panda, tmp_path_factory):
    """Two frames, the second of which is damaged, rendered by the self-model before clutter."""
    camera = vrrt_jax.load_problem("panda_posts").cameras[0]
    model = vrrt_jax.load_self_model(self_model_path(panda))
    straight = picture(panda, model, camera, Q_GOAL)
    alpha = straight[..., 3]
    shot = Picture(rgb=straight[..., :3] * alpha[..., None], alpha=alpha, valid=alpha > 0)
    scene = clutter(camera.height, camera.width)
    image = taken(before(shot, scene), exposure=0.9, noise=0.01)
    path = tmp_path_factory.mktemp("dream") / "panda"
    dream_folder(path, panda, camera, [(Q_GOAL, image, alpha), (HALF_TURNED, image, alpha)])
    Image.fromarray(taken(scene, noise=0.01, seed=1)).save(path.parent / "empty.jpg", quality=90)
    (path / "000001.json").write_text("{")
    return path, camera


def test_the_camera_is_found_from_keypoints(folder, panda, rng):
    path, camera = folder
    matrix, size = dream_data.load_intrinsics(path)
    frame = dream_data.load_frame(path, "000000", panda)
    np.testing.assert_allclose(frame.q, Q_GOAL, atol=1e-6)
    pose, off_px = dream_data.solve_pose(frame, panda, matrix, size)
    np.testing.assert_allclose(pose, camera.world_to_cam, atol=2e-3)
    assert off_px < 0.01
    points = np.float32(rng.normal(size=(9, 3)) * 0.3 + [0, 0, 0.5])
    placed = dream_data.pinhole(matrix, size, pose)
    np.testing.assert_allclose(project(placed, points)[0], project(camera, points)[0], atol=0.1)
    # Keypoints of another pose are no keypoints of this one, and few do not tell.
    other = dream_data.Frame(**vars(frame) | {"q": panda.home + np.float32(0.5)})
    with pytest.raises(ValueError, match="no camera pose puts the keypoints"):
        dream_data.solve_pose(other, panda, matrix, size)
    few = dict(list(frame.keypoints.items())[:3])
    with pytest.raises(ValueError, match="shows 3 keypoints .* expected at least 4"):
        dream_data.solve_pose(
            dream_data.Frame(**vars(frame) | {"keypoints": few}), panda, matrix, size
        )


def test_places_of_bodies_are_those_of_the_planner_s_kinematics(panda, rng):
    q = rng.uniform(panda.lower, panda.upper).astype(np.float32)
    places = dream_data.body_places(panda, q)
    poses = np.asarray(vrrt_jax.link_poses(panda.chain, q))
    for name, pose in zip(panda.link_names[1:], poses[1:], strict=True):
        np.testing.assert_allclose(places[name], pose[:3, 3], atol=1e-5)


def test_starts_are_as_far_away_as_told(panda):
    world = vrrt_jax.build_world(panda, [], engine="closed_form")
    for level in (0.5, 1.5):
        start = dream.draw_start(panda, world, Q_GOAL, level, np.random.default_rng(1))
        assert np.linalg.norm(start - Q_GOAL) == pytest.approx(level, abs=1e-4)
        assert np.all((start >= panda.lower) & (start <= panda.upper))
        again = dream.draw_start(panda, world, Q_GOAL, level, np.random.default_rng(1))
        np.testing.assert_array_equal(start, again)


def test_the_box_holds_the_robot(folder, panda):
    path, camera = folder
    x0, y0, x1, y1 = dream.robot_box(panda, Q_GOAL, camera)
    with Image.open(path / "000000.mask.png") as mask:
        ys, xs = np.nonzero(np.asarray(mask))
    assert 0 <= x0 <= xs.min() and xs.max() <= x1 <= camera.width
    assert 0 <= y0 <= ys.min() and ys.max() <= y1 <= camera.height
    assert (x1 - x0) * (y1 - y0) < 3 * np.ptp(xs) * np.ptp(ys)


def test_frames_are_planned_to_and_gone_on_with(folder, tmp_path):
    path, _ = folder
    file = tmp_path / "dream.json"
    benchmark = dream.DreamBenchmark(
        folder=str(path),
        levels=(0.5,),
        engine="closed_form",
        config=vrrt_jax.PlannerConfig().changed({"budget.attempts": 1, "polish.close_px": 0}),
    )
    results = dream.run(benchmark, file)
    good, bad = results["rows"]
    assert good["matched"] and good["mean_error_rad"] < 0.05 and len(good["error_rad"]) == 7
    assert bad["frame"] == "000001" and "not valid JSON" in bad["refused"]
    (level,) = results["levels"]
    assert (level["n"], level["refused"], level["matched"]) == (1, 1, 1)
    assert level["last_rad"] == pytest.approx(good["error_rad"][-1], abs=1e-3)
    assert level["mean_rad"] == pytest.approx(np.mean(good["error_rad"]), abs=1e-3)
    text = dream_table.to_text(results)
    assert "| 0.5 | 1 | 1 |" in text and "| J7 |" in text and "000001: " in text
    assert json.loads(file.read_text()) == results
    assert dream.run(benchmark, file)["rows"] == results["rows"]  # nothing is planned again
    changed = dream.DreamBenchmark(**vars(benchmark) | {"seed": 1})
    with pytest.raises(ValueError, match="has seed 0, this run 1"):
        dream.run(changed, file)
    rows = json.loads(file.read_text())
    rows["rows"][0]["fingerprint"] = "another"
    file.write_text(json.dumps(rows))
    with pytest.raises(ValueError, match="frame 000000 has changed since"):
        dream.run(benchmark, file)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--mask", "paint"], "invalid choice: 'paint'"),
        (["--mask", "background"], "--mask background and --background FILE belong together"),
        (["--mask", "plain", "--levels", "7"], "expected distances below pi"),
        (["--mask", "plain", "--robot", "kuka"], "unknown robot 'kuka'; have: panda"),
        (["--mask", "plain", "--extrinsics", "none.json"], "cannot read 'none.json'"),
    ],
)
def test_options_are_checked_before_any_work(folder, options, message, capsys):
    code = main(["bench", "dream", str(folder[0]), "--engine", "closed_form", *options])
    told = capsys.readouterr().err
    assert code == 2 and message in told and told.count("\n") == 1


def test_masks_that_are_asked_for_have_to_be_there(folder, tmp_path):
    for name in ("_camera_settings.json", "000000.json", "000000.rgb.jpg"):
        shutil.copy(folder[0] / name, tmp_path)
    benchmark = dream.DreamBenchmark(folder=str(tmp_path), engine="closed_form")
    with pytest.raises(FileNotFoundError, match="1 frames have no mask .* 000000.mask.png"):
        dream.run(benchmark, None)


@pytest.mark.parametrize("mask", ["background", "box", "file"])
def test_the_robot_is_told_from_its_surroundings(folder, panda, mask):
    path, camera = folder
    empty = str(path.parent / "empty.jpg") if mask == "background" else None
    benchmark = dream.DreamBenchmark(folder=str(path), mask=mask, background=empty)
    frame = dream_data.load_frame(path, "000000", panda)
    image = dream._goal_image(benchmark, frame, camera)
    with Image.open(path / "000000.mask.png") as true:
        assert overlap(image[..., 3], np.asarray(true) / 255) > 0.85


def test_other_folders_are_explained(folder, tmp_path, panda, capsys):
    path, _ = folder
    assert main(["bench", "dream", str(tmp_path)]) == 2
    assert "cannot read" in capsys.readouterr().err
    settings = json.loads((path / "_camera_settings.json").read_text())
    settings["camera_settings"][0]["intrinsic_settings"]["s"] = 0.5
    (tmp_path / "_camera_settings.json").write_text(json.dumps(settings))
    with pytest.raises(ValueError, match="has the skew 0.5"):
        dream_data.load_intrinsics(tmp_path)
    (tmp_path / "_camera_settings.json").write_text("{}")
    with pytest.raises(ValueError, match="expected camera_settings"):
        dream_data.load_intrinsics(tmp_path)
    with pytest.raises(FileNotFoundError, match="no frames in"):
        dream_data.frame_names(tmp_path)
    fields = json.loads((path / "000000.json").read_text())
    joints = fields["sim_state"].pop("joints")
    (tmp_path / "000000.json").write_text(json.dumps(fields))
    with pytest.raises(ValueError, match="lacks 'joints'; expected sim_state.joints"):
        dream_data.load_frame(tmp_path, "000000", panda)
    fields["sim_state"]["joints"] = joints[1:]
    (tmp_path / "000000.json").write_text(json.dumps(fields))
    with pytest.raises(ValueError, match="lacks the joints joint1 of 'panda'"):
        dream_data.load_frame(tmp_path, "000000", panda)
    fields["sim_state"]["joints"] = joints
    (tmp_path / "000000.json").write_text(json.dumps(fields))
    with pytest.raises(FileNotFoundError, match="no image of frame 000000"):
        dream_data.load_frame(tmp_path, "000000", panda)
