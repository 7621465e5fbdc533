"""The rasterizer against plain loops, finite differences and itself without windows."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vrrt_jax.bench.raster import random_splats
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.splat.camera import look_at, stack_cameras
from vrrt_jax.splat.raster import Windows, choose_windows, map_lanes, render, splat_sum
from vrrt_jax.splat.types import SplatModel

FLOAT32_TOLERANCE = 2e-5  # of images; worst seen 3e-6
WINDOW_TOLERANCE = 2e-3  # of images; a splat may lose 1e-3 outside its window, worst seen 4e-6
DIFFERENCE_TOLERANCE = 1e-6  # relative, of float64 gradients; worst seen 7e-8
COSINE, RELATIVE_L2 = 1 - 1e-6, 1e-4  # of float32 gradients; worst seen 1 - 1e-7 and 7e-6


def splats(mean, rgb=None, *, radius=0.02, density=2.0, tau=0.03, link=None):
    """Splats on one link unless told otherwise."""
    mean = jnp.asarray(mean)
    num = len(mean)
    return SplatModel(
        mean=mean,
        radius=jnp.broadcast_to(jnp.asarray(radius, mean.dtype), num),
        density=jnp.broadcast_to(jnp.asarray(density, mean.dtype), num),
        rgb=jnp.full((num, 3), 0.5, mean.dtype) if rgb is None else jnp.asarray(rgb, mean.dtype),
        view_color_gradient=jnp.full((num, 3), 0.1, mean.dtype),
        link=jnp.zeros(num, jnp.int32) if link is None else jnp.asarray(link),
        tau=jnp.asarray(tau, mean.dtype),
    )


def ahead(height=48, width=40, fovy_deg=45.0):
    """A camera at the origin that looks along x; y points left and z up in the image."""
    return look_at((0, 0, 0), (1, 0, 0), fovy_deg=fovy_deg, height=height, width=width)


def squares(image):
    return sum(jnp.mean(channel**2) for channel in image)


@jax.jit
def squares_and_gradient(x):
    """Of an image of two splats, by what ``x`` holds."""

    def loss(x):
        return squares(render(dataclasses.replace(splats(jnp.zeros((2, 3))), **x), poses, ahead()))

    poses = jnp.eye(4)[None]
    return jax.value_and_grad(loss)(x)


def agree(a, b):
    """Cosine and relative distance of two gradients."""
    a, b = np.ravel(a), np.ravel(b)
    cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
    return cosine, np.linalg.norm(a - b) / np.linalg.norm(b)


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


def test_splat_sum_is_the_sum_over_splats(rng):
    pixel, inv_sigma = rng.uniform(-2, 14, (20, 2)), rng.uniform(0.3, 2, 20)
    features = rng.normal(size=(20, 3))
    expected = np.zeros((8, 12, 3))
    for g in range(20):
        for row in range(8):
            for column in range(12):
                offset = (np.array([column, row]) + 0.5 - pixel[g]) * inv_sigma[g]
                expected[row, column] += np.exp(-0.5 * offset @ offset) * features[g]
    total = splat_sum(*(jnp.asarray(a, jnp.float32) for a in (pixel, inv_sigma, features)), (8, 12))
    np.testing.assert_allclose(total, expected, atol=FLOAT32_TOLERANCE)


@pytest.mark.parametrize("size", [(8, 8), (66, 10)])
def test_gradients_are_those_of_finite_differences(panda, rng, size):
    """By joint positions and by everything a self-model learns."""
    with jax.enable_x64(True):
        model = jax.tree.map(
            lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a,
            random_splats(panda, 24, rng),
        )
        chain = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), panda.chain)
        camera = look_at((1.2, 1.0, 0.8), (0, 0, 0.4), height=size[0], width=size[1])
        weight = jnp.asarray(rng.normal(size=(*size, 4)))
        names = ("mean", "radius", "density", "rgb", "view_color_gradient", "tau")

        @jax.jit
        def loss(x):
            changed = dataclasses.replace(model, **{name: x[name] for name in names})
            rgb, alpha = render(changed, link_poses(chain, x["q"]), camera)
            return jnp.sum(weight * jnp.concatenate([rgb, alpha[..., None]], axis=-1) ** 2)

        x = {name: getattr(model, name) for name in names}
        x["q"] = jnp.asarray(rng.uniform(panda.lower, panda.upper))
        gradient = jax.jit(jax.grad(loss))(x)
        for name, value in x.items():
            direction = jnp.asarray(rng.normal(size=value.shape))
            step = 1e-6 * direction
            high, low = (loss({**x, name: value + s}) for s in (step, -step))
            slope = jnp.sum(gradient[name] * direction)
            np.testing.assert_allclose(
                (high - low) / 2e-6, slope, rtol=DIFFERENCE_TOLERANCE, atol=1e-8, err_msg=name
            )


@pytest.mark.parametrize(
    "mean",
    [
        pytest.param([[-1.0, 0.0, 0.0], [-2.0, 0.1, 0.0]], id="behind the camera"),
        pytest.param([[1.0, 9.0, 0.0], [1.0, 0.0, -9.0]], id="off screen"),
        pytest.param([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]], id="in the camera plane"),
    ],
)
def test_an_image_without_splats_is_black_and_flat(mean):
    model = splats(mean)
    value, gradient = squares_and_gradient(
        {name: getattr(model, name) for name in ("mean", "radius", "density", "rgb", "tau")}
    )
    assert value == 0.0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0.0)


def test_a_splat_behind_the_camera_changes_nothing():
    """Even where the others are so far away that its weight would overflow."""
    model = splats([[6.0, 0.1, 0.0], [-1.0, 0.0, 0.0]], radius=0.3)
    both = {name: getattr(model, name) for name in ("mean", "radius", "density", "rgb", "tau")}
    value, gradient = squares_and_gradient(both)
    alone, alone_gradient = squares_and_gradient({**both, "density": jnp.array([2.0, 0.0])})
    assert value == alone > 0
    for name in ("mean", "radius", "rgb"):
        np.testing.assert_allclose(gradient[name][0], alone_gradient[name][0], rtol=1e-5)
        np.testing.assert_array_equal(gradient[name][1], 0.0)


@pytest.mark.parametrize("windows", [None, Windows(cluster=1, px=24)])
def test_far_splats_keep_their_color(windows):
    """Four meters behind the nearest, at the smallest tau: exp(-133) is zero in float32."""
    model = splats(
        [[1.0, 0.25, 0.0], [5.0, -1.25, 0.0]], [[1, 0, 0], [0, 1, 0]], radius=(0.03, 0.15)
    )
    model = dataclasses.replace(model, view_color_gradient=jnp.zeros((2, 3)))

    @jax.jit
    @jax.grad
    def gradient(poses):
        return squares(render(model, poses, ahead(), windows))

    poses = jnp.eye(4)[None]
    rgb, alpha = jax.jit(lambda p: render(model, p, ahead(), windows))(poses)
    row, column = np.unravel_index(np.argmax(rgb[..., 1]), alpha.shape)
    assert alpha[row, column] > 0.5
    np.testing.assert_allclose(rgb[row, column, 1], alpha[row, column], rtol=1e-3)
    assert np.all(np.isfinite(gradient(poses))) and np.any(gradient(poses) != 0)


def test_windows_do_not_change_the_picture(panda, panda_splats, panda_camera, panda_q):
    """In float32, against the sum over whole images in float64."""
    poses = jax.vmap(lambda q: link_poses(panda.chain, q))(panda_q)
    model, windows = choose_windows(panda_splats, poses, panda_camera)
    assert windows is not None and windows.px < 48

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
        rgb, alpha = render(splats(mean), jnp.eye(4)[None], ahead(), *windows)
        return jnp.sum(weight * jnp.concatenate([rgb, alpha[..., None]], axis=-1))

    value, gradient = jax.jit(jax.value_and_grad(loss))(mean)
    cut = jax.jit(jax.value_and_grad(lambda mean: loss(mean, Windows(cluster=16, px=12))))
    cut_value, cut_gradient = cut(mean)
    np.testing.assert_allclose(cut_value, value, rtol=WINDOW_TOLERANCE)
    for half in (slice(16), slice(16, 32)):
        cosine, distance = agree(cut_gradient[half], gradient[half])
        assert cosine > COSINE and distance < RELATIVE_L2


def test_a_near_splat_tints_far_ones_outside_a_narrow_window_too():
    """Four standard deviations from its center it still outweighs what is half a meter behind."""
    model = splats([[1.0, 0.0, 0.0], [1.5, 0.16, 0.0]], [[1, 0, 0], [0, 1, 0]], radius=(0.02, 0.05))
    whole, cut = (
        jax.jit(lambda p, w=w: render(model, p, ahead(), w)[0])(jnp.eye(4)[None])
        for w in (None, Windows(cluster=1, px=8))
    )
    tinted = np.asarray((whole[..., 0] > 0.1) & (whole[..., 1] > 0.1))
    assert tinted.any()
    np.testing.assert_allclose(cut, whole, atol=WINDOW_TOLERANCE)


def test_a_layer_hides_another_only_as_far_as_it_covers():
    """Where the near splat is faint the far one keeps its color, and behind it none is left."""
    model = splats([[1.0, 0.0, 0.0], [1.5, 0.0, 0.0]], [[1, 0, 0], [0, 1, 0]], radius=(0.02, 0.09))
    model = dataclasses.replace(
        model, density=jnp.array([9.0, 3.0]), view_color_gradient=jnp.zeros((2, 3))
    )

    def image(model):
        rgb, alpha = jax.jit(lambda p: render(model, p, ahead()))(jnp.eye(4)[None])
        return np.asarray(rgb), np.asarray(alpha)

    one, alpha = image(model)
    two, covered_by_both = image(dataclasses.replace(model, starts=(0, 1)))
    far = dataclasses.replace(model, density=jnp.array([0.0, 3.0]))
    near = dataclasses.replace(model, density=jnp.array([9.0, 0.0]))
    near_alpha, far_alpha = image(near)[1], image(far)[1]
    np.testing.assert_allclose(covered_by_both, alpha, atol=FLOAT32_TOLERANCE)
    np.testing.assert_allclose(two[..., 0], near_alpha, atol=0.01)
    np.testing.assert_allclose(two[..., 1], (1 - near_alpha) * far_alpha, atol=0.01)
    edge = (near_alpha > 0.001) & (near_alpha < 0.05)
    assert np.all(one[edge, 0] > 0.9 * alpha[edge])  # a single layer paints it all over


def test_the_order_of_layers_does_not_matter():
    model = splats([[1.0, 0.0, 0.0], [1.5, 0.02, 0.0]], [[1, 0, 0], [0, 1, 0]], radius=0.05)
    model = dataclasses.replace(model, starts=(0, 1))
    turned = jax.tree.map(lambda a: a[::-1] if a.ndim else a, model)
    picture, expected = (
        jax.jit(lambda p, m=m: render(m, p, ahead())[0])(jnp.eye(4)[None]) for m in (turned, model)
    )
    np.testing.assert_allclose(picture, expected, atol=FLOAT32_TOLERANCE)


def test_clusters_are_the_same_splats_of_one_link_each(panda, panda_splats, panda_camera, panda_q):
    poses = jax.vmap(lambda q: link_poses(panda.chain, q))(panda_q)
    model, windows = choose_windows(panda_splats, poses, panda_camera)
    link = np.asarray(model.link).reshape(-1, windows.cluster)
    np.testing.assert_array_equal(link, link[:, :1].repeat(windows.cluster, 1))
    kept = np.asarray(model.density) > 0
    original = np.asarray(panda_splats.mean)
    mean = np.asarray(model.mean)[kept]
    assert len(mean) == len(original)
    np.testing.assert_array_equal(np.unique(mean, axis=0), np.unique(original, axis=0))


def test_windows_are_not_chosen_where_they_do_not_pay(panda, panda_splats, panda_q):
    close = look_at((0.5, 0.4, 0.5), (0, 0, 0.4), fovy_deg=20.0, height=32, width=32)
    poses = jax.vmap(lambda q: link_poses(panda.chain, q))(panda_q)
    model, windows = choose_windows(panda_splats, poses, close)
    assert windows is None and model is panda_splats


def test_any_nesting_of_maps_gives_the_same(panda, panda_splats, panda_camera, panda_q):
    """Lanes and views, mapped over in any order, against one call each."""
    other = look_at((1.2, -1.0, 0.9), (0, 0, 0.4), height=48, width=64)
    cameras = stack_cameras([panda_camera, other])
    poses = jax.vmap(lambda q: link_poses(panda.chain, q))(panda_q)
    model, windows = choose_windows(panda_splats, poses, panda_camera)

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


def test_a_lane_that_is_not_finite_leaves_the_others_alone(
    panda, panda_splats, panda_camera, panda_q
):
    poses = jax.vmap(lambda q: link_poses(panda.chain, q))(panda_q)
    model, windows = choose_windows(panda_splats, poses, panda_camera)
    loss = jax.jit(jax.vmap(lambda p: squares(render(model, p, panda_camera, windows))))
    good, bad = loss(poses), loss(poses.at[2].set(jnp.nan))
    assert np.isnan(bad[2])
    np.testing.assert_array_equal(np.delete(bad, 2), np.delete(good, 2))
