"""The plain compositor: hand cases, finite differences, and the fast rasterizer against it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vrrt_jax.bench.raster import random_splats
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.splat.camera import look_at
from vrrt_jax.splat.raster import PIXEL_BLUR, render
from vrrt_jax.splat.reference import Gaussians, composite, render_gaussians, render_reference
from vrrt_jax.splat.types import SplatModel

ALPHA_TOLERANCE = 1e-5  # worst seen 3e-6
DIFFERENCE_TOLERANCE = 1e-6  # relative, of float64 gradients; worst seen 1e-8


def ahead(height=48, width=40):
    """A camera at the origin that looks along x; y points left and z up in the image."""
    return look_at((0, 0, 0), (1, 0, 0), height=height, width=width)


def gaussians(rng, num=6):
    """Anisotropic splats between 1 and 2 m ahead."""
    return Gaussians(
        mean=jnp.asarray(rng.uniform((1, -0.3, -0.3), (2, 0.3, 0.3), (num, 3))),
        quaternion=jnp.asarray(rng.normal(size=(num, 4))),
        scale=jnp.asarray(rng.uniform(0.02, 0.12, (num, 3))),
        density=jnp.asarray(rng.uniform(0.5, 3, num)),
        rgb=jnp.asarray(rng.uniform(size=(num, 3))),
    )


def painted(pixel, covariance, depth, density, rgb, size):
    """Front to back, pixel by pixel."""
    image, alpha = np.zeros((*size, 3)), np.zeros(size)
    for row, column in np.ndindex(size):
        light = 1.0
        for g in np.argsort(depth):
            offset = np.array([column, row]) + 0.5 - pixel[g]
            footprint = np.exp(-0.5 * offset @ np.linalg.inv(covariance[g]) @ offset)
            alpha = 1.0 - np.exp(-density[g] * footprint)
            image[row, column] += light * alpha * rgb[g]
            light *= 1.0 - alpha
        alpha[row, column] = 1.0 - light
    return image, alpha


def test_composite_is_the_painters_loop(rng):
    factor = rng.normal(size=(7, 2, 2))
    arrays = (
        rng.uniform(0, 9, (7, 2)),
        factor @ factor.transpose(0, 2, 1) + 0.3 * np.eye(2),
        rng.uniform(1, 2, 7),
        rng.uniform(0.2, 4, 7),
        rng.uniform(size=(7, 3)),
    )
    expected = painted(*arrays, (8, 10))
    actual = composite(*(jnp.asarray(a, jnp.float32) for a in arrays), (8, 10))
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_long_gaussian_has_the_moments_of_its_projection():
    """0.2 m along the camera's x, 0.05 m along its y, then turned by a quarter about its axis."""
    camera = ahead(80, 80)
    y, x = np.mgrid[:80, :80] + 0.5 - 40
    for quaternion, (along_x, along_y) in (
        ([1, 0, 0, 0], (0.2, 0.05)),
        ([2, 2, 0, 0], (0.05, 0.2)),  # about the world's x, where the camera looks
    ):
        one = Gaussians(
            mean=jnp.array([[2.0, 0.0, 0.0]]),
            quaternion=jnp.array([quaternion], jnp.float32),
            scale=jnp.array([[0.4, 0.2, 0.05]]),
            density=jnp.array([1e-3]),
            rgb=jnp.ones((1, 3)),
        )
        alpha = np.asarray(jax.jit(render_gaussians)(one, camera)[1], np.float64)
        share = alpha / alpha.sum()
        focal = float(camera.focal)
        for offset, scale in ((x, along_x), (y, along_y)):
            expected = (focal * scale / 2.0) ** 2 + PIXEL_BLUR**2
            np.testing.assert_allclose(np.sum(share * offset**2), expected, rtol=5e-3)


def test_balls_are_the_same_as_isotropic_splats_on_the_optical_axis():
    mean = jnp.array([[1.2, 0.0, 0.0], [1.6, 0.0, 0.0]])
    balls = Gaussians(
        mean=mean,
        quaternion=jnp.array([[0.3, -0.4, 0.5, 0.6], [1.0, 0.0, 2.0, 0.0]]),
        scale=jnp.broadcast_to(jnp.array([[0.05], [0.09]]), (2, 3)),
        density=jnp.array([0.7, 2.0]),
        rgb=jnp.array([[1.0, 0.2, 0.0], [0.0, 0.5, 1.0]]),
    )
    model = SplatModel(
        mean=mean,
        radius=balls.scale[:, 0],
        density=balls.density,
        rgb=balls.rgb,
        view_color_gradient=jnp.zeros((2, 3)),
        link=jnp.zeros(2, jnp.int32),
        tau=jnp.float32(0.03),
    )
    for a, b in zip(
        jax.jit(render_gaussians)(balls, ahead()),
        jax.jit(render_reference)(model, jnp.eye(4)[None], ahead()),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("size", [(8, 8), (10, 12)])
def test_gradients_are_those_of_finite_differences(rng, size):
    with jax.enable_x64(True):
        weight = jnp.asarray(rng.normal(size=(*size, 4)))

        @jax.jit
        def loss(x):
            rgb, alpha = render_gaussians(x, ahead(*size))
            return jnp.sum(weight * jnp.concatenate([rgb, alpha[..., None]], axis=-1))

        x = gaussians(rng)
        gradient = jax.jit(jax.grad(loss))(x)
        for field in dataclasses.fields(x):
            value = getattr(x, field.name)
            direction = jnp.asarray(rng.normal(size=value.shape))
            high, low = (
                loss(dataclasses.replace(x, **{field.name: value + step * direction}))
                for step in (1e-6, -1e-6)
            )
            slope = jnp.sum(getattr(gradient, field.name) * direction)
            np.testing.assert_allclose(
                (high - low) / 2e-6, slope, rtol=DIFFERENCE_TOLERANCE, atol=1e-8
            )


@pytest.mark.parametrize("mean", [[-1.0, 0.0, 0.0], [0.0, 0.1, 0.0], [1.0, 30.0, 0.0]])
def test_a_gaussian_out_of_view_leaves_a_black_image_and_no_gradient(rng, mean):
    one = jax.tree.map(lambda a: a[:1], gaussians(rng))
    one = dataclasses.replace(one, mean=jnp.array([mean]))

    @jax.jit
    @jax.value_and_grad
    def loss(x):
        rgb, alpha = render_gaussians(x, ahead())
        return jnp.sum(rgb) + jnp.sum(alpha)

    value, gradient = loss(one)
    assert value == 0.0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0.0)


def test_the_fast_rasterizer_has_the_same_alpha(panda, rng):
    """1 - prod(1 - alpha) = 1 - exp(-sum), also where splats overlap."""
    model = random_splats(panda, 200, rng)
    camera = look_at((1.5, 1.2, 0.9), (0, 0, 0.4), height=40, width=48)
    poses = link_poses(panda.chain, jnp.asarray(rng.uniform(panda.lower, panda.upper), jnp.float32))
    fast, exact = (jax.jit(f)(model, poses, camera)[1] for f in (render, render_reference))
    assert exact.max() > 0.9
    np.testing.assert_allclose(fast, exact, atol=ALPHA_TOLERANCE)


def test_the_fast_rasterizer_has_the_same_colors_where_splats_do_not_overlap():
    """Shaded splats on two turned links, each in its own corner."""
    quarter = jnp.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses = jnp.stack([jnp.eye(4), jnp.eye(4).at[:3, :3].set(quarter)])
    model = SplatModel(
        mean=jnp.array([[1.5, 0.3, 0.3], [1.6, -0.3, 0.3], [0.3, -1.4, -0.3], [-0.3, -1.5, -0.3]]),
        radius=jnp.array([0.02, 0.03, 0.025, 0.02]),
        density=jnp.array([0.5, 1.0, 2.0, 4.0]),
        rgb=jnp.array([[0.9, 0.1, 0.3], [0.2, 0.8, 0.4], [0.1, 0.3, 0.9], [0.6, 0.5, 0.2]]),
        view_color_gradient=jnp.array(
            [[0.3, -0.2, 0.1], [-0.4, 0.2, 0.3], [0.2, 0.5, 0.0], [0.1, -0.3, 0.4]]
        ),
        link=jnp.array([0, 0, 1, 1]),
        tau=jnp.float32(0.03),
    )
    fast, _ = jax.jit(render)(model, poses, ahead(60, 60))
    exact, alpha = jax.jit(render_reference)(model, poses, ahead(60, 60))
    assert np.all(np.max(exact, axis=(0, 1)) > 0.3)
    clear = np.asarray(alpha) > 0.05  # elsewhere, tails of different splats mix
    np.testing.assert_allclose(fast[clear], exact[clear], atol=1e-4)


def test_soft_occlusion_becomes_true_occlusion_of_dense_splats():
    """A dense splat hides one behind it, the more so the smaller tau is."""
    model = SplatModel(
        mean=jnp.array([[1.5, 0.0, 0.0], [1.4, 0.0, 0.0]]),
        radius=jnp.array([0.1, 0.1]),
        density=jnp.array([20.0, 20.0]),
        rgb=jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        view_color_gradient=jnp.zeros((2, 3)),
        link=jnp.zeros(2, jnp.int32),
        tau=jnp.float32(0.03),
    )
    poses, camera = jnp.eye(4)[None], ahead()
    fast, exact = jax.jit(render), jax.jit(render_reference)
    front = dataclasses.replace(model, density=jnp.array([0.0, 20.0]))
    dense = np.asarray(exact(front, poses, camera)[1]) > 0.9999
    assert dense.sum() > 20
    errors = []
    for tau in (0.1, 0.03, 0.01):
        softer = dataclasses.replace(model, tau=jnp.float32(tau))
        difference = fast(softer, poses, camera)[0] - exact(model, poses, camera)[0]
        errors.append(np.abs(difference)[dense].max())
    assert errors[0] > errors[1] > errors[2] and errors[2] < 1e-3
