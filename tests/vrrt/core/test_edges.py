"""Edges: steering, wrapping, free prefixes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_cases import GOAL, START

import vrrt_jax
from vrrt_jax.core.edge_checks import first_free_edge, free_prefix, is_edge_free
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


def test_free_steps_counts_the_leading_free_ones(wall_world, free):
    points = START + np.linspace(0, 1, 65)[1:, None] * (GOAL - START)
    is_free = np.asarray(free(wall_world, points.astype(np.float32)))
    assert not is_free.all() and is_free[0]
    start, goal = jnp.asarray(START)[None], jnp.asarray(GOAL)[None]
    edge = wall_world.edge(start, goal)
    count, _ = jax.jit(free_prefix, static_argnums=3)(wall_world, start, edge, 64)
    assert int(count[0]) == int(np.argmin(is_free))


class Counted(ClosedFormWorld):
    """An ``is_free`` of one's own, so that no distance vouches for what was not looked at."""

    def is_free(self, q):
        return super().is_free(q)


@pytest.mark.parametrize("kind", [ClosedFormWorld, Counted])
@pytest.mark.parametrize(("num_steps", "length"), [(6, 0.12), (37, 0.7), (96, 3.0)])
def test_few_checks_find_what_all_find(wall_world, free, rng, kind, num_steps, length):
    world, step = kind(**vars(wall_world)), rng.normal(size=(40, 7))
    edge = (length * step / np.linalg.norm(step, axis=1, keepdims=True)).astype(np.float32)
    start = rng.uniform(wall_world.lower, wall_world.upper, (4000, 7)).astype(np.float32)
    start = start[np.asarray(free(wall_world, start))][:40]
    points = start[:, None] + edge[:, None] * np.arange(1, num_steps + 1)[:, None] / num_steps
    is_free = np.asarray(free(wall_world, points.reshape(-1, 7).astype(np.float32)))
    is_free = is_free.reshape(40, num_steps)
    whole = is_free.all(axis=1)
    assert 2 < whole.sum() < 40

    @jax.jit
    def ask(world, start, edge, tried):
        return (
            free_prefix(world, start, edge, num_steps),
            is_edge_free(world, start, edge, num_steps),
            first_free_edge(world, start, edge, num_steps, tried),
        )

    ends_free = is_free[:, -1]
    (prefix, checked), (free_whole, checked_whole), first = ask(world, start, edge, ends_free)
    # At least one check for each edge, unless distances vouch; never one twice.
    assert 40 <= int(checked_whole) <= int(checked) <= 40 * num_steps
    np.testing.assert_array_equal(prefix, np.cumprod(is_free, axis=1).sum(axis=1))
    np.testing.assert_array_equal(free_whole, whole)
    assert int(first) == int(np.argmax(whole))
    assert int(ask(world, start, edge, ends_free & ~whole)[2]) == 40


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
