"""Roadmaps: their nodes, their edges, and the shortest paths on them."""

import jax
import numpy as np
import pytest
from nrp_synthetic import between, path_lengths

from nrp_jax import batch_is_free, build_world
from nrp_jax.homes.grid import Grid
from nrp_jax.learning import roadmap as roadmaps
from nrp_jax.learning.roadmap import build_roadmap
from nrp_jax.scene.robots import batch_link_features

NODES = 900  # of the roadmap in conftest.py


def test_roadmap(robot, world, roadmap):
    q, lengths = roadmap.q, roadmap.lengths
    assert 0.5 * NODES < len(q) <= NODES
    assert np.asarray(batch_is_free(world, q)).all()
    assert not np.asarray(batch_is_free(world, roadmap.colliding)).any()
    assert abs(lengths - lengths.T).max() == 0
    a, b = lengths.nonzero()
    assert np.abs(q[a, :2] - q[b, :2]).max() < 2.0
    tips = np.asarray(batch_link_features(robot, q))[:, :, :2]
    assert np.abs(tips[b] - q[a, None, :2]).max() < 2.0
    assert np.isfinite(path_lengths(roadmap, 0)).all()


def test_candidates_are_the_pairs_with_the_least_change_of_posture(robot, world, roadmap):
    everything = roadmaps._neighbors(world, robot, roadmap.q)
    few = roadmaps.CANDIDATES
    try:
        roadmaps.CANDIDATES = 10
        chosen = roadmaps._neighbors(world, robot, roadmap.q)
    finally:
        roadmaps.CANDIDATES = few
    assert len(chosen) == 5 * len(roadmap.q) < len(everything)

    def change(pairs):
        step = between(world, roadmap.q[pairs[:, 0]], roadmap.q[pairs[:, 1]], np.ones(len(pairs)))
        return np.linalg.norm((step - roadmap.q[pairs[:, 0]])[:, 2:], axis=1)

    assert change(chosen).max() <= np.partition(change(everything), len(chosen))[len(chosen)] + 1e-3


def test_a_wall_with_a_door_is_passed_through_the_door(robot):
    occupied = np.zeros((40, 40, 1), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[19:21, :28] = True
    world = build_world(robot, Grid(occupied=occupied))
    roadmap = build_roadmap(world, robot, jax.random.key(1), 600)
    cost = path_lengths(
        roadmap, int(np.argmin(np.linalg.norm(roadmap.q[:, :2] - [3.2, 0.8], axis=1)))
    )
    behind = np.linalg.norm(roadmap.q[:, :2] - [0.8, 0.8], axis=1).argsort()[:5]
    # Around the end of the wall at y = 2.8, there and back.
    assert (cost[behind] > 2 * np.hypot(1.1, 1.8)).all()


def test_a_home_that_is_full(robot):
    world = build_world(robot, Grid(occupied=np.ones((30, 30, 1), bool)))
    with pytest.raises(ValueError, match="only 0 of .* are free"):
        build_roadmap(world, robot, jax.random.key(0), 500)
