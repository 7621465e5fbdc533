"""FIRE's experiences: parts and entries by hand, a network that learns, and files."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.cli import main
from nrp_jax.homes.grid import Grid
from nrp_jax.learning.data import Dataset
from nrp_jax.learning.experience_database import load_database
from nrp_jax.learning.primitives import (
    SIDE,
    STRIDE,
    cells_of_parts,
    corners_of_parts,
    make_entries,
    make_pairs,
    middles,
    query_features,
)
from nrp_jax.learning.shards import DatasetSettings
from nrp_jax.learning.similarity import (
    LATENT,
    MARGIN,
    Convolution,
    FireSettings,
    contrastive_loss,
    cut,
    train_fire,
)

pytestmark = pytest.mark.light_compilation
REST = [0.1, 1.3, 1.4, -0.2, 1.7, 0.0, 1.6, 0.0]


@pytest.fixture(scope="module")
def fetch():
    return nrp_jax.load_robot("fetch")


def home(boxed):
    """A room of 3 by 2.5 m, perhaps with a box in its corner."""
    occupied = np.zeros((30, 25, 20), bool)
    occupied[:8, :8] = boxed
    return Grid(occupied=occupied)


@pytest.fixture(scope="module")
def dataset():
    """Three homes in each of which samples stand in the same places; a box is in one of them."""
    places = np.array([[2.0, 1.2, 0.0], [0.9, 0.9, 0.3], [0.5, 0.5, 0.0]])
    waypoint = np.concatenate([places, np.tile(REST, (3, 1))], axis=1).astype(np.float32)
    rows = {
        "q_start": waypoint[[0] * 9],
        "q_goal": waypoint[[1] * 9],
        "waypoint": np.tile(waypoint, (3, 1)),
        "home": np.repeat(np.arange(3, dtype=np.int32), 3),
        "ratio": np.ones(9),
    }
    settings = DatasetSettings(task="fetch", experiences=True)
    return Dataset(settings=settings, grids=[home(False), home(True), home(False)], rows=rows)


@pytest.fixture(scope="module")
def entries(dataset):
    return make_entries(dataset)


def test_parts_overlap_and_are_full():
    cells = cells_of_parts(home(False).occupied)
    assert cells.shape == (30, 25, SIDE)
    np.testing.assert_array_equal(
        corners_of_parts(cells.shape),
        [[x, y] for x in (0, STRIDE, 2 * STRIDE) for y in (0, STRIDE)],
    )
    # What a small map lacks is solid, what is above a low one is not.
    small = cells_of_parts(np.zeros((12, 22, 15), bool))
    assert small.shape == (SIDE, 25, SIDE) and not small[:12, :22].any()
    assert small[12:, :, :15].all() and small[:, 22:, :15].all()
    part = cut(
        jnp.asarray(cells_of_parts(home(True).occupied))[None], *map(jnp.asarray, ([0], [[5, 5]]))
    )
    assert part.shape == (1, SIDE, SIDE, SIDE)
    assert part[0, :3, :3].all() and not part[0, 3:].any() and not part[0, :, 3:].any()


def test_entries_are_seen_from_the_parts_that_have_them_in_their_middle(dataset, entries):
    # Two of each home: no part has its middle nearer than 1 m to a wall.
    np.testing.assert_array_equal(entries.home, [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(entries.corner, [[10, 0], [0, 0]] * 3)
    np.testing.assert_allclose(entries.sample[:2, :2], [[0.0, 0.2], [-0.1, -0.1]], atol=1e-5)
    shift = middles(entries.corner, 0.1)
    np.testing.assert_allclose(entries.start[:, :2] + shift, [[2.0, 1.2]] * 6, atol=1e-5)
    np.testing.assert_allclose(entries.goal[:, :2] + shift, [[0.9, 0.9]] * 6, atol=1e-5)
    np.testing.assert_array_equal(entries.sample[0, 2:], dataset.rows["waypoint"][0, 2:])


def test_alike_are_samples_that_would_do_for_each_other(fetch, dataset, entries):
    pairs = make_pairs(fetch, dataset.grids, entries, np.random.default_rng(0), 60)
    assert 0 < pairs.alike.sum() == len(pairs.alike) / 2
    homes = entries.home[pairs.index]
    assert np.all(homes[:, 0] != homes[:, 1])
    # In the middle of the part with the box only what stands a little aside is free.
    is_boxed = (entries.home == 1) & (entries.corner[:, 0] == 0)
    is_there = entries.sample[:, 1] < 0
    blocked = is_boxed[pairs.index].any(axis=1) & is_there[pairs.index].all(axis=1)
    np.testing.assert_array_equal(pairs.alike, ~blocked)
    for wrong, words in ((entries.home == 0, "of one home"), (~is_boxed, "are alike; expected")):
        with pytest.raises(ValueError, match=words):
            make_pairs(fetch, dataset.grids, entries[wrong], np.random.default_rng(0), 8)


@pytest.mark.parametrize("side, stride", [(20, 2), (10, 2), (5, 1)])
def test_convolutions_are_those_of_flax(side, stride):
    x = jax.random.normal(jax.random.key(0), (2, side, side, side, 3))
    ours, flax = Convolution(stride), nn.Conv(16, (3, 3, 3), stride)
    variables = flax.init(jax.random.key(1), x)
    kernel = variables["params"]["kernel"].reshape(-1, 16)
    found = ours.apply({"params": {**variables["params"], "kernel": kernel}}, x)
    np.testing.assert_allclose(found, flax.apply(variables, x), atol=1e-5)


def test_the_loss_draws_together_and_drives_apart_up_to_the_margin():
    latents = jnp.zeros((2, 3, LATENT)).at[1, :, 0].set(jnp.array([0.3, 0.3, 2.0]))
    alike = jnp.array([True, False, False])
    expected = (0.3**2 + (MARGIN - 0.3) ** 2 + 0.0) / 3
    assert float(contrastive_loss(latents, alike)) == pytest.approx(expected, rel=1e-5)


def test_far_goals_are_moved_nearer(fetch):
    q = np.zeros((2, 11))
    q[1, :2] = [30.0, 40.0]
    features = query_features(fetch, q, q[::-1])
    half = features.shape[1] // 2
    np.testing.assert_allclose(features[1, :2], [3.6, 4.8], atol=1e-5)
    np.testing.assert_array_equal(features[0, :half], features[1, half:])


def test_a_training_goes_on_and_its_database_is_read(fetch, dataset, entries, tmp_path, capsys):
    shared = {
        "settings": FireSettings(epochs=3, batch=8, pairs=400),
        "stamp": "x",
        "progress": False,
    }
    database = train_fire(fetch, dataset.grids, entries, tmp_path / "whole", **shared)
    losses = [
        float(line.split(",")[1]) for line in (tmp_path / "whole/log.csv").read_text().split()[1:]
    ]
    assert len(losses) == 3 and losses[-1] < losses[0]
    again = train_fire(fetch, dataset.grids, entries, tmp_path / "whole", **shared)
    np.testing.assert_array_equal(again.latents, database.latents)
    read = load_database(tmp_path / "whole", "fetch")
    assert read.samples.shape == (len(entries), 11) and read.latents.shape[1] == LATENT
    np.testing.assert_allclose(read.latents, database.latents, atol=2e-2)
    np.testing.assert_allclose(read.samples, entries.sample, atol=2e-3)
    assert read.info["homes"] == 3 and read.info["entries"] == len(entries)
    with pytest.raises(ValueError, match="another folder"):
        train_fire(fetch, dataset.grids, entries, tmp_path / "whole", **{**shared, "stamp": "y"})
    # What is no such database is refused, in one line.
    with pytest.raises(ValueError, match="is a database of 'fetch'; expected one of 'snake'"):
        load_database(tmp_path / "whole", "snake")
    for name, words in (("nothing", "no database at"), ("log.csv", "is not a readable database")):
        with pytest.raises(ValueError, match=words):
            load_database(tmp_path / "whole" / name, "fetch")
    weights = nrp_jax.samplers.__file__.replace("samplers.py", "weights/fetch_cvae.npz")
    with pytest.raises(ValueError, match="not a readable database of this version .*make it again"):
        load_database(weights, "fetch")


def test_other_data_are_refused(tmp_path, capsys):
    command = ["data", "--task", "snake", "--out", str(tmp_path / "data"), "--paths"]
    assert main([*command, "--experiences"]) == 2
    assert "not allowed with argument --paths" in capsys.readouterr().err
