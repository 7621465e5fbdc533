"""Cameras from Python and from files: what is given is used, or refused by name."""

import json
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.core.data_file import read_json
from vrrt_jax.splat.camera import project, shrunk, squared
from vrrt_jax.splat.camera_fields import camera_from_dict
from vrrt_jax.splat.images import prepare_goal

SIZE = (480, 640)
PLACED = {"position": [1.5, 0.4, 0.9], "target": [0, 0, 0.4], "fovy_deg": 45}
CAMERA = vrrt_jax.look_at((1.5, 0.4, 0.9), (0, 0, 0.4), height=480, width=640)
MATRIX = np.asarray(CAMERA.world_to_cam, float)
CALIBRATED = {"world_to_cam": MATRIX.tolist(), "focal": float(CAMERA.focal)}
POINT = jnp.array([0.1, 0.2, 0.5])


def changed(row, column, value):
    matrix = MATRIX.copy()
    matrix[row, column] = value
    return matrix.tolist()


def test_both_kinds_of_files_are_the_same_camera():
    sized = {"width": 640, "height": 480}
    for fields in (PLACED, CALIBRATED, PLACED | sized, CALIBRATED | sized):
        pixel, _ = project(camera_from_dict(fields, SIZE), POINT)
        np.testing.assert_allclose(pixel, project(CAMERA, POINT)[0], atol=1e-2)
    moved = camera_from_dict(CALIBRATED | {"centre": [350.5, 231.0]}, SIZE)
    np.testing.assert_allclose(
        project(moved, POINT)[0] - project(CAMERA, POINT)[0], [30.5, -9.0], atol=1e-3
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (CALIBRATED | {"cx": 350.2, "cy": 231.7}, 'unknown fields: cx, cy; .* "centre"'),
        (CALIBRATED | {"principal_point": [1, 2]}, 'principal_point; .* "centre"'),
        (CALIBRATED | {"K": np.eye(3).tolist()}, "fields: focal; .* in camera_matrix"),
        (CALIBRATED | {"intrinsics": [5, 5]}, 'fields: intrinsics; .* "camera_matrix"'),
        (CALIBRATED | {"distortion": [0.1, 0]}, "fields: distortion; .* undistort"),
        (CALIBRATED | {"D": [0.1, 0]}, "fields: D; .* undistort"),
        ({"world_to_cam": MATRIX.tolist(), "fx": 5, "fy": 5}, 'fields: fx, fy; .* "focal"'),
        (PLACED | {"fovx_deg": 60}, 'fields: fovx_deg; .* "fovy_deg"'),
        (PLACED | {"Position": [0, 0, 0]}, "fields: Position"),
        (CALIBRATED | {"width": 1280, "height": 960}, "width is 1280 px, but .* image is 640"),
        (PLACED | {"height": 640, "width": 480}, "width is 480 px"),
        (CALIBRATED | {"fovy_deg": 45}, "has fovy_deg beside world_to_cam, focal"),
        (PLACED | CALIBRATED, "not both"),
        (CALIBRATED | {"camera_to_world": MATRIX.tolist()}, "camera_to_world and world_to_cam;"),
        ({"position": [1, 1, 1]}, "lacks the field 'target', 'fovy_deg'"),
        ({"centre": [320, 240]}, "lacks the field 'focal'"),
        ({"focal": 500}, "has no extrinsics; say where the camera is"),
        ([1, 2], "the camera is a list; expected an object"),
        (CALIBRATED | {"world_to_cam": MATRIX.T.tolist()}, "0 0 0 1: transpose the matrix"),
        (CALIBRATED | {"world_to_cam": changed(3, 3, 2.0)}, "last row is .* expected 0 0 0 1"),
        (CALIBRATED | {"world_to_cam": changed(0, 3, np.nan)}, "not a rigid"),
        (CALIBRATED | {"world_to_cam": changed(0, 0, 2.0)}, "not a rigid"),
        (CALIBRATED | {"world_to_cam": (-MATRIX).tolist()}, "not a rigid"),
        (CALIBRATED | {"world_to_cam": changed(2, 3, 1500.0)}, "not in mm"),
        (CALIBRATED | {"world_to_cam": MATRIX[:3].tolist()}, r"shape \(3, 4\)"),
        (CALIBRATED | {"world_to_cam": MATRIX.ravel().tolist()}, r"shape \(16,\)"),
        (CALIBRATED | {"world_to_cam": [[1], [1, 2]]}, "not made of numbers"),
        (CALIBRATED | {"world_to_cam": (MATRIX + 0.01).tolist()}, "not a rigid"),
        (CALIBRATED | {"focal": 0}, "focal is 0"),
        (CALIBRATED | {"focal": np.inf}, "focal is"),
        (CALIBRATED | {"focal": [580, 580, 1]}, "focal is .*; expected 2 finite numbers"),
        (CALIBRATED | {"focal": [580, 1300]}, "about the same"),
        (CALIBRATED | {"focal": 35}, "in pixels, not in mm"),
        (CALIBRATED | {"focal": None}, "focal is"),
        (CALIBRATED | {"centre": [320]}, "centre is .*; expected 2 finite numbers"),
        (CALIBRATED | {"centre": [np.nan, 240]}, "centre is .*; expected 2 finite numbers"),
        (CALIBRATED | {"centre": [0.5, 0.5]}, "expected pixels"),
        (CALIBRATED | {"centre": 320}, "centre is 320"),
        (PLACED | {"position": [np.nan, 0, 1]}, "position is .*; expected 3 finite numbers"),
        (PLACED | {"position": [1.5, 0.4]}, "position is .*; expected 3 finite numbers"),
        (PLACED | {"position": [1500, 400, 900]}, "not in mm"),
        (PLACED | {"target": [[0, 0, 0]]}, "target is .*; expected 3 finite numbers"),
        (PLACED | {"up": [1]}, "up is .*; expected 3 finite numbers"),
        (PLACED | {"up": [0, 0, 0]}, "parallel to up"),
        (PLACED | {"fovy_deg": 0.785}, "in degrees"),
        (PLACED | {"fovy_deg": 200}, "in degrees"),
        (PLACED | {"fovy_deg": "wide"}, "fovy_deg is"),
        (PLACED | {"target": PLACED["position"]}, "view direction is zero"),
    ],
)
def test_bad_files_are_explained(fields, message):
    with pytest.raises(ValueError, match=message):
        camera_from_dict(fields, SIZE)


def test_matrices_of_few_decimals_are_rotations(rng):
    for matrix in (look_from(rng.normal(size=3)) for _ in range(30)):
        camera = camera_from_dict(CALIBRATED | {"world_to_cam": matrix.round(3).tolist()}, SIZE)
        read = np.asarray(camera.world_to_cam, float)
        np.testing.assert_allclose(read, matrix, atol=2e-3)
        np.testing.assert_allclose(read[:3, :3] @ read[:3, :3].T, np.eye(3), atol=1e-6)


def look_from(place):
    return np.asarray(vrrt_jax.look_at(place + [0, 0, 3], (0, 0, 0)).world_to_cam, float)


@pytest.mark.parametrize("centre", [[640, 480], [20, 240], [320, -100]])
def test_a_principal_point_far_off_is_told(centre):
    with pytest.warns(UserWarning, match="centre. is .* far from the middle of an image"):
        camera_from_dict(CALIBRATED | {"centre": centre}, SIZE)
    with warnings.catch_warnings(action="error"):
        camera_from_dict(CALIBRATED | {"centre": [350, 200]}, SIZE)


def test_constructors_refuse_the_same():
    for pair in ((0, 480), (640, 0.5), (np.nan, 480), (640.5, 480)):
        with pytest.raises(ValueError, match="(width|height) is"):
            vrrt_jax.camera_from_matrix(MATRIX, focal=580, width=pair[0], height=pair[1])
    with pytest.raises(ValueError, match="transpose the matrix"):
        vrrt_jax.camera_from_matrix(MATRIX.T, focal=580, width=640, height=480)
    view = {"azimuth_deg": 0.0, "elevation_deg": -30.0, "distance": 2.0}
    for name, value in (("distance", -2.0), ("azimuth_deg", np.nan), ("elevation_deg", [1, 2])):
        with pytest.raises(ValueError, match=f"{name} is"):
            vrrt_jax.orbit(**view | {name: value})
    with pytest.raises(ValueError, match="expected 3 finite numbers"):
        vrrt_jax.orbit(**view, target=(0, 0))


def test_files_of_other_editors(tmp_path):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(PLACED), encoding="utf-8-sig")
    assert read_json(file) == PLACED
    file.write_text("[" * 100_000)
    with pytest.raises(ValueError, match="not valid JSON"):
        read_json(file)


def test_a_field_that_is_there_twice_is_refused(tmp_path):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(PLACED)[:-1] + ', "fovy_deg": 30}')
    with pytest.raises(ValueError, match="the field 'fovy_deg' is there twice"):
        read_json(file)


@pytest.mark.parametrize("aspect", [0.9, 1.1, 1.003])
def test_two_focal_lengths(aspect):
    """Points are where fx, fy put them, and the picture is resized to square pixels."""
    fy, centre = 400.0, np.array([170.0, 110.0])
    camera = vrrt_jax.camera_from_matrix(
        MATRIX, focal=(aspect * fy, fy), height=240, width=320, principal_point=centre
    )
    x, y, z = (MATRIX @ [*np.asarray(POINT), 1.0])[:3]
    pixel, _ = project(camera, POINT)
    np.testing.assert_allclose(pixel, [aspect * fy * x / z + 170, fy * y / z + 110], rtol=1e-5)
    # A disk around the point, in the picture, stays around the point.
    rows, columns = np.mgrid[:240, :320] + 0.5
    near = ((columns - float(pixel[0])) / aspect) ** 2 + (rows - float(pixel[1])) ** 2 < 30**2
    image = np.repeat(near[..., None], 4, axis=2).astype(np.float32)
    goal, cameras = prepare_goal([image], [camera], 80, [np.ones_like(near)])
    small = shrunk(squared(camera), 3)
    assert cameras.aspect == 1 and goal.alpha.shape[1:] == (small.height, small.width)
    alpha = np.asarray(goal.alpha[0])
    rows, columns = np.mgrid[: alpha.shape[0], : alpha.shape[1]] + 0.5
    middle = [(alpha * columns).sum() / alpha.sum(), (alpha * rows).sum() / alpha.sum()]
    np.testing.assert_allclose(middle, project(small, POINT)[0], atol=0.1)
    spread = [
        np.sqrt((alpha * (a - m) ** 2).sum() / alpha.sum())
        for a, m in zip((columns, rows), middle, strict=True)
    ]
    np.testing.assert_allclose(spread, 5.0, rtol=0.02)  # a disk's, of radius 10
