"""Motion along a line keeps its limits, arrives, and is as quick as it can be."""

import numpy as np
import pytest

from vrrt_jax.motion.profile import change_length, positions_at, straight

LIMITS = 2.0, 3.0, 20.0  # velocity, acceleration, jerk


def run(length, v_from, v_to):
    phases = straight(length, v_from, v_to, *LIMITS)
    duration = sum(t for t, _ in phases)
    return duration, positions_at(phases, np.linspace(0, duration, 5001))


@pytest.mark.parametrize("length", [1e-6, 0.01, 0.3, 1.0, 10.0])
def test_a_motion_arrives_at_rest_within_its_limits(length):
    duration, (s, v, a, j) = run(length, 0.0, 0.0)
    assert s[-1] == pytest.approx(length) and abs(v[-1]) < 1e-6 and abs(a[-1]) < 1e-6
    for values, limit in zip((v, a, j), LIMITS, strict=True):
        assert np.abs(values).max() <= limit * (1 + 1e-9)
    # The derivatives are those of the position.
    np.testing.assert_allclose(np.gradient(s, duration / 5000)[1:-1], v[1:-1], atol=1e-3 * v.max())


def test_long_and_short_motions_take_the_times_of_the_textbook():
    v, a, j = LIMITS
    assert run(10.0, 0.0, 0.0)[0] == pytest.approx(10.0 / v + v / a + a / j)
    # Too short for the largest acceleration: four phases of equal time, s = 2 j t^3.
    assert run(0.001, 0.0, 0.0)[0] == pytest.approx(4 * np.cbrt(0.001 / (2 * j)))


def test_a_change_of_speed_just_fits():
    v, a, j = LIMITS
    length = change_length(0.5, 1.5, a, j)
    phases = straight(length, 0.5, 1.5, v, a, j)
    assert sum(t for t, _ in phases) == pytest.approx(1.0 / a + a / j)
