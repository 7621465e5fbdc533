"""The rasterizer against finite differences, and where splats are far, hidden or out of view."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splat_cases import IDENTITY, camera_ahead, render_jit, slopes, splats, squares

from vrrt_jax.bench.raster import random_splats
from vrrt_jax.core.precision import double_precision
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.splat.camera import look_at
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.windows import Windows

pytestmark = pytest.mark.light_compilation

FLOAT32_TOLERANCE = 2e-5  # of images; worst seen 3e-6
DIFFERENCE_TOLERANCE = 1e-6  # relative, of float64 gradients; worst seen 7e-8


@jax.jit
def squares_and_gradient(x):
    """Of an image of two splats, by what ``x`` holds."""

    def loss(x):
        model = dataclasses.replace(splats(jnp.zeros((2, 3))), **x)
        return squares(render(model, IDENTITY, camera_ahead()))

    return jax.value_and_grad(loss)(x)


@pytest.mark.parametrize("size", [(8, 8), (66, 10)])
def test_gradients_are_those_of_finite_differences(panda, rng, size):
    """By joint positions and by everything a self-model learns."""
    with double_precision():
        model = jax.tree.map(
            lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a,
            random_splats(panda, 24, rng),
        )
        chain = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), panda.chain)
        camera = look_at((1.2, 1.0, 0.8), (0, 0, 0.4), height=size[0], width=size[1])
        weight = jnp.asarray(rng.normal(size=(*size, 4)))
        names = ("mean", "radius", "density", "rgb", "view_color_gradient", "tau")

        def loss(x):
            changed = dataclasses.replace(model, **{name: x[name] for name in names})
            rgb, alpha = render(changed, link_poses(chain, x["q"]), camera)
            return jnp.sum(weight * jnp.concatenate([rgb, alpha[..., None]], axis=-1) ** 2)

        x = {name: getattr(model, name) for name in names}
        x["q"] = jnp.asarray(rng.uniform(panda.lower, panda.upper))
        for name, difference, slope in slopes(loss, x, rng):
            np.testing.assert_allclose(
                difference, slope, rtol=DIFFERENCE_TOLERANCE, atol=1e-8, err_msg=name
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


@pytest.mark.parametrize("windows", [None, Windows(cluster_size=1, size_px=24)])
def test_far_splats_keep_their_color(windows):
    """Four meters behind the nearest, at the smallest tau: exp(-133) is zero in float32."""
    model = splats(
        [[1.0, 0.25, 0.0], [5.0, -1.25, 0.0]], [[1, 0, 0], [0, 1, 0]], radius=(0.03, 0.15), shade=0
    )

    @jax.jit
    def gradient_and_image(poses):
        def loss(poses):
            image = render(model, poses, camera_ahead(), windows)
            return squares(image), image

        return jax.grad(loss, has_aux=True)(poses)

    gradient, (rgb, alpha) = gradient_and_image(IDENTITY)
    row, column = np.unravel_index(np.argmax(rgb[..., 1]), alpha.shape)
    assert alpha[row, column] > 0.5
    np.testing.assert_allclose(rgb[row, column, 1], alpha[row, column], rtol=1e-3)
    assert np.all(np.isfinite(gradient)) and np.any(gradient != 0)


def test_a_layer_hides_another_only_as_far_as_it_covers():
    """Where the near splat is faint the far one keeps its color, and behind it none is left."""
    model = splats(
        [[1.0, 0.0, 0.0], [1.5, 0.0, 0.0]],
        [[1, 0, 0], [0, 1, 0]],
        radius=(0.02, 0.09),
        density=(9.0, 3.0),
        shade=0,
    )

    def image(model):
        return tuple(np.asarray(a) for a in render_jit(model, IDENTITY, camera_ahead()))

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
    model = splats(
        [[1.0, 0.0, 0.0], [1.5, 0.02, 0.0]], [[1, 0, 0], [0, 1, 0]], radius=0.05, starts=(0, 1)
    )
    turned = jax.tree.map(lambda a: a[::-1] if a.ndim else a, model)
    picture, expected = (render_jit(m, IDENTITY, camera_ahead())[0] for m in (turned, model))
    np.testing.assert_allclose(picture, expected, atol=FLOAT32_TOLERANCE)
