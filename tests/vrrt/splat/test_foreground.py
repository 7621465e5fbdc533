"""The robot told from a picture without it, and from a box, before a cluttered background."""

import numpy as np
import pytest
from photo_cases import before, clutter, overlap, taken, thing

import vrrt_jax


@pytest.fixture(scope="module")
def shot():
    """A thing before clutter; and the clutter."""
    return thing(240, 320), clutter(240, 320)


@pytest.mark.parametrize(
    ("how", "least"),
    [
        ({}, 0.97),
        ({"exposure": 0.6, "noise": 0.02, "jpeg": 80}, 0.93),
        ({"exposure": 1.4, "noise": 0.02, "jpeg": 60}, 0.93),
        ({"noise": 0.05}, 0.9),
    ],
)
def test_robots_before_their_background(shot, how, least):
    picture, clutter_ = shot
    image = taken(before(picture, clutter_), seed=1, **how)
    background = taken(clutter_, seed=2, **{k: v for k, v in how.items() if k != "exposure"})
    mask = vrrt_jax.robot_before_background(image, background)
    assert overlap(mask, picture.alpha) > least
    assert set(np.unique(mask)) == {0.0, 1.0}


def test_white_balance_may_change_too(shot):
    picture, clutter_ = shot
    warm = before(picture, clutter_) * np.array([1.15, 1.0, 0.8])
    mask = vrrt_jax.robot_before_background(taken(warm), taken(clutter_))
    assert overlap(mask, picture.alpha) > 0.95


def test_backgrounds_that_do_not_fit_are_refused(shot):
    picture, clutter_ = shot
    image = taken(before(picture, clutter_))
    for background, message in (
        (taken(clutter_)[:120], "the background is 320x120 px, the goal image 320x240"),
        (image, "hardly differs from its background"),
        (taken(clutter(240, 320, seed=5)), "differ from the background, by a noise"),
        (taken(1 - clutter_), "differ from the background"),
        (np.full((240, 320, 3), np.nan), "the background has .* NaN"),
    ):
        with pytest.raises(ValueError, match=message):
            vrrt_jax.robot_before_background(image, background)


@pytest.mark.parametrize("jpeg", [None, 80])
def test_robots_in_a_box(shot, jpeg):
    picture, clutter_ = shot
    image = taken(before(picture, clutter_), noise=0.01, jpeg=jpeg)
    mask = vrrt_jax.robot_in_box(image, (105, 20, 260, 240))
    assert overlap(mask, picture.alpha) > 0.93
    np.testing.assert_array_equal(mask, vrrt_jax.robot_in_box(image, (105, 20, 260, 240)))
    assert not mask[:, :100].any()


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((400, 20, 500, 100), "not inside the image of 320x240 px"),
        ((100, 20, 90, 100), "with x0 < x1"),
        ((-5, 20, 90, 100), "not inside the image"),
        ((0, 0, 320, 240), "holds all of the image"),
        ((0.1, 0.1, 0.5), "expected four numbers"),
        ((0, 0, np.nan, 5), "expected four numbers"),
        ("box", "expected four numbers"),
    ],
)
def test_boxes_that_are_none_are_refused(shot, box, message):
    with pytest.raises(ValueError, match=message):
        vrrt_jax.robot_in_box(taken(shot[1]), box)
