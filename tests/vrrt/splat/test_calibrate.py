"""Thresholds of a self-model: what decides them."""

import numpy as np
import pytest

from vrrt_jax.splat import calibrate


def test_a_threshold_holds_in_the_hardest_condition():
    easy, hard = np.linspace(0.0, 1.0, 101), np.linspace(0.0, 2.0, 101)
    assert calibrate._threshold({"easy": list(easy), "hard": list(hard)}) == pytest.approx(1.9)


def test_lamps_shine_downwards(rng):
    directions = np.array([calibrate._downwards(rng) for _ in range(50)])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert directions[:, 2].max() <= 0 and np.ptp(directions[:, 0]) > 1
