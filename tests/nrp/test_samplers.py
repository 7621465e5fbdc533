"""The samplers as planners use them, with random weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import free, random_grid

from nrp_jax import samplers
from nrp_jax.learning.batches import empty_batch, make_examples
from nrp_jax.learning.checkpoint import Model, build_module, save_model
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.objective import init
from nrp_jax.scene.robots import load_robot
from nrp_jax.scene.world import build_world, with_grid

pytestmark = pytest.mark.light_compilation


def random_model(kind: str, seed: int = 0) -> Model:
    robot, config = load_robot("snake"), ModelConfig.default("snake", kind)
    q = np.full((1, 8), 2.0, np.float32)
    rows = {"q_start": q, "q_goal": q, "waypoint": q, "home": np.zeros(1), "query": np.zeros(1)}
    grid = random_grid(0)
    examples = make_examples(config, robot, [grid], rows, target=np.ones(1), weight=np.ones(1))
    batch = empty_batch(config, robot, examples)
    outputs = batch.waypoints.shape[-1]
    variables = init(config, build_module(config, outputs), batch, jax.random.key(seed))
    return Model(config=config, variables=variables, info={"num_outputs": outputs})


@pytest.fixture(scope="module")
def models():
    return {kind: random_model(kind) for kind in ("discriminator", "cvae")}


@pytest.fixture(scope="module")
def world():
    return build_world(load_robot("snake"), random_grid(5))


@pytest.fixture(scope="module")
def ends(world):
    rng = np.random.default_rng(0)
    q = rng.uniform(world.lower, world.upper, (4096, 8)).astype(np.float32)
    q = q[free(world, q)]
    return jnp.asarray(q[:32]), jnp.asarray(q[32:64])


@pytest.mark.parametrize("kind", ["discriminator", "cvae"])
def test_waypoints_are_near_and_inside_the_limits(kind, models, world, ends):
    sampler = samplers.make_sampler(models[kind])
    compiled = samplers.propose.__wrapped__._cache_size()
    q = samplers.propose(sampler, world, *ends, jax.random.key(0))
    assert q.shape == (32, 8) and q.dtype == jnp.float32
    assert bool(jnp.all((q >= world.lower) & (q <= world.upper)))
    if kind == "discriminator":
        assert float(jnp.max(jnp.abs(q - ends[0])[:, :2])) <= 2.06
        assert len(np.unique(np.asarray(q), axis=0)) > 16
    same = samplers.propose(sampler, world, *ends, jax.random.key(0))
    np.testing.assert_array_equal(q, same)
    other = samplers.propose(sampler, world, *ends, jax.random.key(1))
    assert float(jnp.abs(q - other).max()) > 1e-3
    # Neither other weights nor another home compile anything.
    weights = dataclasses.replace(sampler, variables=random_model(kind, 1).variables)
    elsewhere = with_grid(world, random_grid(6))
    samplers.propose(weights, elsewhere, *ends, jax.random.key(0))
    assert samplers.propose.__wrapped__._cache_size() == compiled + 1


def test_checking_finds_waypoints_that_can_be_reached(models, world, ends):
    def reached(num_edge_checked):
        settings = {"candidates": 64, "num_edge_checked": num_edge_checked}
        sampler = samplers.make_sampler(models["discriminator"], **settings)
        q = np.asarray(samplers.propose(sampler, world, *ends, jax.random.key(3)))
        fraction = np.linspace(0, 1, 24)[:, None, None]
        edge = np.asarray(ends[0]) + fraction * np.asarray(world.edge(ends[0], q))
        return free(world, edge.reshape(-1, 8)).reshape(24, 32).all(axis=0).mean()

    assert reached(24) > reached(1) + 0.2


@pytest.mark.parametrize("kind", ["discriminator", "cvae"])
@pytest.mark.parametrize("task", ["snake", "fetch"])
def test_packaged_networks_are_those_that_training_makes_by_default(task, kind):
    assert samplers.load_sampler(task, kind).config == ModelConfig.default(task, kind)


@pytest.mark.parametrize("kind", ["discriminator", "cvae"])
def test_the_fetch_looks_at_more_waypoints_unless_it_is_told_otherwise(kind):
    fetch, snake = (samplers.load_sampler(task, kind) for task in ("fetch", "snake"))
    assert fetch.num_edge_checked == 3 * snake.num_edge_checked
    assert samplers.load_sampler("fetch", kind, num_edge_checked=1).num_edge_checked == 1


def test_nrp_g_takes_the_farthest_waypoint_that_can_be_reached(world, ends):
    """The farthest of all, where none can."""
    sampler = samplers.load_sampler("snake", "cvae")
    key, q_from = jax.random.key(4), np.asarray(ends[0])
    q = np.asarray(jax.jit(sampler.generate, static_argnums=3)(world, *ends, 8, key))
    edge = np.asarray(world.edge(jnp.broadcast_to(ends[0][:, None], q.shape), q))
    fraction = np.arange(1, 13)[:, None, None, None] / 12
    along = q_from[:, None] + fraction * edge
    ok = free(world, along.reshape(-1, 8)).reshape(12, 32, 8).all(axis=0)
    length = np.linalg.norm(edge[..., :2], axis=-1) + 0.167 * np.linalg.norm(edge[..., 2:], axis=-1)
    best = np.argmax(length + 100 * ok, axis=1)
    assert 0 < ok.mean() < 1 and len(np.unique(best)) > 4
    found = samplers.propose(sampler, world, *ends, key)
    np.testing.assert_allclose(found, q[np.arange(32), best], atol=1e-5)


def test_a_goal_in_the_window_can_be_the_waypoint(models, world, ends):
    """Of no candidates but the goal, the goal is the best."""
    sampler = samplers.make_sampler(models["discriminator"], candidates=0)
    inwards = 0.5 * jnp.sign(3.0 - ends[0][:, :2])
    near = ends[1].at[:, :2].set(ends[0][:, :2] + inwards)
    q = samplers.propose(sampler, world, ends[0], near, jax.random.key(0))
    np.testing.assert_allclose(q, near, atol=1e-5)


def test_weights_of_another_task_or_kind_are_refused(models, tmp_path):
    save_model(models["cvae"], tmp_path / "model.npz")
    with pytest.raises(ValueError, match="task 'snake'; expected 'fetch'"):
        samplers.load_sampler("fetch", "cvae", tmp_path)
    with pytest.raises(ValueError, match="kind 'cvae'; expected 'discriminator'"):
        samplers.load_sampler("snake", "discriminator", tmp_path)
    with pytest.raises(ValueError, match="unknown task 'panda'"):
        samplers.load_sampler("panda", "cvae")
    assert (
        samplers.load_sampler("snake", "cvae", tmp_path, num_edge_checked=4).num_edge_checked == 4
    )
