"""Edges: steering, wrapping, free prefixes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_cases import GOAL, START

import vrrt_jax
from vrrt_jax.core.edges import difference, free_prefix, normalize, steer
from vrrt_jax.core.planners import PLANNERS


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


def test_steps_are_as_long_in_a_world_with_finer_checks(panda, wall_world):
    finer = dataclasses.replace(wall_world, resolution=wall_world.resolution / 3)
    for planner in PLANNERS.values():
        assert planner.for_world(wall_world).edge_steps == planner().edge_steps
        assert planner.for_world(finer).edge_steps == 3 * planner().edge_steps
    config = vrrt_jax.PlannerConfig()
    coarse, fine = (vrrt_jax.VisualRRT.from_config(config, w) for w in (wall_world, finer))
    assert (coarse.edge_steps, coarse.rewire_steps) == (6, 15)
    assert (fine.edge_steps, fine.rewire_steps) == (18, 45)
