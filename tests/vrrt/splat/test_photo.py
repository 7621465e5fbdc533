"""A photograph with its camera's files becomes an image goal's image, camera and mask."""

import json
from pathlib import Path

import numpy as np
import pytest
from photo_cases import before, clutter, overlap, taken, thing, through_lens
from PIL import Image

import vrrt_jax
from vrrt_jax.cli import main
from vrrt_jax.splat.camera_fields import camera_and_lens
from vrrt_jax.splat.images import check_views

HEIGHT, WIDTH = 240, 320
POSE = vrrt_jax.look_at((1.1, 0.3, 0.8), (0, 0, 0.3), height=HEIGHT, width=WIDTH)
MATRIX = [[float(POSE.focal), 0, 159.5], [0, float(POSE.focal), 119.5], [0, 0, 1]]
FIELDS = {
    "camera_matrix": MATRIX,
    "distortion_coefficients": [-0.4, 0.15, 0.0005, -0.0005, 0.0],
    "image_width": WIDTH,
    "image_height": HEIGHT,
}
EXTRINSICS = {"world_to_camera": np.asarray(POSE.world_to_cam, float).tolist()}


@pytest.fixture(scope="module")
def shot():
    """What the pinhole camera would see of a thing, and what the real one sees and saw before."""
    picture = thing(HEIGHT, WIDTH)
    _, lens = camera_and_lens(FIELDS | EXTRINSICS, (HEIGHT, WIDTH))
    scene = clutter(HEIGHT, WIDTH)
    image = taken(through_lens(before(picture, scene), lens), exposure=0.8, noise=0.01)
    empty = taken(through_lens(scene, lens), noise=0.01, seed=1)
    mask = taken(through_lens(np.repeat(picture.alpha[..., None], 3, 2), lens))
    return picture, image, empty, mask


def test_image_and_mask_lose_their_distortion_together(shot):
    picture, image, empty, mask = shot
    camera = FIELDS | EXTRINSICS
    assert overlap(mask[..., 0] / 255, picture.alpha) < 0.93  # the lens does bend
    ys, xs = np.nonzero(mask[..., 0])
    box = (xs.min() - 8, ys.min() - 8, xs.max() + 8, min(ys.max() + 8, HEIGHT))
    for option, least in (
        ({"robot_mask": mask}, 0.97),
        ({"background": empty}, 0.93),
        ({"box": box}, 0.85),
    ):
        photo = vrrt_jax.load_photo(image, camera, **option)
        assert photo.mask is None  # a barrel: all is known
        assert overlap(photo.image[..., 3], picture.alpha) > least
        np.testing.assert_allclose(photo.camera.world_to_cam, POSE.world_to_cam, atol=1e-6)
        (view,) = check_views([photo.image], [photo.camera], [photo.mask])
        assert 0.02 < view.alpha.mean() < 0.5


def test_files_and_what_is_hidden(shot, tmp_path):
    _, image, empty, _ = shot
    for name, pixels in (("goal.png", image), ("empty.png", empty)):
        Image.fromarray(pixels).save(tmp_path / name)
    (tmp_path / "camera.json").write_text(json.dumps(FIELDS))
    (tmp_path / "pose.json").write_text(json.dumps(EXTRINSICS))
    files = {"camera": tmp_path / "camera.json", "extrinsics": tmp_path / "pose.json"}
    seen = np.ones((HEIGHT, WIDTH), bool)
    seen[:, 250:] = False
    photo = vrrt_jax.load_photo(
        tmp_path / "goal.png", **files, background=tmp_path / "empty.png", mask=seen
    )
    assert photo.mask is not None and photo.mask[:, 100:200].all() and not photo.mask[:, -30:].any()
    camera = FIELDS | EXTRINSICS
    same = vrrt_jax.load_photo(image, camera, background=empty, mask=seen)
    np.testing.assert_array_equal(photo.image, same.image)


def test_what_does_not_go_together_is_refused(shot):
    _, image, empty, mask = shot
    camera = FIELDS | EXTRINSICS
    faint = np.dstack([image, mask[..., 0]])
    for picture, options, message in (
        (image, {"background": empty, "box": (1, 1, 9, 9)}, "got background and box; give one"),
        (faint, {"background": empty}, "has a mask already, its fourth channel; drop background"),
        (image, {"robot_mask": np.zeros((HEIGHT, WIDTH))}, "mask is all black"),
        (image, {"robot_mask": faint}, "or has transparency"),
        (image, {"robot_mask": mask[:100]}, "the robot's mask has shape"),
        (image[:120], {}, "calibration is for images of 320x240 px, this one has 320x120"),
        (image, {"extrinsics": EXTRINSICS}, "has world_to_camera already"),
    ):
        with pytest.raises(ValueError, match=message):
            vrrt_jax.load_photo(picture, camera, **options)


def test_options_of_the_command_are_told_in_one_line(shot, tmp_path, capsys):
    _, image, empty, _ = shot
    Image.fromarray(image).save(tmp_path / "goal.png")
    Image.fromarray(empty).save(tmp_path / "empty.png")
    (tmp_path / "camera.json").write_text(json.dumps(FIELDS))
    (tmp_path / "pose.yaml").write_text(json.dumps(EXTRINSICS))
    start = "--start=0,0.3,0,-1.6,0,2,0.8"
    given = ["plan", "--robot", "panda", "--world", "open", start, "--out", tmp_path / "out"]
    given += ["--goal", tmp_path / "goal.png", "--camera", tmp_path / "camera.json"]
    pose = ["--extrinsics", tmp_path / "pose.yaml"]
    for options, message in (
        ([], "no extrinsics; say where the camera is"),
        ([*pose, "--box", "1,2,3"], "'1,2,3' is not a box"),
        ([*pose, "--box", "1,2,900,40"], "is not inside the image of 320x240 px"),
        ([*pose, "--box=-1,2,90,40"], "is not inside the image of 320x240 px"),
        ([*pose, "--background", tmp_path / "none.png"], "no picture: cannot read"),
        ([*pose, "--background", tmp_path / "goal.png"], "hardly differs"),
        (
            [*pose, "--robot-mask", *[tmp_path / "empty.png"] * 2],
            "1 goal images but 2 of --robot-m",
        ),
        ([*pose, "--problem", "panda_posts"], "not both"),
    ):
        assert main([str(word) for word in [*given, *options]]) == 2
        told = capsys.readouterr().err
        assert message in told and told.count("\n") == 1, told


def test_a_problem_keeps_what_a_lens_has_left_unknown(shot, tmp_path):
    """Also in the folder that plans write."""
    from vrrt_jax.problems import load_problem, save_problem

    _, image, _, mask = shot
    Image.fromarray(np.dstack([image, mask[..., 0]])).save(tmp_path / "goal.png")
    pincushion = FIELDS | EXTRINSICS | {"distortion_coefficients": [0.3, 0.0, 0.0, 0.0, 0.0]}
    (tmp_path / "camera.json").write_text(json.dumps(pincushion))
    start = vrrt_jax.load_robot("panda").home.tolist()
    fields = {"robot": "panda", "world": "open", "start": [float(value) for value in start]}
    fields["views"] = [{"image": "goal.png", "camera": "camera.json"}]
    (tmp_path / "problem.json").write_text(json.dumps(fields))
    problem = load_problem(tmp_path, engine="closed_form")
    (known,) = problem.masks
    assert 0.7 < known.mean() < 1
    np.testing.assert_array_equal(problem.goal.checked[0].valid > 0, known)
    save_problem(problem, tmp_path / "copy")
    copy = load_problem(tmp_path / "copy", engine="closed_form")
    np.testing.assert_array_equal(copy.masks[0], known)
    assert Path(tmp_path / "copy" / "mask_1.png").is_file()


def test_a_mask_file_may_be_0_and_1_and_must_not_be_inverted(tmp_path):
    pose = {"position": [1.5, 0, 0.8], "target": [0, 0, 0.4], "fovy_deg": 45}
    image, mask = np.full((40, 60, 3), 128, np.uint8), np.zeros((40, 60), np.uint8)
    mask[10:, 20:40] = 1
    Image.fromarray(mask).save(tmp_path / "mask.png")
    photo = vrrt_jax.load_photo(image, pose, robot_mask=tmp_path / "mask.png")
    np.testing.assert_array_equal(photo.image[..., 3], mask)
    Image.fromarray(255 * (1 - mask)).save(tmp_path / "inverted.png")
    with pytest.raises(ValueError, match="white on 90 % of the image's rim.*invert it"):
        vrrt_jax.load_photo(image, pose, robot_mask=tmp_path / "inverted.png")
