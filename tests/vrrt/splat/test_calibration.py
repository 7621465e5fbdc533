"""Calibrations of OpenCV and ROS: read rightly in every spelling, or refused by name."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import vrrt_jax
from vrrt_jax.core.data_file import read_fields
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.camera_fields import camera_and_lens, camera_from_dict, with_extrinsics

SIZE = (480, 640)
MATRIX = [[610.0, 0.0, 330.5], [0.0, 605.0, 236.25], [0.0, 0.0, 1.0]]
D5 = [-0.3, 0.11, 0.0007, -0.0004, -0.02]
D8 = [0.4, -2.5, 0.0006, -0.0003, 1.5, 0.3, -2.3, 1.4]
POSE = np.asarray(vrrt_jax.look_at((1.5, 0.4, 0.9), (0, 0, 0.4)).world_to_cam, float)
INVERSE = np.linalg.inv(POSE)
OPENCV = {
    "camera_matrix": MATRIX,
    "distortion_coefficients": D5,
    "image_width": 640,
    "image_height": 480,
    "world_to_camera": POSE.tolist(),
}
ROS = {
    "camera_name": "left",
    "image_width": 640,
    "image_height": 480,
    "camera_matrix": {"rows": 3, "cols": 3, "data": np.ravel(MATRIX).tolist()},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": D5},
    "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
    "projection_matrix": {
        "rows": 3,
        "cols": 4,
        "data": [540.0, 0, 333, 0, 0, 560.0, 231, 0, 0, 0, 1, 0],
    },
    "camera_to_world": INVERSE.tolist(),
}
MESSAGE = {
    "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "optical"},
    "height": 480,
    "width": 640,
    "distortion_model": "rational_polynomial",
    "d": D8,
    "k": np.ravel(MATRIX).tolist(),
    "r": np.eye(3).ravel().tolist(),
    "p": [540.0, 0, 333, 0, 0, 560.0, 231, 0, 0, 0, 1, 0],
    "binning_x": 0,
    "binning_y": 0,
    "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    "world_to_camera": POSE.tolist(),
}


PAGE = Path(__file__).parents[3] / "docs" / "your_photograph.md"


def without(fields, *names):
    return {name: value for name, value in fields.items() if name not in names}


def test_points_are_where_opencv_puts_them(rng):
    """Of a pinhole camera: OpenCV's pixels are half a pixel less than ours."""
    camera, lens = camera_and_lens(OPENCV | {"distortion_coefficients": []}, SIZE)
    assert lens is None
    points = rng.normal(size=(20, 3)) * 0.3 + [0, 0, 0.4]
    turn, _ = cv2.Rodrigues(POSE[:3, :3])
    expected = cv2.projectPoints(points, turn, POSE[:3, 3], np.array(MATRIX), None)[0][:, 0]
    pixels, _ = project(camera, points.astype(np.float32))
    np.testing.assert_allclose(np.asarray(pixels) - 0.5, expected, atol=2e-3)


def test_all_spellings_are_one_camera(tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "opencv.yml"), cv2.FileStorage_WRITE)
    json_storage = cv2.FileStorage(str(tmp_path / "opencv.json"), cv2.FileStorage_WRITE)
    for out in (storage, json_storage):
        out.write("image_width", 640)
        out.write("image_height", 480)
        out.write("camera_matrix", np.array(MATRIX))
        out.write("distortion_coefficients", np.array(D5)[:, None])
        out.write("avg_reprojection_error", 0.3)
        out.release()
    extrinsics = {"world_to_camera": POSE.tolist()}
    read = [read_fields(tmp_path / name) for name in ("opencv.yml", "opencv.json")]
    short = {"K": MATRIX, "D": D5, "width": 640, "height": 480}
    for fields in (*read, short, {"mtx": MATRIX, "dist": [D5], "width": 640, "height": 480}):
        camera, lens = camera_and_lens(with_extrinsics(fields, extrinsics), SIZE)
        expected, same = camera_and_lens(OPENCV, SIZE)
        np.testing.assert_allclose(camera.principal_point, expected.principal_point)
        np.testing.assert_allclose(lens.coefficients, same.coefficients)
        np.testing.assert_allclose(lens.matrix, MATRIX)
        np.testing.assert_allclose(lens.pinhole, MATRIX)


@pytest.mark.parametrize("fields", [ROS, MESSAGE])
def test_ros_undistorts_into_its_projection_matrix(fields, tmp_path):
    (tmp_path / "info.yaml").write_text(yaml.safe_dump(fields))
    camera, lens = camera_and_lens(read_fields(tmp_path / "info.yaml"), SIZE)
    np.testing.assert_allclose(lens.matrix, MATRIX)
    assert lens.model == "rational"
    for seen in (camera, camera_and_lens(fields | {"rectified": True}, SIZE)[0]):
        np.testing.assert_allclose(seen.principal_point, [333.5, 231.5])
        np.testing.assert_allclose([seen.focal, seen.aspect], [560.0, 540 / 560], rtol=1e-6)
    assert camera_and_lens(fields | {"rectified": True}, SIZE)[1] is None
    # What has no distortion stays as it was taken.
    d = "d" if "d" in fields else "distortion_coefficients"
    plain, none = camera_and_lens(fields | {d: [0.0] * 5}, SIZE)
    assert none is None and np.allclose(plain.principal_point, [331, 236.75])


def test_all_ways_to_say_where_the_camera_is():
    x, y, z, w = Rotation.from_matrix(INVERSE[:3, :3]).as_quat()
    move = INVERSE[:3, 3]
    of_fields = {"x": x, "y": y, "z": z, "w": w}, dict(zip("xyz", move, strict=True))
    bare = without(OPENCV, "world_to_camera")
    for pose in (
        {"camera_to_world": INVERSE.tolist()},
        {"camera_to_world": {"translation": move, "quaternion_xyzw": [x, y, z, w]}},
        {"camera_to_world": {"translation": move, "quaternion_wxyz": [w, x, y, z]}},
        {"camera_to_world": {"rotation": of_fields[0], "translation": of_fields[1]}},
        {"camera_to_world": {"orientation": of_fields[0], "position": of_fields[1]}},
        {"world_to_camera": POSE.tolist()},
        {"world_to_cam": POSE.tolist()},
    ):
        camera, _ = camera_and_lens(with_extrinsics(bare, pose), SIZE)
        np.testing.assert_allclose(camera.world_to_cam, POSE, atol=1e-6)


def test_a_resized_image_has_to_be_told():
    half = OPENCV | {"distortion_coefficients": [0, 0, 0, 0, 0], "image_scale": 0.5}
    camera, _ = camera_and_lens(half, (240, 320))
    np.testing.assert_allclose(camera.principal_point, [331 / 2, 236.75 / 2])
    np.testing.assert_allclose(camera.focal, 302.5)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (without(OPENCV, "world_to_camera"), 'no extrinsics; say where .*"camera_to_world"'),
        (OPENCV | {"camera_to_world": POSE.tolist()}, "camera_to_world and world_to_camera"),
        (OPENCV | {"world_to_camera": POSE.T.tolist()}, "transpose the matrix"),
        (OPENCV | {"world_to_camera": {"translation": [0, 0, 1]}}, "expected one rotation"),
        (
            OPENCV | {"world_to_camera": {"translation": [0, 0, 1], "quaternion": [0, 0, 0, 1]}},
            "which of its numbers is w",
        ),
        (
            OPENCV | {"world_to_camera": {"translation": [0, 0, 1], "rotation": [0, 0, 0, 1]}},
            "expected x, y, z, w as fields",
        ),
        (
            OPENCV
            | {"world_to_camera": {"translation": [0, 0, 1], "quaternion_xyzw": [0, 0, 0, 2]}},
            "length 2; expected a unit quaternion",
        ),
        (OPENCV | {"camera_matrix": np.transpose(MATRIX).tolist()}, "transpose it; expected .fx"),
        (OPENCV | {"camera_matrix": [[1, 2], [3, 4]]}, r"shape \(2, 2\); expected \(3, 3\)"),
        (OPENCV | {"camera_matrix": {"rows": 3, "cols": 4, "data": [1] * 9}}, "no matrix"),
        (OPENCV | {"camera_matrix": {"rows": 3, "data": [1] * 9}}, "lacks 'cols'"),
        (OPENCV | {"camera_matrix": np.zeros((3, 3)).tolist()}, "not calibrated"),
        (OPENCV | {"camera_matrix": [[610, 3, 330], *MATRIX[1:]]}, "without skew"),
        (OPENCV | {"camera_matrix": [[np.nan, 0, 330], *MATRIX[1:]]}, "not finite"),
        (OPENCV | {"camera_matrix": [[1220, 0, 661], [0, 1210, 473], [0, 0, 1]]}, "at the rim of"),
        (OPENCV | {"K": MATRIX}, "camera_matrix and K, which mean the same"),
        (OPENCV | {"distortion_coefficients": D5[:3]}, "got 3 distortion .* 5 or 8 or 12 or 14"),
        (OPENCV | {"distortion_coefficients": D5[:4]}, "of a usual lens, or .* fisheye; say"),
        (OPENCV | {"distortion_coefficients": [D5, D5]}, "expected one row"),
        (OPENCV | {"distortion_coefficients": "strong"}, "distortion_coefficients is no matrix"),
        (without(OPENCV, "distortion_coefficients"), "says nothing of distortion"),
        (OPENCV | {"distortion_model": "radtan"}, "unknown distortion_model 'radtan'; have: plu"),
        (OPENCV | {"distortion_model": "equidistant"}, "got 5 .* expected 4 for equidistant"),
        (OPENCV | {"distortion_model": "plumb_bob", "fisheye_model": 1}, "contradicts"),
        (MESSAGE | {"distortion_model": "plumb_bob"}, "got 8 .* expected 4 or 5"),
        (OPENCV | {"image_width": 1280, "image_height": 960}, 'give "image_scale": 0.5'),
        (OPENCV | {"image_width": 1280, "image_height": 720}, "a cropped image"),
        (OPENCV | {"image_scale": 0.5}, "640x480 px times image_scale 0.5, this one has 640x480"),
        (OPENCV | {"image_scale": "half"}, "image_scale is 'half'"),
        (without(OPENCV, "image_width"), "lacks the field 'image_width'"),
        (OPENCV | {"xi": 1.2}, "unknown fields: xi; known ones: camera_matrix"),
        (OPENCV | {"tvec": [0, 0, 1]}, "unknown fields: tvec; .* camera_to_world"),
        (OPENCV | {7: 1.2}, "unknown fields: 7"),
        (OPENCV | {"rectified": "maybe"}, "expected true or false"),
        (MESSAGE | {"binning_x": 2}, "binning_x is 2"),
        (MESSAGE | {"roi": {"x_offset": 5, "width": 320}}, "region of interest"),
        (MESSAGE | {"r": np.eye(3)[[1, 0, 2]].ravel().tolist()}, "stereo pair"),
        (MESSAGE | {"p": [540, 0, 333, -32, 0, 560, 231, 0, 0, 0, 1, 0]}, "second camera of"),
    ],
)
def test_what_cannot_be_read_rightly_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        camera_and_lens(fields, SIZE)


def test_extrinsics_of_their_own_are_checked():
    with pytest.raises(ValueError, match="has world_to_camera already"):
        with_extrinsics(OPENCV, {"camera_to_world": INVERSE.tolist()})
    bare = without(OPENCV, "world_to_camera")
    with pytest.raises(ValueError, match='unknown fields: translation; .* give "camera_to_world"'):
        with_extrinsics(bare, {"translation": [0, 0, 1]})
    with pytest.raises(ValueError, match="expected an object"):
        with_extrinsics([1], {"camera_to_world": INVERSE.tolist()})
    with pytest.raises(ValueError, match="has distortion"):
        camera_from_dict(OPENCV, SIZE)


def test_the_cameras_of_the_documents_are_one_camera(tmp_path):
    blocks = re.findall(r"```(yaml|json)\n(.*?)```", PAGE.read_text(), re.DOTALL)
    read = []
    for index, (kind, text) in enumerate(blocks):
        file = tmp_path / f"{index}.{kind}"
        file.write_text(text)
        read.append(read_fields(file))
    opencv, with_pose, message, pose = read
    expected, _ = camera_and_lens(with_pose, SIZE)
    for fields in (opencv, message):
        camera, lens = camera_and_lens(with_extrinsics(fields, pose), SIZE)
        np.testing.assert_allclose(camera.world_to_cam, expected.world_to_cam, atol=1e-4)
        np.testing.assert_allclose(lens.coefficients, [-0.32, 0.12, 0.0006, -0.0004, -0.015])


@pytest.mark.parametrize("times", [2, 3, 4])
def test_the_matrix_of_a_smaller_image_is_refused(times):
    """Its principal point is in the middle of that image."""
    matrix = np.array(OPENCV["camera_matrix"], float)
    matrix[:2] /= times
    with pytest.raises(ValueError, match=f"in the middle of an image of 1/{times} of"):
        camera_and_lens(OPENCV | {"camera_matrix": matrix.tolist()}, (480, 640))
