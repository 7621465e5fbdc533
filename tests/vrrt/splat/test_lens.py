"""Images lose their distortion as OpenCV's models say; what folds back or is lost is unknown."""

import importlib.util

import numpy as np
import pytest
from photo_cases import clutter, through_lens

from vrrt_jax.splat.lens import Lens

MATRIX = np.array([[210.0, 0.0, 163.0], [0.0, 208.0, 118.0], [0.0, 0.0, 1.0]])
CASES = {
    "barrel": ("rational", [-0.28, 0.09, 0.0007, -0.0004, -0.01]),
    "pincushion": ("rational", [0.25, 0.05, 0.0, 0.0, 0.0]),
    "rational": ("rational", [0.4, -2.5, 0.0006, -0.0003, 1.5, 0.3, -2.3, 1.4]),
    "fisheye": ("fisheye", [0.02, -0.01, 0.004, -0.001]),
}


def lens(kind, **changes):
    model, coefficients = CASES[kind]
    fields = {"model": model, "coefficients": np.array(coefficients), "pinhole": MATRIX}
    return Lens(matrix=MATRIX, **fields | changes)


@pytest.mark.parametrize("kind", CASES)
def test_what_a_lens_has_bent_is_straight_again(kind):
    """Rendered by a pinhole camera, bent, and straightened; a mask goes along."""
    scene = clutter(240, 320)
    disk = np.hypot(*np.mgrid[-120:120, -160:160]) < 70
    pinhole = np.concatenate([scene, disk[..., None].astype(np.float32)], axis=-1)
    straight, known = lens(kind).undistort(through_lens(pinhole, lens(kind)))
    inside = known[8:-8, 8:-8]
    bent = np.abs(through_lens(pinhole, lens(kind)) - pinhole)[8:-8, 8:-8][inside]
    off = np.abs(straight - pinhole)[8:-8, 8:-8][inside]
    assert off[:, :3].mean() < 0.25 * bent[:, :3].mean()
    assert np.mean(off[:, 3] > 0.5) < 1e-3
    assert known.all() == (kind != "pincushion") or known.mean() > 0.7
    assert not straight[~known].any()


def test_another_pinhole_camera_sees_the_same_scene():
    """As ROS's projection matrix asks for: zoomed out, the rim is unknown."""
    small = MATRIX * [[0.7, 1, 1], [1, 0.7, 1], [1, 1, 1]]
    straight, known = lens("barrel", pinhole=small).undistort(clutter(240, 320))
    assert 0.3 < known.mean() < 0.99 and known[100:140, 140:180].all()
    assert not straight[~known].any()


def test_coefficients_that_fold_the_image_are_refused():
    folding = lens("barrel", coefficients=np.array([-3.0, 0.5, 0, 0, 0]))
    with pytest.raises(ValueError, match="check that they belong to this camera"):
        folding.undistort(clutter(240, 320))


def test_without_opencv_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vrrt-jax\[photo\]'"):
        lens("barrel").undistort(clutter(24, 32))
