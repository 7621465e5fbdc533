"""MuJoCo's images: what is refused, and drawing in several threads."""

import gc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from vrrt_jax.splat.camera import orbit
from vrrt_jax.splat.mujoco_images import MeshRenderer


def test_too_large_an_image_is_refused(arm):
    robot, spec = arm
    camera = orbit(azimuth_deg=0, elevation_deg=-20, distance=2.0, height=600, width=1100)
    with pytest.raises(ValueError, match="1100x600 px is too large .* at most 1024"):
        MeshRenderer(spec).picture(robot.lower, camera)


def test_threads_draw_with_one_renderer(arm, rng):
    """OpenGL is bound to threads: each has its own, which is closed there, whoever drops it."""
    robot, spec = arm
    camera = orbit(azimuth_deg=0, elevation_deg=-20, distance=2.0, height=48, width=48)
    poses = rng.uniform(robot.lower, robot.upper, (12, robot.num_joints))

    def drawn(renderer, apply=map):
        return list(apply(lambda q: renderer.picture(q, camera).rgb, poses))

    here = MeshRenderer(spec)
    expected = drawn(here)
    assert len({image.tobytes() for image in expected}) > 6
    with ThreadPoolExecutor(3) as pool:
        for _ in range(2):
            np.testing.assert_array_equal(drawn(MeshRenderer(spec), pool.map), expected)
            gc.collect()
    np.testing.assert_array_equal(drawn(here), expected)
