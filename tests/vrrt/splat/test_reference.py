"""The plain compositor: hand cases, finite differences, and the fast rasterizer against it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference.splats import painted, render_gaussians
from splat_cases import IDENTITY, camera_ahead, render_jit, slopes, splats

from vrrt_jax.bench.raster import random_splats
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.splat.camera import look_at
from vrrt_jax.splat.projection import PIXEL_BLUR
from vrrt_jax.splat.reference import composite, render_reference
from vrrt_jax.splat.types import SplatModel

pytestmark = pytest.mark.light_compilation

ALPHA_TOLERANCE = 1e-5  # worst seen 3e-6
DIFFERENCE_TOLERANCE = 1e-6  # relative, of float64 gradients; worst seen 1e-8

reference_jit = jax.jit(render_reference)


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
    draw = jax.jit(composite, static_argnums=5)
    actual = draw(*(jnp.asarray(a, jnp.float32) for a in arrays), (8, 10))
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_long_gaussian_has_the_moments_of_its_projection():
    """0.2 m along the camera's x, 0.05 m along its y, then turned by a quarter about its axis."""
    camera = camera_ahead(80, 80)
    y, x = np.mgrid[:80, :80] + 0.5 - 40
    for quaternion, (along_x, along_y) in (
        ([1, 0, 0, 0], (0.2, 0.05)),
        ([2, 2, 0, 0], (0.05, 0.2)),  # about the world's x, where the camera looks
    ):
        _, alpha = render_gaussians(
            mean=np.array([[2.0, 0.0, 0.0]]),
            quaternion=np.array([quaternion]),
            scale=np.array([[0.4, 0.2, 0.05]]),
            density=np.array([1e-3]),
            rgb=np.ones((1, 3)),
            camera=camera,
            blur=PIXEL_BLUR,
        )
        share = alpha / alpha.sum()
        focal = float(camera.focal)
        for offset, scale in ((x, along_x), (y, along_y)):
            expected = (focal * scale / 2.0) ** 2 + PIXEL_BLUR**2
            np.testing.assert_allclose(np.sum(share * offset**2), expected, rtol=5e-3)


def test_balls_are_the_same_as_isotropic_splats_on_the_optical_axis():
    model = splats(
        [[1.2, 0.0, 0.0], [1.6, 0.0, 0.0]],
        [[1.0, 0.2, 0.0], [0.0, 0.5, 1.0]],
        radius=(0.05, 0.09),
        density=(0.7, 2.0),
        shade=0,
    )
    balls = render_gaussians(
        mean=np.asarray(model.mean, float),
        quaternion=np.array([[0.3, -0.4, 0.5, 0.6], [1.0, 0.0, 2.0, 0.0]]),
        scale=np.repeat(np.asarray(model.radius, float)[:, None], 3, axis=1),
        density=np.asarray(model.density, float),
        rgb=np.asarray(model.rgb, float),
        camera=camera_ahead(),
        blur=PIXEL_BLUR,
    )
    for a, b in zip(reference_jit(model, IDENTITY, camera_ahead()), balls, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("size", [(8, 8), (10, 12)])
def test_gradients_are_those_of_finite_differences(rng, size):
    """By all that a splat has, six of them between 1 and 2 m ahead."""
    with jax.enable_x64(True):
        weight = jnp.asarray(rng.normal(size=(*size, 4)))
        model = splats(
            rng.uniform((1, -0.3, -0.3), (2, 0.3, 0.3), (6, 3)),
            rng.uniform(size=(6, 3)),
            radius=rng.uniform(0.02, 0.12, 6),
            density=rng.uniform(0.5, 3, 6),
        )

        def loss(x):
            rgb, alpha = render_reference(
                dataclasses.replace(model, **x), IDENTITY, camera_ahead(*size)
            )
            return jnp.sum(weight * jnp.concatenate([rgb, alpha[..., None]], axis=-1))

        names = ("mean", "radius", "density", "rgb", "view_color_gradient")
        x = {name: getattr(model, name) for name in names}
        for name, difference, slope in slopes(loss, x, rng):
            np.testing.assert_allclose(
                difference, slope, rtol=DIFFERENCE_TOLERANCE, atol=1e-8, err_msg=name
            )


@jax.jit
@jax.value_and_grad
def brightness(x):
    """Of an image of one splat, by what ``x`` holds."""
    model = dataclasses.replace(splats(jnp.zeros((1, 3))), **x)
    rgb, alpha = render_reference(model, IDENTITY, camera_ahead())
    return jnp.sum(rgb) + jnp.sum(alpha)


@pytest.mark.parametrize("mean", [[-1.0, 0.0, 0.0], [0.0, 0.1, 0.0], [1.0, 30.0, 0.0]])
def test_a_splat_out_of_view_leaves_a_black_image_and_no_gradient(rng, mean):
    model = splats([mean], rng.uniform(size=(1, 3)), radius=0.1)
    names = ("mean", "radius", "density", "rgb", "view_color_gradient")
    value, gradient = brightness({name: getattr(model, name) for name in names})
    assert value == 0.0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0.0)


def test_the_fast_rasterizer_has_the_same_alpha(panda, rng):
    """1 - prod(1 - alpha) = 1 - exp(-sum), also where splats overlap."""
    model = random_splats(panda, 200, rng)
    camera = look_at((1.5, 1.2, 0.9), (0, 0, 0.4), height=40, width=48)
    poses = jax.jit(link_poses)(
        panda.chain, jnp.asarray(rng.uniform(panda.lower, panda.upper), jnp.float32)
    )
    fast, exact = (draw(model, poses, camera)[1] for draw in (render_jit, reference_jit))
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
    fast, _ = render_jit(model, poses, camera_ahead(60, 60))
    exact, alpha = reference_jit(model, poses, camera_ahead(60, 60))
    assert np.all(np.max(exact, axis=(0, 1)) > 0.3)
    clear = np.asarray(alpha) > 0.05  # elsewhere, tails of different splats mix
    np.testing.assert_allclose(fast[clear], exact[clear], atol=1e-4)


def test_soft_occlusion_becomes_true_occlusion_of_dense_splats():
    """A dense splat hides one behind it, the more so the smaller tau is."""
    model = splats(
        [[1.5, 0.0, 0.0], [1.4, 0.0, 0.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        radius=0.1,
        density=20.0,
        shade=0,
    )
    poses, camera = IDENTITY, camera_ahead()
    front = dataclasses.replace(model, density=jnp.array([0.0, 20.0]))
    dense = np.asarray(reference_jit(front, poses, camera)[1]) > 0.9999
    assert dense.sum() > 20
    errors = []
    for tau in (0.1, 0.03, 0.01):
        softer = dataclasses.replace(model, tau=jnp.float32(tau))
        difference = render_jit(softer, poses, camera)[0] - reference_jit(model, poses, camera)[0]
        errors.append(np.abs(difference)[dense].max())
    assert errors[0] > errors[1] > errors[2] and errors[2] < 1e-3
