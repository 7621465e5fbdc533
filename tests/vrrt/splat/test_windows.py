"""Windows change nothing but the time; lanes and views map in any order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_cases import IDENTITY, agree, camera_ahead, render_jit, splats, squares

from vrrt_jax.bench.raster import random_splats
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.splat.camera import look_at, stack_cameras
from vrrt_jax.splat.lanes import map_lanes
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.windows import Windows, choose_windows

pytestmark = pytest.mark.light_compilation

FLOAT32_TOLERANCE = 2e-5  # of images; worst seen 3e-6
WINDOW_TOLERANCE = 2e-3  # of images; a splat may lose 1e-3 outside its window, worst seen 4e-6
COSINE, RELATIVE_L2 = 1 - 1e-6, 1e-4  # of float32 gradients; worst seen 1 - 1e-7 and 7e-6


@pytest.fixture(scope="module")
def panda_splats(panda):
    return random_splats(panda, 300, np.random.default_rng(1))


@pytest.fixture(scope="module")
def panda_camera():
    return look_at((1.5, 1.2, 0.9), (0, 0, 0.4), height=48, width=64)


@pytest.fixture(scope="module")
def panda_q(panda):
    rng = np.random.default_rng(2)
    return jnp.asarray(rng.uniform(panda.lower, panda.upper, (6, panda.num_joints)), jnp.float32)


@pytest.fixture(scope="module")
def panda_poses(panda, panda_q):
    return jax.jit(jax.vmap(link_poses, (None, 0)))(panda.chain, panda_q)


@pytest.fixture(scope="module")
def clustered(panda_splats, panda_poses, panda_camera):
    """Splats in clusters, and their windows."""
    return choose_windows(panda_splats, panda_poses, panda_camera)


def test_windows_do_not_change_the_picture(panda, panda_splats, panda_camera, panda_q, clustered):
    """In float32, against the sum over whole images in float64."""
    model, windows = clustered
    assert windows is not None and windows.size_px < 48

    def image_and_gradient(dtype, model, *windows):
        model, chain, camera, q = jax.tree.map(
            lambda a: jnp.asarray(a, dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a,
            (model, panda.chain, panda_camera, panda_q),
        )

        def loss(q):
            image = render(model, link_poses(chain, q), camera, *windows)
            return squares(image), image

        gradient, image = jax.jit(jax.vmap(jax.grad(loss, has_aux=True)))(q)
        return image, np.asarray(gradient, np.float64)

    image, gradient = image_and_gradient(jnp.float32, model, windows)
    with jax.enable_x64(True):
        exact_image, exact_gradient = image_and_gradient(jnp.float64, panda_splats)
    for a, b in zip(image, exact_image, strict=True):
        np.testing.assert_allclose(a, b, atol=WINDOW_TOLERANCE)
    for a, b in zip(gradient, exact_gradient, strict=True):
        cosine, distance = agree(a, b)
        assert cosine > COSINE and distance < RELATIVE_L2


def test_clusters_that_fit_and_others_mix(rng):
    """The first sixteen splats fit a window of 12 pixels, the next sixteen cover the image."""
    near, wide = rng.uniform(-0.03, 0.03, (16, 3)), rng.uniform(-0.4, 0.4, (16, 3))
    mean = jnp.asarray(np.concatenate([near, wide]) + [1.5, 0, 0], jnp.float32)
    weight = jnp.asarray(rng.normal(size=(48, 40, 4)), jnp.float32)

    def loss(mean, *windows):
        rgb, alpha = render(splats(mean), IDENTITY, camera_ahead(), *windows)
        return jnp.sum(weight * jnp.concatenate([rgb, alpha[..., None]], axis=-1))

    value, gradient = jax.jit(jax.value_and_grad(loss))(mean)
    cut = jax.jit(jax.value_and_grad(lambda mean: loss(mean, Windows(cluster_size=16, size_px=12))))
    cut_value, cut_gradient = cut(mean)
    np.testing.assert_allclose(cut_value, value, rtol=WINDOW_TOLERANCE)
    for half in (slice(16), slice(16, 32)):
        cosine, distance = agree(cut_gradient[half], gradient[half])
        assert cosine > COSINE and distance < RELATIVE_L2


def test_a_near_splat_tints_far_ones_outside_a_narrow_window_too():
    """Four standard deviations from its center it still outweighs what is half a meter behind."""
    model = splats([[1.0, 0.0, 0.0], [1.5, 0.16, 0.0]], [[1, 0, 0], [0, 1, 0]], radius=(0.02, 0.05))
    whole, cut = (
        render_jit(model, IDENTITY, camera_ahead(), windows)[0]
        for windows in (None, Windows(cluster_size=1, size_px=8))
    )
    tinted = np.asarray((whole[..., 0] > 0.1) & (whole[..., 1] > 0.1))
    assert tinted.any()
    np.testing.assert_allclose(cut, whole, atol=WINDOW_TOLERANCE)


def test_clusters_are_the_same_splats_of_one_link_each(panda_splats, clustered):
    model, windows = clustered
    link = np.asarray(model.link).reshape(-1, windows.cluster_size)
    np.testing.assert_array_equal(link, link[:, :1].repeat(windows.cluster_size, 1))
    kept = np.asarray(model.density) > 0
    original = np.asarray(panda_splats.mean)
    mean = np.asarray(model.mean)[kept]
    assert len(mean) == len(original)
    np.testing.assert_array_equal(np.unique(mean, axis=0), np.unique(original, axis=0))


def test_windows_are_not_chosen_where_they_do_not_pay(panda_splats, panda_poses):
    close = look_at((0.5, 0.4, 0.5), (0, 0, 0.4), fovy_deg=20.0, height=32, width=32)
    model, windows = choose_windows(panda_splats, panda_poses, close)
    assert windows is None and model is panda_splats


def test_any_nesting_of_maps_gives_the_same(panda_camera, panda_poses, clustered):
    """Lanes and views, mapped over in any order, against one call each."""
    other = look_at((1.2, -1.0, 0.9), (0, 0, 0.4), height=48, width=64)
    cameras = stack_cameras([panda_camera, other])
    poses, (model, windows) = panda_poses, clustered

    def alpha(poses, camera):
        return render(model, poses, camera, windows)[1]

    one = jax.jit(alpha)
    expected = np.stack([[one(p, c) for c in (panda_camera, other)] for p in poses])
    over_views = jax.vmap(alpha, (None, 0))
    by_lane = jax.jit(jax.vmap(over_views, (0, None)))(poses, cameras)
    by_view = jax.jit(jax.vmap(jax.vmap(alpha, (0, None)), (None, 0), 1))(poses, cameras)
    by_map = jax.jit(lambda p: map_lanes(lambda p: over_views(p, cameras), p))(poses)
    for actual in (by_lane, by_view, by_map):
        np.testing.assert_allclose(actual, expected, atol=FLOAT32_TOLERANCE)


def test_a_lane_that_is_not_finite_leaves_the_others_alone(panda_camera, panda_poses, clustered):
    model, windows = clustered
    loss = jax.jit(jax.vmap(lambda p: squares(render(model, p, panda_camera, windows))))
    good, bad = loss(panda_poses), loss(panda_poses.at[2].set(jnp.nan))
    assert np.isnan(bad[2])
    np.testing.assert_array_equal(np.delete(bad, 2), np.delete(good, 2))
