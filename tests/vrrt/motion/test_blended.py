"""Blends stay near corners, are smooth, and are driven within limits."""

import numpy as np
import pytest

from vrrt_jax.motion.blended import speed_profile, widest_blends
from vrrt_jax.motion.limits import MotionLimits
from vrrt_jax.motion.profile import positions_at

LIMITS = MotionLimits(
    velocity=np.array([1.0, 2.0, 0.5]),
    acceleration=np.array([2.0, 1.0, 3.0]),
    jerk=np.array([30.0, 10.0, 20.0]),
)


def random_path(seed, waypoints):
    return np.random.default_rng(seed).uniform(-1, 1, (waypoints, 3))


@pytest.mark.parametrize("tolerance", [0.0, 0.01, 0.2])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_motion_keeps_limits_of_velocity_acceleration_and_jerk(seed, tolerance):
    path = widest_blends(random_path(seed, 9), tolerance)
    phases = speed_profile(path, LIMITS)
    duration = sum(t for t, _ in phases)
    s, v, a, j = (row[:, None] for row in positions_at(phases, np.linspace(0, duration, 20_001)))
    q, d1, d2, d3 = path.derivatives(s[:, 0])
    np.testing.assert_allclose(q[[0, -1]], path.waypoints[[0, -1]], atol=1e-9)
    motion = d1 * v, d2 * v**2 + d1 * a, d3 * v**3 + 3 * d2 * v * a + d1 * j
    shares = [np.abs(m / own).max() for m, own in zip(motion, vars(LIMITS).values(), strict=True)]
    assert max(shares) < 1 + 1e-6
    # Some joint is at its velocity or at its acceleration limit now and then.
    assert max(shares[:2]) > 0.999
    # The velocity is the derivative of the position.
    velocity = np.gradient(q, duration / 20_000, axis=0)
    np.testing.assert_allclose(velocity[1:-1], motion[0][1:-1], atol=2e-3)


def test_blends_are_as_deep_as_told_and_smooth():
    waypoints = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    path = widest_blends(waypoints, 0.05)
    (middle, *_), at = path.derivatives(np.array([1.0]))[:, 0], path.corners[0]
    assert np.linalg.norm(middle - waypoints[1]) == pytest.approx(0.05)
    assert path.deviations == pytest.approx([0.05])
    for side in (-1, 1):
        end = at + side * path.half_width[0]
        inside, outside = np.moveaxis(path.derivatives(end + side * np.array([-1e-9, 1e-9])), 1, 0)
        np.testing.assert_allclose(inside[:3], outside[:3], atol=1e-6)


def test_a_wide_blend_leaves_room_on_short_segments():
    path = widest_blends(np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]]), 10.0)
    assert (path.half_width[0] + path.half_width[1]) < 0.1
