import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import vrrt_jax
from vrrt_jax.splat.camera import project, shrunk
from vrrt_jax.splat.images import (
    OUTLINE_PX,
    check_views,
    cut_goal,
    mask_loss,
    outline_error_px,
    prepare_goal,
    shrink_views,
)


@pytest.fixture
def camera():
    return vrrt_jax.look_at((2, 0, 1), (0, 0, 0.3), height=60, width=80)


@pytest.fixture
def image():
    image = np.zeros((60, 80, 4), np.float32)
    image[20:40, 30:50] = (0.8, 0.4, 0.2, 1.0)
    return image


def test_goal_is_shrunk_by_area_with_its_camera(camera, image):
    goal, cameras = prepare_goal([image], [camera], 20)
    assert goal.rgb.shape == (1, 20, 27, 3), "80 / 3 rounds up"
    assert float(goal.alpha.sum()) == pytest.approx(400 / 9, rel=1e-5)
    assert np.all(goal.valid[0, :, :26] == 1) and np.all(goal.valid[0, :, 26] == 0)
    point = jnp.array([0.1, 0.2, 0.5])
    (pixel, depth), (small, depth_small) = project(camera, point), project(shrunk(camera, 3), point)
    np.testing.assert_allclose(small, pixel / 3, rtol=1e-5)
    assert float(depth) == pytest.approx(float(depth_small))
    assert cameras.focal.shape == (1,)


def test_plain_background_becomes_a_mask(camera, image):
    flat = image[..., :3] * image[..., 3:] + 0.5 * (1 - image[..., 3:])
    goal, _ = prepare_goal([np.round(255 * flat).astype(np.uint8)], [camera], 60)
    np.testing.assert_allclose(goal.alpha[0], image[..., 3])
    np.testing.assert_allclose(goal.rgb[0], image[..., :3], atol=3e-3)


def test_an_opaque_fourth_channel_is_no_mask(camera, image):
    flat = image[..., :3] * image[..., 3:] + 0.5 * (1 - image[..., 3:])
    opaque = np.concatenate([flat, np.ones((60, 80, 1))], axis=-1)
    goal, _ = prepare_goal([opaque], [camera], 60)
    np.testing.assert_allclose(goal.alpha[0], image[..., 3])


def test_a_mask_of_bytes_is_one_of_truths(camera, image):
    mask = np.full((60, 80), 255, np.uint8)
    mask[:, 40:] = 0
    goal, _ = prepare_goal([image], [camera], 30, [mask])
    assert np.unique(goal.valid).tolist() == [0.0, 1.0]


def test_masked_pixels_do_not_count(camera, image):
    mask = np.ones((60, 80), bool)
    mask[:, 40:] = False
    goal, _ = prepare_goal([image], [camera], 60, [mask])
    assert float(goal.valid.sum()) == 60 * 40


def test_scattered_holes_leave_the_rest(camera, image, rng):
    mask = rng.random(image.shape[:2]) < 0.85
    holed = np.where(mask[..., None], image, 1.0)  # what is in the holes is unknown
    whole, _ = prepare_goal([image], [camera], 15)
    goal, _ = prepare_goal([holed], [camera], 15, [mask])
    kept = np.asarray(goal.valid[0]) > 0
    assert kept.mean() > 0.8 and float(goal.valid[0][kept].min()) >= 0.75
    inside = kept & (np.asarray(whole.alpha[0]) == 1.0)
    np.testing.assert_allclose(goal.alpha[0][inside], 1.0, atol=1e-6)
    np.testing.assert_allclose(goal.rgb[0][inside], whole.rgb[0][inside], atol=0.05)


def test_one_mask_for_two_views_is_refused(camera, image):
    mask = np.ones((60, 80), bool)
    goal, _ = prepare_goal(np.stack([image, image]), [camera, camera], 60)
    assert goal.rgb.shape[0] == 2
    with pytest.raises(ValueError, match="got 1 masks for 2 goal images"):
        prepare_goal([image, image], [camera, camera], 60, [mask])


def test_image_files_come_back(tmp_path, image):
    vrrt_jax.write_image(tmp_path / "a.png", image[..., :3] * image[..., 3:], image[..., 3])
    np.testing.assert_allclose(vrrt_jax.read_image(tmp_path / "a.png"), image, atol=3e-3)
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "b.png")
    assert vrrt_jax.read_image(tmp_path / "b.png").shape == (4, 4, 3)


def broken(image, what):
    image = image.copy()
    if what == "size":
        return image[:, :70]
    if what == "channels":
        return image[..., :2]
    if what == "first":
        return np.moveaxis(image, -1, 0)
    if what == "empty":
        return image[:0]
    if what == "nan":
        image[3, 3, 1] = np.nan
    if what == "range":
        image[..., :3] *= 255
    if what == "mask":
        image[..., 3] = 0
    if what == "cluttered":
        return np.random.default_rng(0).random((60, 80, 3))
    if what == "blank":
        return np.full((60, 80, 3), 0.7)
    return image


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("size", r"70x60 px but its camera makes 80x60 px"),
        ("channels", r"shape \(60, 80, 2\); expected \(height, width, 3\)"),
        ("first", r"shape \(4, 60, 80\).*np.moveaxis\(image, 0, -1\)"),
        ("empty", "is empty"),
        ("nan", "1 values that are NaN"),
        ("range", r"expected floats in \[0, 1\]"),
        ("mask", "mask .* is empty"),
        ("blank", "is blank"),
        ("cluttered", "100 % of the goal image differ .* expected a plain background"),
    ],
)
def test_bad_images_are_explained(camera, image, what, message):
    with pytest.raises(ValueError, match=message):
        prepare_goal([broken(image, what)], [camera], 60)


def test_bad_files_are_explained(tmp_path, image):
    with pytest.raises(FileNotFoundError, match="no picture: cannot read"):
        vrrt_jax.read_image(tmp_path / "none.png")
    vrrt_jax.write_image(tmp_path / "a.png", image[..., :3], image[..., 3])
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="not a readable picture"):
        vrrt_jax.read_image(tmp_path / "cut.png")


def test_orbit_looks_from_where_it_says():
    camera = vrrt_jax.orbit(azimuth_deg=90, elevation_deg=-30, distance=2.0, target=(0, 0, 0.4))
    eye = -camera.world_to_cam[:3, :3].T @ camera.world_to_cam[:3, 3]
    np.testing.assert_allclose(eye, [0, -2 * np.cos(np.pi / 6), 0.4 + 1.0], atol=1e-5)
    pixel, depth = project(camera, jnp.array([0.0, 0.0, 0.4]))
    np.testing.assert_allclose(pixel, [240, 240], atol=1e-3)
    assert float(depth) == pytest.approx(2.0, abs=1e-5)
    above, _ = project(camera, jnp.array([0.0, 0.0, 0.9]))
    right, _ = project(camera, jnp.array([0.5, 0.0, 0.4]))
    assert above[1] < 240 and right[0] > 240


def test_a_part_of_a_goal_is_what_its_camera_sees(camera, image):
    image[20:40, 30] = (0.2, 0.2, 0.9, 1.0)
    goal, cameras = prepare_goal([image, image[:, ::-1]], [camera, camera], 60)
    part, of_part = cut_goal(goal, cameras, np.array([[33.0, 30.0], [79.0, 2.0]]), 24)
    assert part.rgb.shape == (2, 24, 24, 3) and (of_part.height, of_part.width) == (24, 24)
    np.testing.assert_array_equal(part.rgb[0], goal.rgb[0, 18:42, 21:45])
    np.testing.assert_array_equal(part.alpha[1], goal.alpha[1, :24, 56:])  # moved inwards
    point = jnp.array([0.1, 0.2, 0.5])
    first = jax.tree.map(lambda leaf: leaf[0], of_part)
    np.testing.assert_allclose(
        project(first, point)[0], project(camera, point)[0] - jnp.array([21, 18]), rtol=1e-5
    )
    whole, _ = cut_goal(goal, cameras, np.array([[0.0, 0.0], [0.0, 0.0]]), 500)
    assert whole.alpha.shape == (2, 60, 80)


def test_levels_serve_about_their_size(panda):
    model = vrrt_jax.load_self_model(vrrt_jax.problems.self_model_path(panda))
    sizes = [level.size_px for level in model.levels]
    assert [model.level_for(size).size_px for size in sizes] == sizes
    assert [model.level_for(size + size // 16).size_px for size in sizes] == sizes  # as of 720 px
    assert model.level_for(sizes[0] + sizes[0] // 4).size_px == sizes[1]


def test_a_folder_of_the_same_name_does_not_hide_a_problem(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "panda_posts").mkdir()
    assert vrrt_jax.load_problem("panda_posts").robot.name == "panda"


def disc(radius, size):
    """A soft disc (size, size), whose pixels are the shares that it covers."""
    fine = 8 * size
    y, x = (np.mgrid[:fine, :fine] + 0.5) / 8 - size / 2
    return (np.hypot(x, y) < radius).reshape(size, 8, size, 8).mean(axis=(1, 3)).astype(np.float32)


def square(size):
    return vrrt_jax.look_at((2, 0, 1), (0, 0, 0.3), height=size, width=size)


def test_an_outline_that_is_off_has_the_loss_that_is_expected():
    size, camera = 60, square(60)
    true, larger = disc(0.25 * size, size), disc(0.25 * size + 0.5, size)
    goal, _ = prepare_goal([np.dstack([true] * 4)], [camera], size)
    loss = np.mean((true - larger) ** 2) / 4
    assert mask_loss(goal, 0.5) == pytest.approx(loss, rel=0.3)
    assert mask_loss(goal, 0.0) == 0


def test_only_masks_of_0_and_1_are_known_to_be_rough():
    size, camera = 60, square(60)
    soft = disc(0.25 * size, size)
    hard = np.round(soft)
    for alpha, error in ((soft, 0.0), (hard, OUTLINE_PX)):
        views = check_views([np.dstack([alpha] * 4)], [camera])
        assert outline_error_px(views, size) == error
        assert outline_error_px(views, size // 4) == pytest.approx(error / 4)
        # On a smaller image the same error is a smaller one.
        losses = [
            mask_loss(shrink_views(views, px)[0], outline_error_px(views, px))
            for px in (size, size // 4)
        ]
        assert losses[1] == pytest.approx(losses[0] / 4, rel=0.3)


def test_a_mask_of_0_and_1_raises_thresholds(panda):
    problem = vrrt_jax.load_problem("panda_posts", engine="closed_form")
    given, view = problem.goal_images[0], problem.cameras[0]
    hard = given.copy()
    hard[..., 3] = np.round(given[..., 3])
    of_soft, of_hard = (
        vrrt_jax.ImageGoal(problem.self_model, view, image) for image in (given, hard)
    )
    # On images of 120 px about as much as the self-model's own errors, on smaller ones less.
    ratios = [
        float(of_hard.at(panda, px).threshold / of_soft.at(panda, px).threshold) for px in (120, 40)
    ]
    assert 1.3 < ratios[0] < 2.5 and 1.02 < ratios[1] < ratios[0]
    close_up, soft_close_up = of_hard.close_up(480), of_soft.close_up(480)
    assert close_up.outline_error_px == OUTLINE_PX and soft_close_up.outline_error_px == 0


def test_a_ragged_mask_does_not_let_everything_match(panda, rng):
    problem = vrrt_jax.load_problem("panda_posts", engine="closed_form")
    given, view = problem.goal_images[0], problem.cameras[0]
    ragged = given.copy()
    ragged[..., 3] = np.round(given[..., 3]) * (rng.random(given.shape[:2]) < 0.5)
    goal = vrrt_jax.ImageGoal(problem.self_model, view, ragged).at(panda, 120)
    covered = float(goal.image.alpha.mean())
    calibrated = problem.self_model.level_for(120).match_threshold * covered
    assert float(goal.threshold) <= 2 * calibrated * (1 + 1e-5)
