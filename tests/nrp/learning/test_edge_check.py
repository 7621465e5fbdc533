"""Edge checks against plain loops."""

import numpy as np
import pytest
from nrp_synthetic import between

from nrp_jax import batch_is_free
from nrp_jax.learning.edge_check import check_edges

TOLERANCE = 1e-4  # of lengths in float32, relative


def test_edges_as_a_plain_loop_finds_them(world, roadmap, rng):
    pairs = rng.integers(0, len(roadmap.q), (4000, 2))
    near = np.abs(np.diff(roadmap.q[pairs][..., :2], axis=1)).max((1, 2)) < 1.0
    pairs = pairs[near][:60].astype(np.int32)
    length, free = check_edges(world, roadmap.q, pairs)
    assert 0 < free.sum() < len(pairs) == 60
    for (a, b), found, far in zip(roadmap.q[pairs], free, length, strict=True):
        step = between(world, a, b, [1.0])[0] - a
        parts = 1
        while np.abs(step).max() / parts > float(world.resolution):
            parts += 1
        points = between(world, a, b, np.arange(1, parts) / parts)
        padded = np.concatenate([points, np.tile(a, (64 - len(points), 1))])
        assert found == bool(np.asarray(batch_is_free(world, padded)).all())
        metric = np.linalg.norm(step[:2]) + 0.167 * np.linalg.norm(step[2:])
        assert far == pytest.approx(metric, rel=TOLERANCE)


def test_edges_are_free_at_finer_steps_too(world, roadmap):
    a, b = roadmap.lengths.nonzero()
    chosen = np.random.default_rng(1).choice(len(a), 100, replace=False)
    fine = [
        between(world, roadmap.q[a[i]], roadmap.q[b[i]], np.linspace(0, 1, 160)) for i in chosen
    ]
    free = np.asarray(batch_is_free(world, np.concatenate(fine).astype(np.float32)))
    # Between checks 0.1 apart a corner may be grazed: rarely.
    assert free.reshape(100, -1).all(1).mean() > 0.85
    assert free.mean() > 0.99
