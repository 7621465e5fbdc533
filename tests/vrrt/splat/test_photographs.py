"""Pictures as cameras take them: what each setting does to them, and what is refused."""

import numpy as np
import pytest

from vrrt_jax.splat.mujoco_images import Picture
from vrrt_jax.splat.photographs import Photograph, photograph


@pytest.fixture
def picture():
    """A grey square with a soft edge, darker to the left."""
    alpha = np.zeros((64, 64), np.float32)
    alpha[15:49, 15:49], alpha[16:48, 16:48] = 0.5, 1.0
    shade = np.linspace(0.55, 0.75, 64, dtype=np.float32)[None, :, None] * [1.0, 0.9, 1.0]
    rgb = (alpha[..., None] * shade).astype(np.float32)
    return Picture(rgb=rgb, alpha=alpha, valid=alpha >= 0)


def test_a_picture_as_it_is(picture, rng):
    rgb, alpha = photograph(picture, Photograph(), rng)
    np.testing.assert_array_equal(rgb, picture.rgb)
    np.testing.assert_array_equal(alpha, picture.alpha)


def test_light_goes_up_to_white(picture, rng):
    half, _ = photograph(picture, Photograph(brightness=0.5), rng)
    np.testing.assert_allclose(half, 0.5 * picture.rgb)
    twice, alpha = photograph(picture, Photograph(brightness=2.0), rng)
    np.testing.assert_array_equal(twice[20:40, 20:40], 1.0)
    assert np.all(twice <= alpha[..., None])


@pytest.mark.parametrize("mask", ["true", "estimated"])
def test_noise_and_jpeg_are_as_large_as_told(picture, rng, mask):
    how = Photograph(noise=0.02, mask=mask)
    noisy, alpha = photograph(picture, how, rng)
    inside = np.s_[20:44, 20:44]
    assert np.std((noisy - picture.rgb)[inside]) == pytest.approx(0.02, rel=0.1)
    squeezed, _ = photograph(picture, Photograph(jpeg=60, mask=mask), rng)
    assert 1e-3 < np.std((squeezed - picture.rgb)[inside]) < 0.03
    assert np.mean(np.abs(alpha - picture.alpha)) < 0.04


def test_what_is_no_photograph_is_refused():
    with pytest.raises(ValueError, match="unknown mask 'none'; have: true, estimated"):
        Photograph(mask="none")
    with pytest.raises(ValueError, match="JPEG quality is 0; expected 1 to 95"):
        Photograph(jpeg=0)
