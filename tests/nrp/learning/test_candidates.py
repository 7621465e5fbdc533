"""Candidates of the discriminator, and what the expert says of them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from nrp_jax.homes.houses import generate_house
from nrp_jax.learning import data, shards
from nrp_jax.learning.batches import load_examples
from nrp_jax.learning.candidates import HALF_WINDOW, make_candidate_rows
from nrp_jax.learning.models import ModelConfig
from nrp_jax.scene.world import batch_is_free

pytestmark = pytest.mark.light_compilation

QUERIES, CANDIDATES = 40, 3


@pytest.fixture(scope="module")
def rows(robot, world, roadmap):
    rng = np.random.default_rng(0)
    return make_candidate_rows(world, robot, roadmap, rng, QUERIES, CANDIDATES)


def test_candidates_are_drawn_as_nrp_d_draws_them_and_judged_by_their_edges(world, rows):
    assert rows.waypoint.shape == (QUERIES * CANDIDATES, 8)
    assert len(np.unique(rows.waypoint, axis=0)) == len(rows.waypoint)
    step = np.abs(rows.waypoint - rows.q_start)[:, :2]
    assert step.max() < HALF_WINDOW + 0.06 and step.max() > 1.8
    # Those that can be reached are free along the whole edge, and most others are not.
    fraction = jnp.linspace(0.0, 1.0, 64)[1:, None, None]
    edge = world.edge(rows.q_start, rows.waypoint)
    along = np.asarray(rows.q_start + fraction * edge).reshape(-1, 8)
    free = np.asarray(batch_is_free(world, along)).reshape(63, -1)
    free, reached = np.all(free, axis=0), np.isfinite(rows.ratio)
    assert 0.2 < reached.mean() < 0.8 and rows.ratio.min() >= 1.0
    assert free[reached].mean() > 0.97 and free[~reached].mean() < 0.1


def test_only_a_discriminator_learns_from_candidates(robot, world, rows):
    columns = {**vars(rows), "home": np.zeros(len(rows.ratio), np.int32)}
    settings = shards.DatasetSettings(task="snake", candidates=True)
    dataset = data.Dataset(settings=settings, grids=[generate_house(3).grid], rows=columns)
    examples = load_examples(ModelConfig.default("snake", "discriminator"), robot, dataset)
    assert examples.q.shape == (QUERIES, 2 + CANDIDATES, 8)
    # Its target is how much nearer to the goal they are, of 2 m: along the edge, less the detour.
    target, ratio = np.asarray(examples.target).reshape(-1), rows.ratio
    edge = np.asarray(world.distance(rows.q_start, rows.waypoint))
    nearer = np.clip((edge - (ratio - 1) * rows.length) / 2, 0, 1)
    np.testing.assert_allclose(np.sort(target), np.sort(nearer), atol=1e-4)
    assert (target[~np.isfinite(ratio)] == 0).all() and target.max() > 0.5
    with pytest.raises(ValueError, match="holds candidates, but a 'cvae' learns from waypoints"):
        load_examples(ModelConfig.default("snake", "cvae"), robot, dataset)
    waypoints = dataclasses.replace(dataset, settings=shards.DatasetSettings(task="snake"))
    assert load_examples(ModelConfig.default("snake", "cvae"), robot, waypoints).q.shape[1] > 2
