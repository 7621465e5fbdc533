"""The term that keeps a CVAE's waypoints clear of obstacles."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import synthetic_rows

from nrp_jax import load_robot
from nrp_jax.learning import features
from nrp_jax.learning.batches import describe, make_batch, make_examples
from nrp_jax.learning.checkpoint import build_module
from nrp_jax.learning.models import CVAE, ModelConfig
from nrp_jax.learning.objective import CLEARANCE, blocked_share
from nrp_jax.learning.recipe import TrainConfig
from nrp_jax.learning.train import train
from nrp_jax.scene.robots import batch_link_features

pytestmark = pytest.mark.light_compilation


def described(config, robot, q):
    """Features (n, E) and link frames (n, F, 3) of local configurations (n, D)."""
    points = batch_link_features(robot, jnp.asarray(q))
    return describe(config, robot, jnp.asarray(q)[None], points[None])[0], points


@pytest.mark.parametrize("make", [ModelConfig.default, ModelConfig.published])
@pytest.mark.parametrize("task", ["snake", "fetch"])
def test_features_tell_where_the_links_are(task, make):
    robot, config = load_robot(task), make(task, "cvae")
    q = np.random.default_rng(0).uniform(-1, 1, (5, len(robot.joint_names))).astype(np.float32)
    made, points = described(config, robot, q)
    if robot.planar:
        points = points.at[..., 2].set(0.0)
    np.testing.assert_allclose(features.generated_points(config, robot, made), points, atol=1e-6)
    np.testing.assert_array_equal(made[:, :2], q[:, :2])


@pytest.mark.parametrize("layers", [1, 6])
def test_between_cells_an_image_is_linear(layers):
    """Cells have their values at their centers; the origin is the middle of the floor."""
    x, y, z = (0.1 * (np.arange(n) + 0.5 - n / 2) for n in (8, 12, layers))
    z = z + 0.05 * layers if layers > 1 else 0 * z
    image = 2 * x[:, None, None] - y[:, None] + 3 * z + 5
    points = np.random.default_rng(0).uniform([-0.3, -0.5, 0.06], [0.3, 0.5, 0.5], (50, 3))
    points[:, 2] *= layers > 1
    found = features.interpolate(jnp.asarray(image), jnp.asarray(points), 0.1)
    np.testing.assert_allclose(found, points @ [2, -1, 3] + 5, rtol=1e-5)


def test_a_way_is_blocked_by_how_much_of_it_is_near_obstacles():
    """A wall at x = 1 m: ways that end before it are clear, and the gradient leads back to them."""
    robot, config = load_robot("snake"), ModelConfig.default("snake", "cvae")
    center = 0.1 * (np.arange(40) + 0.5 - 20)
    distance = np.maximum(1.0 - center, 0.0)[:, None, None]  # solid from the wall on
    image = jnp.asarray(np.broadcast_to(distance, (1, 40, 40, 1)), jnp.float32)
    q = np.zeros((4, 8), np.float32)
    q[1:, 0] = 0.5, 1.1, 1.8
    made, _ = described(config, robot, q)

    def share(made):
        return blocked_share(config, robot, image, made[:1], made[None, 1:])[0]

    before, at, behind = np.asarray(share(made))
    # The arm is straight along the wall, so that all seven points of the snake have one x.
    passed = np.arange(1, 9) / 8 * 1.8
    plain = np.maximum(0, 1 - np.interp(passed, center, distance[:, 0, 0]) / CLEARANCE).mean()
    assert before == 0 < at < behind
    np.testing.assert_allclose(behind, plain, rtol=1e-4)
    gradient = jax.grad(lambda made: share(made).sum())(made)
    assert gradient[2, 0] > 0 and abs(gradient[1]).max() == 0


def test_a_cvae_that_is_trained_so_generates_waypoints_that_are_blocked_less(tmp_path):
    robot, grids, columns = synthetic_rows(homes=5, queries=60, waypoints=6)
    columns = {name: column[columns["good"]] for name, column in columns.items()}
    ones, found = np.ones(len(columns["home"])), []
    small = {"channels": (16, 32), "context": 64, "width": 64}
    for weight in (0.0, 1.0):
        config = ModelConfig.default("snake", "cvae")
        config = dataclasses.replace(config, blocked_weight=weight, **small)
        examples = make_examples(config, robot, grids, columns, target=ones, weight=ones)
        settings = TrainConfig(epochs=8, batch=48, learning_rate=8e-3)
        out = tmp_path / str(weight)
        model = train(config, robot, examples, out, settings=settings, progress=False)
        queries = np.flatnonzero(np.asarray(examples.home) == 0)
        batch = jax.jit(make_batch, static_argnums=0)(config, robot, examples, queries)
        z = jax.random.normal(jax.random.key(5), (len(queries), 16, config.latent))
        module: Any = build_module(config, model.info["num_outputs"])
        seen = (batch.image, batch.start, batch.goal, z)
        made = module.apply(model.variables, *seen, method=CVAE.decode)
        share = blocked_share(config, robot, batch.image, batch.start, made)
        step = jnp.linalg.norm((made - batch.start[:, None])[..., :2], axis=-1)
        found.append((float(share.mean()), float(step.mean())))
    (plain, far), (clear, near) = found
    assert clear < 0.8 * plain and near > 0.5 * far
