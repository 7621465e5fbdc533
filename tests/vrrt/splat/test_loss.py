"""The loss of images in any light: what it does not see, what it sees, and its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vrrt_jax.core.precision import double_precision
from vrrt_jax.splat.loss import block_means, relit, weighted, weighted_goal
from vrrt_jax.splat.types import GoalImage

pytestmark = pytest.mark.light_compilation

SIZE = (12, 16)


def image(rng):
    """A disk in random colors: rgb (H, W, 3) over black and alpha (H, W)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    alpha = np.clip(5.0 - np.hypot(y - 6, x - rng.uniform(6, 10)), 0.0, 1.0)
    return rng.uniform(0.2, 0.9, (*SIZE, 3)) * alpha[..., None], alpha


@jax.jit
def loss(rgb, alpha, goal):
    return jnp.sum((weighted(rgb, alpha, goal) - weighted_goal(goal)) ** 2)


def goal_of(rgb, alpha, valid=None):
    valid = np.ones_like(alpha) if valid is None else valid
    return jax.tree.map(
        lambda a: jnp.asarray(a, jnp.float32)[None], GoalImage(rgb=rgb, alpha=alpha, valid=valid)
    )


@pytest.mark.parametrize(
    "gain", [(1.0, 1.0, 1.0), (0.4, 0.4, 0.4), (0.5, 0.7, 0.9), (2.5, 2.5, 2.5)]
)
def test_brightness_and_tint_of_the_light_do_not_matter(rng, gain):
    """Nor does white, where the picture is overexposed."""
    (rgb, alpha), other = image(rng), image(rng)
    lit = np.minimum(rgb * gain, alpha[..., None])
    at_goal = loss(rgb[None], alpha[None], goal_of(lit, alpha))
    elsewhere = loss(other[0][None], other[1][None], goal_of(lit, alpha))
    assert float(at_goal) < 1e-4 * float(elsewhere)


def test_errors_of_color_are_relative_to_the_goal(rng):
    """So that one threshold serves a goal in any light."""
    (rgb, alpha), (painted, _) = image(rng), image(rng)
    painted = painted.mean(axis=(0, 1)) * alpha[..., None]
    bright, dark = (
        float(loss(painted[None], alpha[None], goal_of(light * rgb, alpha))) for light in (1.0, 0.5)
    )
    assert bright > 1e-4 and dark == pytest.approx(bright, rel=0.05)


def test_unknown_pixels_tell_no_light(rng):
    rgb, alpha = image(rng)
    valid = np.ones_like(alpha)
    valid[:, ::2] = 0
    spoiled = np.where(valid[..., None] > 0, 0.6 * rgb, 0.9 * alpha[..., None])
    assert float(loss(rgb[None], alpha[None], goal_of(spoiled, alpha, valid))) < 1e-6


def test_nothing_in_common_is_no_match(rng):
    """Without a common pixel there is no gain to be told, and no NaN."""
    rgb, alpha = image(rng)
    goal = goal_of(rgb, alpha)
    value, slope = jax.value_and_grad(loss)(jnp.zeros((1, *SIZE, 3)), jnp.zeros((1, *SIZE)), goal)
    covered = float(jnp.mean(goal.alpha**2))
    assert float(value) > 0.25 * covered and np.isfinite(slope).all()


def test_gradients_go_through_the_gains(rng):
    with double_precision():
        rgb, alpha = image(rng)
        other, _ = image(rng)
        inputs = jnp.asarray(rgb), jnp.asarray(0.9 * alpha + 0.05)
        goal = jnp.asarray(other), jnp.asarray(alpha), jnp.ones(SIZE)

        def squares(t):
            moved = inputs[0] + t * step[0], inputs[1] + t * step[1]
            return jnp.sum((relit(*moved, *goal) - goal[0]) ** 2)

        step = tuple(jnp.asarray(rng.normal(size=a.shape)) for a in inputs)
        slope = jax.grad(squares)(0.0)
        difference = (squares(1e-6) - squares(-1e-6)) / 2e-6
        assert float(slope) == pytest.approx(float(difference), rel=1e-6)


def test_block_means_are_those_of_overlapping_blocks(rng):
    """Beyond the border there is nothing; a smooth image keeps its squared length."""
    picture = rng.uniform(size=(2, 10, 14, 4)).astype(np.float32)
    found = np.asarray(block_means(jnp.asarray(picture), (4,))).reshape(2, 6, 8, 4)
    padded = np.pad(picture, [(0, 0), (2, 2), (2, 2), (0, 0)])
    for row, column in [(0, 0), (1, 1), (3, 6), (5, 7)]:
        block = padded[:, 2 * row : 2 * row + 4, 2 * column : 2 * column + 4]
        np.testing.assert_allclose(
            found[:, row, column], block.mean(axis=(1, 2)) * 4 / 2, rtol=1e-5
        )
    y, x = np.mgrid[:32, :32]
    smooth = np.exp(-((y - 15) ** 2 + (x - 16) ** 2) / 50.0)[None, ..., None].astype(np.float32)
    means = np.asarray(block_means(jnp.asarray(smooth), (2, 4)))
    assert np.sum(means**2) == pytest.approx(np.sum(smooth**2), rel=0.05)
