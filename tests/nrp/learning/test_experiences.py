"""Experiences: corners of paths that shortcuts have shortened, on the roadmap that tests share."""

import numpy as np
import pytest
from nrp_synthetic import free

from nrp_jax.learning.experiences import make_experience_rows

pytestmark = pytest.mark.light_compilation
QUERIES, MOST = 10, 3


def test_experiences_are_corners_of_shortened_paths(robot, world, roadmap):
    rows = make_experience_rows(world, robot, roadmap, np.random.default_rng(0), QUERIES, MOST)
    assert 0 < np.bincount(rows.query).max() <= MOST and rows.query.max() < QUERIES
    assert free(world, rows.waypoint).all() and np.all(rows.ratio == 1)
    assert rows.waypoint.shape == rows.optimal.shape == rows.q_start.shape
    # No path is shorter along the floor than the straight lines by way of its corner.
    legs = rows.waypoint - rows.q_start, rows.q_goal - rows.waypoint
    least = sum(np.linalg.norm(leg[:, :2], axis=1) for leg in legs)
    assert np.all(rows.length >= least - 1e-3)
