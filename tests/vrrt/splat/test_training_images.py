"""Images that self-models are trained with."""

import numpy as np

from vrrt_jax.splat.fit_config import FitConfig, LevelConfig
from vrrt_jax.splat.training_images import outermost, render_images

CONFIG = FitConfig(
    image_px=64,
    close_up=LevelConfig(num_splats=70, size_px=32, steps=1, batch=1),
    close_up_of_px=128,
)


def test_close_ups_show_the_outermost_link(arm):
    robot, spec = arm
    _, points = render_images(robot, spec, CONFIG, 20, 0, 20)
    link, middle = tip = outermost(points)
    assert link == 2
    np.testing.assert_allclose(middle, [0, 0, 0.05], atol=0.02)
    images, _ = render_images(robot, spec, CONFIG, 20, 1, tip=tip)
    assert images.rgb.shape == (20, 32, 32, 3)
    red = (images.rgb[..., 0] > 1.5 * images.rgb[..., 2]).mean(axis=(1, 2))
    assert np.mean(red > 0.03) > 0.7  # the hand, but where the arm hides it
