"""Optimality scores of waypoints."""

import jax
import numpy as np
from nrp_synthetic import random_grid

from nrp_jax import build_world, load_robot
from nrp_jax.learning.optimality import make_queries, optimality
from nrp_jax.learning.roadmap import build_roadmap


def test_scores_of_waypoints():
    """The expert's own waypoint scores 1, one behind a wall 0, one off the way in between."""
    robot = load_robot("snake")
    world = build_world(robot, random_grid(5))
    roadmap = build_roadmap(world, robot, jax.random.key(0), 500)
    queries = make_queries(world, robot, roadmap, 20, seed=0)
    best = np.array(
        [
            np.argmin(np.where(row > 0, row + queries.cost[goal], np.inf))
            for row, goal in zip(
                roadmap.lengths[queries.start].toarray(), queries.goal, strict=True
            )
        ]
    )
    expert = optimality(world, robot, roadmap, queries, roadmap.q[best])
    np.testing.assert_allclose(expert, 1.0, atol=1e-3)
    blocked = roadmap.q[best].copy()
    blocked[:, :2] = -1.0
    np.testing.assert_array_equal(optimality(world, robot, roadmap, queries, blocked), 0.0)
    rng = np.random.default_rng(0)
    aside = roadmap.q[queries.start] + rng.uniform(-0.3, 0.3, (20, 8)).astype(np.float32)
    scores = optimality(world, robot, roadmap, queries, aside)
    assert (scores <= 1).all() and 0 < np.median(scores) < 1
