"""Local windows against a plain loop over cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nrp_jax.learning import local_map


def with_border(occupied):
    return jnp.asarray(np.pad(occupied, [(20, 20), (20, 20), (0, 0)], constant_values=True))


def test_windows(rng):
    occupied = rng.random((70, 60, 3)) < 0.3
    padded = with_border(occupied)
    q = rng.uniform([0, 0], [7, 6], (200, 2)).astype(np.float32)
    q[:3] = [[0, 0], [7, 6], [0.04, 5.96]]
    windows = np.asarray(jax.vmap(local_map.window, (None, 0))(padded, jnp.asarray(q)))
    centers = np.asarray(local_map.center(jnp.asarray(q)))
    assert windows.shape == (200, 40, 40, 3)
    assert np.abs(centers - q).max() <= 0.0501
    for window, center in zip(windows, centers, strict=True):
        corner = np.round(center * 10).astype(int) - 20
        expected = np.ones((40, 40, 3), bool)
        for i, j in np.ndindex(40, 40):
            x, y = corner[0] + i, corner[1] + j
            if 0 <= x < 70 and 0 <= y < 60:
                expected[i, j] = occupied[x, y]
        assert (window == expected).all()


def test_windows_of_a_map_with_an_origin_and_of_stacked_maps(rng):
    maps = rng.random((2, 50, 50, 1)) < 0.3
    q = jnp.array([1.23, 3.21])
    shifted = local_map.window(with_border(maps[1]), q - jnp.array([2.0, 1.0]), 0.1, (-2.0, -1.0))
    plain = local_map.window(with_border(maps[1]), q)
    stacked = jnp.stack([with_border(m) for m in maps])
    assert (shifted == plain).all()
    assert (local_map.stacked_window(stacked, jnp.int32(1), q) == plain).all()
    moved = local_map.center(q - jnp.array([2.0, 1.0]), 0.1, (-2.0, -1.0))
    assert np.asarray(moved) == pytest.approx([-0.8, 2.2], abs=1e-5)
