"""Shortcutting."""

import jax
import numpy as np
from core_cases import assert_free

from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.shortcut import path_length, shortcut


def test_shortcut_shortens_and_stays_free(wall_world, free, connected):
    path = RRTConnect().extract_path(connected.tree)
    short = shortcut(wall_world, path, key=jax.random.key(0))
    np.testing.assert_allclose(short[[0, -1]], path[[0, -1]], atol=1e-6)
    assert path_length(wall_world, short) < 0.9 * path_length(wall_world, path)
    assert_free(wall_world, free, short)
    np.testing.assert_array_equal(short, shortcut(wall_world, path, key=jax.random.key(0)))
    assert len(shortcut(wall_world, path[:2], key=jax.random.key(0))) == 2
