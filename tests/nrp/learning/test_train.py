"""Training on a small data set with a real rule behind it."""

import csv
import dataclasses
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import random_grid, synthetic_rows

from nrp_jax.cli import main
from nrp_jax.learning import features
from nrp_jax.learning import train as training
from nrp_jax.learning.batches import load_examples, make_batch, make_examples
from nrp_jax.learning.checkpoint import load_model
from nrp_jax.learning.data import Dataset
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.recipe import TrainConfig, check_settings, make_optimizer
from nrp_jax.learning.shards import DatasetSettings
from nrp_jax.learning.train import split_by_home, train
from nrp_jax.scene.robots import load_robot

SETTINGS = TrainConfig(epochs=16, batch=48, patience=16)
SMALL = {"channels": (16, 32), "context": 64, "width": 32}  # networks that train in seconds


def small_config(kind):
    return dataclasses.replace(ModelConfig.default("snake", kind), **SMALL)


@pytest.fixture(scope="module")
def rows():
    return synthetic_rows(homes=6, queries=80, waypoints=6)


def examples_of(config, rows):
    robot, grids, columns = rows
    good = columns["good"].astype(np.float32)
    if config.kind == "cvae":
        columns = {name: column[good > 0] for name, column in columns.items()}
        good = good[good > 0]
    return robot, make_examples(
        config, robot, grids, columns, target=good, weight=np.ones(len(good))
    )


def test_rows_of_a_query_stay_together(rows):
    config = ModelConfig.default("snake", "cvae")
    robot, examples = examples_of(config, rows)
    columns, good = rows[2], rows[2]["good"]
    assert float(examples.weight.sum()) == good.sum()
    for k in range(0, len(examples.home), 37):
        same = (columns["q_start"] == np.asarray(examples.q[k, 0])).all(1) & good
        kept = np.asarray(examples.q[k, 2:])[np.asarray(examples.weight[k]) > 0]
        np.testing.assert_array_equal(kept, columns["waypoint"][same])


@pytest.mark.light_compilation
def test_large_maps_are_turned_all_alike():
    """With what stands in them, by the same one of eight symmetries."""
    robot, grid = load_robot("fetch"), random_grid(0, size=60, height=20)
    config = ModelConfig.default("fetch", "global-cvae")
    q = np.random.default_rng(0).uniform(1.0, 5.0, (3, 11)).astype(np.float32)
    rows = {"q_start": q, "q_goal": q, "waypoint": q, "home": np.zeros(3), "query": np.arange(3)}
    examples = make_examples(config, robot, [grid], rows, target=np.ones(3), weight=np.ones(3))
    compiled = jax.jit(make_batch, static_argnums=0)
    plain = compiled(config, robot, examples, np.arange(3))
    for seed in range(3):
        turned = compiled(config, robot, examples, np.arange(3), jax.random.key(seed))
        found = []
        for quarter, mirror in itertools.product(range(4), (False, True)):
            image = features.turn_image(plain.image[0], jnp.int32(quarter), jnp.bool_(mirror))
            if np.array_equal(image, turned.image[0]):
                found.append((quarter, mirror))
        (quarter, mirror), sign = found[0], 1 - 2 * found[0][1]
        assert len(found) == 1 and np.array_equal(turned.image[1], turned.image[0])
        place = np.asarray(plain.start[:, :2]) * [1, sign]
        for _ in range(quarter):
            place = np.stack([-place[:, 1], place[:, 0]], axis=1)
        np.testing.assert_allclose(turned.start[:, :2], place, atol=1e-5)


def test_homes_are_held_out_whole():
    home = np.repeat(np.arange(20), 7)
    training, validation = split_by_home(home, SETTINGS)
    assert not set(home[training]) & set(home[validation])
    assert len(set(home[validation])) == 3 and len(training) + len(validation) == len(home)
    with pytest.raises(ValueError, match="of one home"):
        split_by_home(np.zeros(5), SETTINGS)


def test_the_discriminator_learns_and_goes_on_after_a_kill(rows, tmp_path, monkeypatch, capsys):
    """It learns what is free in unseen homes; a killed run ends as an unbroken one."""
    config = small_config("discriminator")
    robot, examples = examples_of(config, rows)
    model = train(config, robot, examples, tmp_path / "a", settings=SETTINGS, progress=False)
    assert model.info["best"]["quality"] > 0.85
    with open(tmp_path / "a" / "log.csv") as handle:
        log = list(csv.DictReader(handle))
    assert [int(row["epoch"]) for row in log] == list(range(16))
    assert (tmp_path / "a" / "curves.png").stat().st_size > 5000

    def without_matplotlib(*_):
        raise ModuleNotFoundError("No module named 'matplotlib'")

    monkeypatch.setattr(training, "plot_curves", without_matplotlib)
    same = train(config, robot, examples, tmp_path / "a", settings=SETTINGS, progress=False)
    assert same.info["best"] == model.info["best"] and "no curves" in capsys.readouterr().err

    # The same in a process of its own, which is killed while it trains.
    process = subprocess.Popen(
        [sys.executable, __file__, tmp_path / "b"],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(sys.path),
            "JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir),
        },
    )
    deadline = time.monotonic() + 200
    while not (tmp_path / "b" / "log.csv").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert load_model(tmp_path / "b").config == config
    again = train(config, robot, examples, tmp_path / "b", settings=SETTINGS, progress=False)
    assert again.info["best"]["epoch"] == model.info["best"]["epoch"]
    for a, b in zip(*(jax.tree.leaves(m.variables) for m in (model, again)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
    with pytest.raises(ValueError, match="holds a training of another model"):
        train(config, robot, examples, tmp_path / "a", settings=TrainConfig(), progress=False)


def test_a_diverged_training_keeps_the_best_epoch(rows, tmp_path, monkeypatch):
    config = small_config("discriminator")
    robot, examples = examples_of(config, rows)
    losses = iter([0.5, 0.4, np.nan])
    monkeypatch.setattr(training, "validate", lambda *_: {"loss": next(losses), "quality": 0.5})
    with pytest.raises(RuntimeError, match="diverged in epoch 2: .* lower --learning-rate"):
        train(config, robot, examples, tmp_path, settings=SETTINGS, progress=False)
    assert load_model(tmp_path).info["best"]["epoch"] == 1
    assert len((tmp_path / "log.csv").read_text().splitlines()) == 3
    assert not (tmp_path / "checkpoint" / "3").exists()


def test_the_generator_learns(rows, tmp_path):
    # Without the term for obstacles, so that all that it learns is what waypoints are like.
    config = dataclasses.replace(small_config("cvae"), context=96, width=96, blocked_weight=0.0)
    robot, examples = examples_of(config, rows)
    settings = dataclasses.replace(SETTINGS, epochs=24, learning_rate=8e-3)
    model = train(config, robot, examples, tmp_path, settings=settings, progress=False)
    compiled = jax.jit(make_batch, static_argnums=0)
    batch = compiled(config, robot, examples, np.arange(len(examples.home)))
    spread = np.asarray(batch.waypoints)[np.asarray(batch.weight) > 0].var(axis=0).mean()
    assert -model.info["best"]["quality"] < 0.9 * spread


@pytest.mark.light_compilation
def test_the_published_recipe_trains_by_the_command(tmp_path, monkeypatch, rows):
    """Its settings are those of the paper's code; options overrule them."""
    columns = {**rows[2], "ratio": np.where(rows[2]["good"], 1.0, np.inf)}
    dataset = Dataset(settings=DatasetSettings(task="snake"), grids=rows[1], rows=columns)
    monkeypatch.setattr(training, "load_dataset", lambda _: dataset)
    monkeypatch.setattr(training, "fingerprint", lambda _: "synthetic")
    command = ["train", "--task", "snake", "--model", "discriminator", "--data", "none"]
    command += ["--architecture", "published", "--epochs", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    assert load_model(tmp_path).config == ModelConfig.published("snake", "discriminator")
    settings = json.loads((tmp_path / "training.json").read_text())["settings"]
    assert settings["epochs"] == 1 and settings["batch"] == 16 and settings["plateau"] == 5000
    assert settings["learning_rate"] == 1e-3 and settings["weight_decay"] == 5e-4
    assert not settings["augment"] and settings["patience"] == 50
    model = load_model(tmp_path)
    assert model.info["data"].endswith("soft False")
    assert "batch_stats" in model.variables and model.info["best"]["quality"] > 0.5
    assert TrainConfig.published("fetch", "cvae").epochs == 100
    with pytest.raises(ValueError, match="unknown task 'panda'"):
        TrainConfig.published("panda", "cvae")


def test_the_rate_halves_on_a_plateau():
    settings = dataclasses.replace(TrainConfig.published("snake", "cvae"), plateau=3)
    optimizer = make_optimizer(settings, steps=100)
    params = {"w": np.ones(1, np.float32)}
    state, sizes = optimizer.init(params), []
    for _ in range(8):
        update, state = optimizer.update(params, state, params, value=1.0)
        sizes.append(-np.asarray(jax.tree.leaves(update)[0]).item())
    assert sizes[0] == pytest.approx(1e-3, rel=1e-3)
    assert sizes[-1] == pytest.approx(sizes[0] / 4, rel=1e-2)


def test_settings_and_data_of_another_task_are_refused():
    with pytest.raises(ValueError, match="epochs is 0; expected 1 to"):
        check_settings(TrainConfig(epochs=0))

    class Other:
        settings = type("Settings", (), {"task": "fetch"})

    with pytest.raises(ValueError, match="data set is of task 'fetch', the model of 'snake'"):
        load_examples(ModelConfig.default("snake", "cvae"), None, Other())  # type: ignore


if __name__ == "__main__":
    config = small_config("discriminator")
    found = examples_of(config, synthetic_rows(homes=6, queries=80, waypoints=6))
    train(config, *found, Path(sys.argv[1]), settings=SETTINGS, progress=False)
