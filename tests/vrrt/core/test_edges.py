"""Edges: steering, wrapping, lengths."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.core.edges import difference, normalize, steer
from vrrt_jax.core.planners import PLANNERS
from vrrt_jax.scene.closed_form import ClosedFormWorld


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


def test_what_a_distance_vouches_for_is_free(wall_world, free, rng):
    q = rng.uniform(wall_world.lower, wall_world.upper, (400, 7)).astype(np.float32)
    edge = rng.normal(0, 0.3, (400, 7)).astype(np.float32)
    span = np.asarray(
        jax.jit(jax.vmap(ClosedFormWorld.free_span, (None, 0, 0)))(wall_world, q, edge)
    )
    np.testing.assert_array_equal(span >= 0, np.asarray(free(wall_world, q)))
    assert np.median(span[span >= 0]) > 0.02  # worth having
    for share in (-0.99, -0.5, 0.5, 0.99):
        there = q + share * np.maximum(span, 0)[:, None] * edge
        assert np.all(np.asarray(free(wall_world, there.astype(np.float32)))[span >= 0])


def test_steps_are_as_long_in_a_world_with_finer_checks(panda, wall_world):
    finer = dataclasses.replace(wall_world, resolution=wall_world.resolution / 3)
    for planner in PLANNERS.values():
        assert planner.for_world(wall_world).edge_steps == planner().edge_steps
        assert planner.for_world(finer).edge_steps == 3 * planner().edge_steps
    config = vrrt_jax.PlannerConfig()
    coarse, fine = (vrrt_jax.VisualRRT.from_config(config, w) for w in (wall_world, finer))
    assert (coarse.edge_steps, coarse.rewire_steps) == (35, 15)
    assert (fine.edge_steps, fine.rewire_steps) == (105, 45)
