"""MuJoCo's images: what is refused."""

import pytest

from vrrt_jax.splat.camera import orbit
from vrrt_jax.splat.mujoco_images import MeshRenderer


def test_too_large_an_image_is_refused(arm):
    robot, spec = arm
    camera = orbit(azimuth_deg=0, elevation_deg=-20, distance=2.0, height=600, width=1100)
    with pytest.raises(ValueError, match="1100x600 px is too large .* at most 1024"):
        MeshRenderer(spec).picture(robot.lower, camera)
