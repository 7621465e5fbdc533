"""NEXT's training, by the command, on a few made-up paths; and the network that comes of it."""

import csv
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import random_grid

import nrp_jax
from nrp_jax import online
from nrp_jax.cli import main
from nrp_jax.learning import next_rows
from nrp_jax.learning.batches import describe
from nrp_jax.learning.checkpoint import build_module, load_model
from nrp_jax.learning.data import Dataset
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.recipe import OnlineConfig
from nrp_jax.learning.shards import DatasetSettings
from nrp_jax.online import train_online
from nrp_jax.scene.world import build_world

pytestmark = pytest.mark.light_compilation
STATES, PATHS = 4, 12  # of a path without its ends; of a home
CONFIG = dataclasses.replace(
    ModelConfig.default("snake", "next"), channels=(4, 8), attention=2, latent=4, iterations=2
)
SETTINGS = OnlineConfig(
    epochs=2, batch=40, problems=3, states=5, round_epochs=1, expansions=320, learning_rate=1e-2
)


@pytest.fixture(scope="module")
def robot():
    return nrp_jax.load_robot("snake")


@pytest.fixture(scope="module")
def dataset():
    """Straight lines in homes with few obstacles, as if they were paths."""
    rng = np.random.default_rng(0)
    grids = [random_grid(seed, size=100, boxes=0) for seed in range(3)]
    ends = rng.uniform([1.0] * 2 + [-3.0] * 6, [9.0] * 2 + [3.0] * 6, (36, 2, 8))
    share = np.arange(1, STATES + 1)[:, None, None] / (STATES + 1)
    inner = (ends[:, 0] + share * (ends[:, 1] - ends[:, 0])).transpose(1, 0, 2)
    rows = {
        "q_start": np.repeat(ends[:, 0], STATES, axis=0),
        "q_goal": np.repeat(ends[:, 1], STATES, axis=0),
        "waypoint": inner.reshape(-1, 8),
        "length": np.repeat(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), STATES),
        "ratio": np.ones(36 * STATES),
        "home": np.repeat(np.arange(3), PATHS * STATES),
        "query": np.repeat(np.arange(36), STATES),
    }
    settings = DatasetSettings(task="snake", paths=True, waypoints=STATES)
    return Dataset(settings=settings, grids=grids, rows=rows)


def test_rows_tell_a_step_of_one_length_and_what_is_left(robot, dataset):
    """Against a plain walk along the path; the last steps end at the goal."""
    examples, num = next_rows.path_examples(CONFIG, robot, dataset, room=2)
    assert num == 36 and examples.q.shape == (38, STATES + 2, 8)
    batch = next_rows.path_batch(CONFIG, robot, examples, jnp.arange(36), step=2.0)
    length = np.asarray(examples.length[:36])  # (36, 1)
    left = length * np.arange(STATES + 1, 0, -1) / (STATES + 1)
    np.testing.assert_allclose(batch.value, -left, rtol=1e-5)
    q = np.asarray(examples.q[:36])
    step = q[:, 1:] - q[:, :-1]
    step -= 2 * np.pi * np.round(step / (2 * np.pi)) * np.asarray(robot.is_continuous)
    for path in range(36):
        for state in range(STATES + 1):
            expected, still = 0.0, 2.0
            for between in step[path, state:]:
                share = min(still * (STATES + 1) / length[path, 0], 1.0)
                expected = expected + share * between
                still -= share * length[path, 0] / (STATES + 1)
            np.testing.assert_allclose(batch.action[path, state], expected, atol=1e-5)
    with pytest.raises(ValueError, match="paths of task 'snake'; expected paths of 'fetch'"):
        next_rows.path_examples(ModelConfig.default("fetch", "next"), robot, dataset, room=0)


def test_paths_to_one_goal_stand_together(robot, dataset):
    """They are planned for once; where a goal has fewer, the others weigh nothing."""
    rows = {name: column.copy() for name, column in dataset.rows.items()}
    rows["q_goal"][: 2 * STATES] = rows["q_goal"][0]  # the first two paths
    shared = dataclasses.replace(dataset, rows=rows)
    examples, num = next_rows.path_examples(CONFIG, robot, shared, room=1)
    assert num == 35 and examples.length.shape == (36, 2)
    lengths = np.sort(np.asarray(examples.length[:35]).ravel())
    alone = np.asarray(next_rows.path_examples(CONFIG, robot, dataset, room=0)[0].length).ravel()
    np.testing.assert_allclose(lengths, np.concatenate([np.zeros(34), np.sort(alone)]))
    both = int(np.argmax(examples.length[:, 1]))
    apart = next_rows.path_batch(CONFIG, robot, examples, jnp.arange(35), step=2.0)
    assert np.asarray(apart.weight[both]).all()
    assert np.asarray(apart.weight).sum() == 36 * (STATES + 1)
    q = np.asarray(examples.q[both]).reshape(2, STATES + 2, 8)
    np.testing.assert_array_equal(q[0, -1], q[1, -1])
    np.testing.assert_array_equal(q[0, -1], rows["q_goal"][0].astype(np.float32))


def test_a_path_is_parted_evenly(robot, dataset):
    world = build_world(robot, dataset.grids[0].flatten())
    path = np.zeros((4, 8), np.float32)
    path[:, 0] = [1.0, 2.0, 2.5, 6.0]
    states, length = next_rows.even_states(world, path, 6)
    assert length == pytest.approx(5.0)
    np.testing.assert_allclose(states[:, 0], np.arange(1.0, 6.5), atol=1e-5)


def test_the_published_network_reads_its_plan_at_each_configuration():
    """The answer for a configuration does not depend on the others it is asked with."""
    config = dataclasses.replace(ModelConfig.published("snake", "next"), iterations=2)
    module = build_module(config, 8)
    rng = np.random.default_rng(0)
    image = jnp.asarray(rng.integers(0, 2, (1, 100, 100, 1)), jnp.float32)
    goal, q = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in ((1, 20), (1, 3, 20)))
    variables = jax.jit(module.init)(jax.random.key(0), image, goal, q)
    apply = jax.jit(module.apply, static_argnames="method")
    action, value = apply(variables, image, goal, q)
    plan = apply(variables, image, goal, method="look")
    assert plan.shape == (1, 13 * 13, 8, 8) and action.shape == (1, 3, 8)
    alone = apply(variables, plan, goal, q[:, 1:2], method="read")
    np.testing.assert_allclose(alone[0][0, 0], action[0, 1], atol=1e-5)
    np.testing.assert_allclose(alone[1][0, 0], value[0, 1], atol=1e-5)


@pytest.mark.parametrize("task", ["snake", "fetch"])
def test_the_light_network_sees_how_far_joints_turn_to_the_goal(task):
    robot = nrp_jax.load_robot(task)
    config = ModelConfig.default(task, "next")
    rng = np.random.default_rng(0)
    q = jnp.asarray(rng.uniform(-3.0, 3.0, (1, 2, robot.num_joints)), jnp.float32)
    points = jax.vmap(jax.vmap(lambda q: nrp_jax.link_features(robot, q)))(q)
    seen = describe(config, robot, q, points)
    module = build_module(config, robot.num_joints)
    turns: Any = module.apply({}, seen[:, :1], seen[:, 1:], method="_turns")
    turn = np.asarray(q[0, 1] - q[0, 0])[np.array(robot.angular)]
    np.testing.assert_allclose(turns[0][0, 0], turn, atol=1e-5)
    short = turn - 2 * np.pi * np.round(turn / (2 * np.pi))
    np.testing.assert_allclose(turns[1][0, 0], short, atol=1e-5)


def test_it_learns_from_paths_and_goes_on_where_it_was(
    robot, dataset, tmp_path, monkeypatch, capsys
):
    """Its time is up after one epoch; with more time it goes on, and solves problems."""

    def trained(**changes):
        settings = dataclasses.replace(SETTINGS, **changes)
        model = train_online(CONFIG, robot, dataset, tmp_path, settings=settings, progress=False)
        return model, (tmp_path / "log.csv").read_text().splitlines()

    _, begun = trained(minutes=0.0)
    model, log = trained()
    assert len(begun) == 2 and log[:2] == begun
    rows = list(csv.DictReader(log))
    assert [float(row["problems"]) for row in rows[:2]] == [0, 0]
    assert float(rows[-1]["problems"]) == 3 and float(rows[-1]["paths"]) > 0
    assert float(rows[-1]["train_loss"]) < 0.9 * float(rows[0]["train_loss"])
    kept = load_model(tmp_path)
    assert kept.config == CONFIG and kept.info["last"]["epoch"] == len(rows) - 1
    for a, b in zip(*(jax.tree.leaves(m.variables) for m in (model, kept)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)  # half precision
    # By the command: a folder of another training is refused in one line.
    monkeypatch.setattr(online, "load_dataset", lambda _: dataset)
    monkeypatch.setattr(online, "fingerprint", lambda _: "made up")
    command = ["train", "--task", "snake", "--model", "next", "--data", "none"]
    assert main([*command, "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and "holds a training of another model" in told[0]


def test_exploration_falls_by_tenths():
    shares = [OnlineConfig().explored_in(problem) for problem in (0, 999, 1000, 4500, 8999)]
    assert shares == pytest.approx([1.0, 1.0, 0.9, 0.6, 0.2], abs=1e-6)
