"""Edges: steering, wrapping, free prefixes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_cases import GOAL, START

from vrrt_jax.core.edges import difference, free_prefix, normalize, steer


def test_steering_respects_limits_length_and_wrapping(panda, wall_world):
    q, far = jnp.asarray(panda.home, jnp.float32), jnp.full(7, 10.0)
    step = steer(wall_world, q, far, jnp.float32(0.3))
    assert float(jnp.linalg.norm(step)) == pytest.approx(0.3, abs=1e-5)
    assert np.all(np.asarray(q + steer(wall_world, q, far, jnp.float32(1e3))) <= panda.upper + 1e-5)
    turning = dataclasses.replace(wall_world, is_continuous=jnp.ones(7, bool))
    across = difference(turning, jnp.full(7, 3.0), jnp.full(7, -3.0))
    np.testing.assert_allclose(across, 2 * np.pi - 6.0, atol=1e-5)
    np.testing.assert_allclose(normalize(turning, jnp.full(7, 3.3)), 3.3 - 2 * np.pi, atol=1e-5)
    np.testing.assert_allclose(normalize(wall_world, jnp.full(7, 3.3)), 3.3)


def test_free_steps_counts_the_leading_free_ones(wall_world, free):
    points = START + np.linspace(0, 1, 65)[1:, None] * (GOAL - START)
    is_free = np.asarray(free(wall_world, points.astype(np.float32)))
    assert not is_free.all() and is_free[0]
    start, goal = jnp.asarray(START)[None], jnp.asarray(GOAL)[None]
    edge = wall_world.edge(start, goal)
    count = jax.jit(free_prefix, static_argnums=3)(wall_world, start, edge, 64)
    assert int(count[0]) == int(np.argmin(is_free))
