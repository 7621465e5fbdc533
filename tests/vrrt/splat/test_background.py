"""A robot on a plain background of any color, from files with and without loss."""

import io

import numpy as np
import pytest
from PIL import Image

import vrrt_jax
from vrrt_jax.splat.background import robot_on_plain_background

COLORS = {
    "black": (0, 0, 0),
    "white": (1, 1, 1),
    "grey": (0.45, 0.45, 0.45),
    "robot": (0.78, 0.78, 0.78),  # the color of much of the robot
    "green": (0, 0.8, 0),
    "blue": (0.1, 0.2, 1),
    "cream": (0.95, 0.9, 0.75),
}


@pytest.fixture(scope="module")
def goal():
    return vrrt_jax.load_problem("panda_posts", engine="closed_form").goal_images[0]


def on_color(goal, color):
    rgb, alpha = goal[..., :3], goal[..., 3:]
    return np.round(255 * (rgb * alpha + np.asarray(color) * (1 - alpha))).astype(np.uint8)


def as_jpeg(pixels, quality):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))


def share_wrong(goal, pixels):
    """Pixels that are wrongly robot, or wrongly not, in units of the robot's own."""
    _, alpha = robot_on_plain_background(pixels.astype(np.float32) / 255)
    true = goal[..., 3]
    return ((alpha * (true == 0)).sum() + ((1 - alpha) * (true == 1)).sum()) / true.sum()


@pytest.mark.parametrize("name", COLORS)
def test_the_robot_is_told_from_any_color(goal, name):
    pixels = on_color(goal, COLORS[name])
    assert share_wrong(goal, pixels) < 0.002
    assert share_wrong(goal, as_jpeg(pixels, 95)) < 0.015
    assert share_wrong(goal, as_jpeg(pixels, 75)) < 0.05


@pytest.mark.parametrize("color", ["green", "blue", (0.8, 0.2, 0.6)])
def test_what_shows_between_links_stays_background(color):
    # A ring of two grays, whose color bleeds into all of its hole.
    y, x = np.mgrid[:160, :160] - 80.0
    radius = np.hypot(x, y)
    ring = (radius > 12) & (radius < 40)
    image = np.broadcast_to(np.asarray(COLORS.get(color, color), np.float32), (160, 160, 3)).copy()
    image[ring] = np.where(x > 0, 0.9, 0.2)[ring][:, None]
    pixels = np.round(255 * image).astype(np.uint8)
    for quality in (90, 60):
        _, alpha = robot_on_plain_background(as_jpeg(pixels, quality).astype(np.float32) / 255)
        assert alpha[radius < 10].mean() < 0.02
        assert np.abs(alpha - ring).mean() < 0.03 * ring.mean()


@pytest.mark.parametrize("color", [(0.05, 0.2, 0.05), (0.05, 0.05, 0.2), (0.25, 0.18, 0.1)])
def test_dark_colors_do_not_bleed_either(goal, color):
    pixels = on_color(goal, color)
    assert share_wrong(goal, pixels) < 0.002
    for quality in (95, 75, 50):
        assert share_wrong(goal, as_jpeg(pixels, quality)) < 0.06


def test_noise_and_slow_shading_are_background(goal, rng):
    pixels = on_color(goal, COLORS["black"]) + rng.normal(scale=3, size=(*goal.shape[:2], 3))
    assert share_wrong(goal, np.clip(pixels, 0, 255)) < 0.01
    shading = np.linspace(-6, 6, goal.shape[1])[:, None]
    pixels = on_color(goal, COLORS["green"]) + shading * (goal[..., 3:] == 0)
    assert share_wrong(goal, np.clip(pixels, 0, 255)) < 0.01


def test_colors_do_not_bleed(goal):
    """At the outline of a JPEG, the robot has its own color and not the background's."""
    pixels = as_jpeg(on_color(goal, COLORS["green"]), 75).astype(np.float32) / 255
    rgb, alpha = robot_on_plain_background(pixels)
    greenish = (rgb[..., 1] - rgb[..., [0, 2]].max(axis=-1))[alpha > 0]
    before = (pixels[..., 1] - pixels[..., [0, 2]].max(axis=-1))[alpha > 0]
    assert np.mean(greenish > 0.1) < 0.3 * np.mean(before > 0.1)


def test_other_backgrounds_are_refused(goal, rng):
    y, x = np.mgrid[: goal.shape[0], : goal.shape[1]] / goal.shape[0]
    ramp = np.repeat(x[..., None], 3, axis=2)
    halves = np.where(y[..., None] < 0.5, 0.2, np.full(3, 0.8))
    for background in (ramp, halves, rng.random((*x.shape, 3))):
        with pytest.raises(ValueError, match=r"expected a plain background: .* fourth channel"):
            robot_on_plain_background(np.where(goal[..., 3:] > 0, goal[..., :3], background))
    off = np.hypot(x - 0.5, y - 0.5)[..., None]
    vignette, shadow = 0.5 - 0.1 * off**2, 1 - 0.3 * np.exp(-40 * off**2)
    for background in (vignette, shadow):
        for quality in (None, 90):
            pixels = on_color(goal, background)
            pixels = pixels if quality is None else as_jpeg(pixels, quality)
            with pytest.raises(ValueError, match="not plain: .* shading or a shadow; .* fourth"):
                robot_on_plain_background(pixels.astype(np.float32) / 255)
    with pytest.raises(ValueError, match="is blank"):
        robot_on_plain_background(np.full((60, 80, 3), 0.3))
