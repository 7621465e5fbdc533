"""The Fetch through the whole chain: edges that turn, the expert's rows, the packaged samplers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import free, random_grid

from nrp_jax import batch_is_free, build_world, load_robot, load_sampler, samplers
from nrp_jax.learning import expert
from nrp_jax.learning.edge_check import check_edges
from nrp_jax.learning.roadmap import build_roadmap

NODES = 600


@pytest.fixture(scope="module")
def robot():
    return load_robot("fetch")


@pytest.fixture(scope="module")
def world(robot):
    return build_world(robot, random_grid(2, size=60, height=20, boxes=6))


@pytest.fixture(scope="module")
def roadmap(robot, world):
    return build_roadmap(world, robot, jax.random.key(0), NODES)


# Compiled: operation by operation, curves take seconds.
interpolate = jax.jit(lambda world, q_a, q_b, fraction: world.interpolate(q_a, q_b, fraction))


def measured(world, q_a, q_b):
    """Lengths (n,) and spans (n,) of edges."""
    edge = world.edge(q_a, q_b)
    return world.length(edge), world.span(edge)


def test_edges_as_a_plain_loop_finds_them(world, roadmap, rng):
    pairs = rng.integers(0, len(roadmap.q), (3000, 2))
    near = np.abs(np.diff(roadmap.q[pairs][..., :2], axis=1)).max((1, 2)) < 1.0
    pairs = pairs[near][:60].astype(np.int32)
    length, found = check_edges(world, roadmap.q, pairs)
    start, end = (jnp.asarray(roadmap.q[pairs[:, k]]) for k in (0, 1))
    exact, span = jax.jit(measured)(world, start, end)
    np.testing.assert_allclose(length, exact, rtol=1e-4)
    parts = np.ceil(np.asarray(span) / float(world.resolution) - 1e-4)
    for k, num in enumerate(parts.astype(int)):
        fraction = np.minimum(np.arange(1, 128) / max(num, 1), 1.0).astype(np.float32)
        points = interpolate(world, start[k][None], end[k][None], fraction)
        assert found[k] == bool(np.asarray(batch_is_free(world, points)).all())
    assert 0 < found.sum() < len(pairs)


def test_an_edge_of_the_roadmap_sweeps_nothing(world, roadmap):
    a, b = roadmap.lengths.nonzero()
    chosen = np.random.default_rng(1).choice(len(a), 60, replace=False)
    q_a, q_b = (jnp.asarray(roadmap.q[ends[chosen]])[:, None] for ends in (a, b))
    fine = interpolate(world, q_a, q_b, jnp.linspace(0.0, 1.0, 200)[None])
    ok = free(world, np.asarray(fine).reshape(-1, 11)).reshape(60, 200)
    # Between checks 0.2 m or rad apart a corner may be grazed: not often, and not for long.
    assert ok.all(1).mean() > 0.7
    assert ok.mean() > 0.98


def test_rows(robot, world, roadmap):
    rows = expert.make_rows(world, robot, roadmap, np.random.default_rng(0), 10, 8)
    assert rows.waypoint.shape == (80, 11) and batch_is_free(world, rows.q_start).all()
    best = (rows.waypoint == rows.optimal).all(axis=1)
    assert best.reshape(10, 8).any(axis=1).all()
    np.testing.assert_allclose(rows.ratio[best], 1.0, atol=1e-3)
    assert np.isinf(rows.ratio).any() and (rows.ratio > 0.95).all()


@pytest.mark.parametrize("kind", ["discriminator", "cvae"])
def test_packaged_samplers_know_the_way(kind, world, roadmap, rng):
    """Their first choice, without a look at its edge; and that of the same weights in disorder."""
    trained = load_sampler("fetch", kind, num_edge_checked=1)
    disorder = jax.tree.map(
        lambda leaf: jnp.asarray(rng.permutation(np.ravel(leaf)).reshape(leaf.shape)),
        trained.variables,
    )
    q_from, q_goal = roadmap.q[:128], roadmap.q[128:256]
    nearer, is_free = [], []
    for sampler in (trained, dataclasses.replace(trained, variables=disorder)):
        ends = jnp.asarray(q_from), jnp.asarray(q_goal)
        q = np.asarray(samplers.propose(sampler, world, *ends, jax.random.key(0)))
        assert np.all((q >= world.lower - 1e-5) & (q <= world.upper + 1e-5))
        assert np.abs(q - q_from)[:, :2].max() < 2.6
        left, before = (np.linalg.norm((q_goal - at)[:, :2], axis=1) for at in (q, q_from))
        nearer.append(np.mean(left < before))
        is_free.append(free(world, q).mean())
    assert nearer[0] > 0.75 > 0.6 > nearer[1]
    assert is_free[0] > 0.8 and (kind == "cvae" or is_free[0] > is_free[1] + 0.2)
