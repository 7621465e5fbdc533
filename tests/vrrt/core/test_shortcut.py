"""Shortcutting."""

import jax
import numpy as np
from core_cases import assert_free

from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.shortcut import path_length, prune, shortcut


def test_shortcut_shortens_and_stays_free(wall_world, free, connected):
    path = RRTConnect().extract_path(connected.tree)
    short = shortcut(wall_world, path, key=jax.random.key(0))
    np.testing.assert_allclose(short[[0, -1]], path[[0, -1]], atol=1e-6)
    assert path_length(wall_world, short) < 0.9 * path_length(wall_world, path)
    assert_free(wall_world, free, short)
    np.testing.assert_array_equal(short, shortcut(wall_world, path, key=jax.random.key(0)))
    assert len(shortcut(wall_world, path[:2], key=jax.random.key(0))) == 2


def test_pruning_leaves_few_waypoints_and_no_longer_path(wall_world, free, connected):
    path = RRTConnect().extract_path(connected.tree)
    # Seven places along each edge, as many as anyone drives by.
    shares = np.linspace(0, 1, 8, endpoint=False)[:, None]
    fine = [a + shares * (b - a) for a, b in zip(path, path[1:], strict=False)]
    many = np.concatenate([*fine, path[-1:]]).astype(np.float32)
    few = prune(wall_world, many)
    assert len(few) <= len(path) < len(many)
    np.testing.assert_array_equal(few[[0, -1]], many[[0, -1]])
    assert all(np.any(np.all(waypoint == many, axis=1)) for waypoint in few)
    assert path_length(wall_world, few) <= path_length(wall_world, many) + 1e-4
    assert_free(wall_world, free, few)
    assert len(few) > 2  # the wall is in between
    assert len(prune(wall_world, many[:2])) == 2
