"""Arrays of pixels and masks: every type is brought to one form, or refused."""

import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.splat.images import check_views, prepare_goal
from vrrt_jax.splat.pixels import unit_pixels, valid_mask


@pytest.fixture
def camera():
    return vrrt_jax.look_at((2, 0, 1), (0, 0, 0.3), height=60, width=80)


@pytest.fixture
def image():
    image = np.zeros((60, 80, 4), np.float32)
    image[20:40, 30:50] = (0.8, 0.4, 0.2, 1.0)
    return image


def test_types_of_pixels(image):
    for dtype in (np.uint8, np.uint16):
        scaled = np.round(image * np.iinfo(dtype).max).astype(dtype)
        np.testing.assert_allclose(unit_pixels(scaled), image, atol=3e-3)
        scaled[..., 3] = image[..., 3]  # a mask of 0 and 1
        np.testing.assert_allclose(unit_pixels(scaled), image, atol=3e-3)
    for dtype in (np.float16, np.float64):
        np.testing.assert_allclose(unit_pixels(image.astype(dtype)), image, atol=1e-3)
    white = np.repeat(image[..., 3:], 3, axis=2)
    for grey in (image[..., 3], image[..., 3:], image[..., 3] > 0, image[..., 3:] > 0):
        np.testing.assert_array_equal(unit_pixels(grey), white)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda image: (255 * image).astype(np.int64), "type int64; expected uint8, uint16"),
        (lambda image: 255 * image, "from 0 to 255; .* divide by 255"),
        (lambda image: 1.5 * image, "from 0 to 1.5; .* high dynamic range"),
        (lambda image: image - 0.5, "from -0.5"),
        (lambda image: (255 * image).astype(np.uint16), "largest value is 204 of 65535"),
        (lambda image: np.ceil(image).astype(np.uint8), "nearly black: its largest value"),
        (lambda image: image / 255, "nearly black"),
        (lambda image: image * [1, 1, 1, 1 / 255], "goes up to 0.00392 of 1"),
        (lambda image: image * [1, 1, 1, 0], "is empty"),
        (lambda image: (1 - 0.2 * image) * [1, 1, 1, 0] + [0, 0, 0, 0.98], "98 % of the image"),
        (lambda image: image * [1, 1, 1, -1] + [0, 0, 0, 1], "is it inverted"),
        (lambda image: np.full((60, 80, 4), np.inf), "infinite"),
    ],
)
def test_images_of_another_range_are_refused(camera, image, change, message):
    with pytest.raises(ValueError, match=message):
        prepare_goal([change(image)], [camera], 60)


def test_tiny_images_are_refused():
    camera = vrrt_jax.look_at((2, 0, 1), (0, 0, 0.3), height=1, width=1)
    with pytest.raises(ValueError, match="1x1 px; expected at least"):
        prepare_goal([np.ones((1, 1, 3))], [camera], 60)


def test_types_of_masks(image):
    truths = np.arange(80) < 50
    truths = np.broadcast_to(truths, (60, 80))
    for mask in (
        truths,
        truths[..., None],
        np.repeat(truths[..., None], 3, axis=2),  # as read_image reads it
        truths.astype(np.uint8),
        truths.astype(float),
        truths * 255,
        truths * 250.0 + 3.0,  # of a JPEG
        truths * np.uint16(65535),
    ):
        np.testing.assert_array_equal(valid_mask(mask, 60, 80), truths)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.ones((80, 60)), "turned by a quarter"),
        (np.arange(60 * 80 * 3).reshape(60, 80, 3) % 2, r"shape \(60, 80, 3\)"),
        (np.ones((30, 40)), r"shape \(30, 40\); expected \(60, 80\)"),
        (np.full((60, 80), 7), "values from 7 to 7"),
        (np.full((60, 80), np.nan), "values from nan"),
        (-np.ones((60, 80)), "values from -1"),
        (np.zeros((60, 80)), "hides every pixel"),
    ],
)
def test_bad_masks_are_explained(camera, image, mask, message):
    with pytest.raises(ValueError, match=message):
        check_views([image], [camera], [mask])


def test_inverted_masks_are_refused(camera, image):
    occluder = np.zeros((60, 80), bool)
    occluder[:, 48:60] = True
    check_views([image], [camera], [~occluder])
    with pytest.raises(ValueError, match="leave only 5.0 % of the robot; .* inverted"):
        check_views([image], [camera], [np.arange(80) + np.zeros((60, 1)) >= 49])
    with pytest.raises(ValueError, match="leave nothing of the robot; .* inverted"):
        check_views([image * ~occluder[..., None]], [camera], [occluder])
    with pytest.raises(ValueError, match="nothing but the robot"):
        check_views([image], [camera], [image[..., 3]])
    # A view that shows nothing is no fault if another one does.
    check_views([image, image], [camera, camera], [~occluder, image[..., 3] == 0])
