"""The descent that fits spheres to points."""

import numpy as np

from vrrt_jax.robots import sphere_descent


def test_points_are_contained_although_obstacles_push(rng):
    """A sphere in a cage of obstacles shrinks until the points on a ball of 5 cm hold it."""
    directions = rng.normal(size=(600, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    obstacles = 0.095 * directions, np.full(600, 0.04)
    center, radius = sphere_descent.descend(
        np.full((1, 3), 0.01), np.array([0.1]), obstacles, 0.05 * directions, seed=0
    )
    reach = np.linalg.norm(0.05 * directions - center, axis=1).max()
    assert reach < radius[0] + 5e-4 and radius[0] < 0.052


def test_a_sphere_may_begin_on_a_point_that_it_contains(rng, monkeypatch):
    monkeypatch.setattr(sphere_descent, "STEPS", 3)
    points = rng.uniform(-0.1, 0.1, (12, 3))
    center, radius = sphere_descent.descend(
        points[:1], np.array([0.1]), (points + 0.3, np.full(12, 0.04)), points, seed=0
    )
    assert np.isfinite(center).all() and np.isfinite(radius).all()
