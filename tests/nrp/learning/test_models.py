"""Features, symmetries and architectures of the learned samplers."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import random_grid

from nrp_jax.homes.grid import RESOLUTION
from nrp_jax.learning import features, local_map, models
from nrp_jax.learning.batches import local_image, relations, surrounding_map
from nrp_jax.learning.checkpoint import Model, build_module, check_model, load_model, save_model
from nrp_jax.learning.models import ModelConfig
from nrp_jax.scene.robots import batch_link_features, load_robot
from nrp_jax.scene.world import build_world, is_free
from vrrt_jax.core.planners.rrt import sample_configurations

pytestmark = pytest.mark.light_compilation

SIZES = {"snake": (40, 40, 1), "fetch": (40, 40, 20)}


def shapes(config: ModelConfig, candidates: int = 3, lanes: int = 2):
    """Inputs of a network, for ``jax.eval_shape``."""
    robot = load_robot(config.task)
    image = SIZES[config.task]
    if config.scope == "map":
        side = {"snake": 100, "fetch": 150}[config.task]
        image = (side, side, image[2])

    def inputs():
        q, points = jnp.zeros(robot.num_joints), jnp.zeros((len(robot.feature_link), 3))
        own = features.configuration_features(config, robot, q, points)
        goal = features.goal_features(config, robot, q, points)
        standing = features.standing_points(robot, q, points)
        touched = jnp.zeros(features.PATH_SAMPLES * len(standing) + 4)
        each = jnp.zeros((lanes, candidates, 1))
        last = each * touched if config.kind == "discriminator" else jax.random.key(0)
        start = jnp.zeros((lanes, 1)) * own
        return jnp.zeros((lanes, *image)), start, jnp.zeros((lanes, 1)) * goal, each * own, last

    return jax.eval_shape(inputs)


def num_parameters(config: ModelConfig, part: str | None = None) -> int:
    inputs = shapes(config)
    module = build_module(config, inputs[3].shape[-1])
    params = jax.eval_shape(module.init, jax.random.key(0), *inputs)["params"]
    if part is not None:
        params = {name: leaf for name, leaf in params.items() if name.startswith(part)}
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def test_published_architectures_have_the_published_sizes():
    published = ModelConfig.published
    # [million], from the paper's code, whose batch normalisation follows biased layers as here
    assert num_parameters(published("snake", "discriminator")) == pytest.approx(0.88e6, rel=0.01)
    assert num_parameters(published("snake", "cvae"), "encoder") == pytest.approx(0.98e6, rel=0.02)
    assert num_parameters(published("snake", "cvae"), "decoder") == pytest.approx(0.98e6, rel=0.02)
    assert num_parameters(published("fetch", "discriminator")) == pytest.approx(5.07e6, rel=0.01)
    assert num_parameters(published("fetch", "cvae"), "encoder") == pytest.approx(4.82e6, rel=0.01)
    assert num_parameters(published("fetch", "cvae"), "decoder") == pytest.approx(4.81e6, rel=0.01)
    assert num_parameters(published("fetch", "cvae"), "decoder_image") == 228_672


@pytest.mark.parametrize("task", models.TASKS)
@pytest.mark.parametrize("scope", ["window", "map"])
def test_default_architectures_are_light(task, scope):
    kinds = models.WAYPOINT_KINDS
    numbers = [num_parameters(ModelConfig.default(task, kind, scope)) for kind in kinds]
    assert 2 * sum(numbers) < 9e6  # bytes on disk, half precision


@pytest.mark.parametrize("task", models.TASKS)
def test_a_global_cvae_sees_the_map_and_its_decoder_is_light(task):
    config = ModelConfig.default(task, models.GLOBAL_CVAE)
    assert config.scope == "map" and config == ModelConfig.default(task, "global-cvae", "map")
    assert 2 * num_parameters(config, "decoder") < 2e6  # bytes on disk, half precision


def test_unknown_choices_are_named():
    with pytest.raises(ValueError, match="unknown task 'panda'; have: snake, fetch"):
        ModelConfig.default("panda", "cvae")
    with pytest.raises(ValueError, match="unknown model 'gan'"):
        ModelConfig.published("snake", "gan")


@pytest.mark.parametrize("task", models.TASKS)
@pytest.mark.parametrize("paper", [False, True])
def test_configurations_come_back_from_their_features(task, paper, rng):
    make = ModelConfig.published if paper else ModelConfig.default
    config, robot = make(task, "cvae"), load_robot(task)
    q = rng.uniform(-3.1, 3.1, (5, robot.num_joints)).astype(np.float32)
    points = np.zeros((len(robot.feature_link), 3))
    made = [features.configuration_features(config, robot, one, points) for one in jnp.asarray(q)]
    if not paper:  # the snake's base and the Fetch's base and torso slide, all else turns
        slides, turns = (2, 6) if task == "snake" else (3, 8)
        frames = 2 * len(points) if task == "snake" else 3 * len(points)
        assert made[0].shape == (slides + 2 * turns + frames,)
    back = features.to_configuration(config, robot, jnp.stack(made))
    np.testing.assert_allclose(back, q, atol=1e-5)


@pytest.mark.parametrize("task", models.TASKS)
def test_turned_homes_are_as_free_as_before(task):
    """Turning and mirroring map, robot and links together changes nothing."""
    robot = load_robot(task)
    grid = random_grid(3, size=48, height=SIZES[task][2], boxes=20)
    world, middle = build_world(robot, grid), jnp.array([2.4, 2.4])
    q = sample_configurations(world, jax.random.key(0), 400)
    frames = functools.partial(batch_link_features, robot)
    free = jax.jit(jax.vmap(is_free, (None, 0)))
    before, local = np.asarray(free(world, q)), features.to_local(q, middle)
    shift = jnp.append(middle, 0.0)
    assert 0.005 < before.mean() < 0.95
    for quarter, mirror in ((1, False), (2, True), (3, False), (0, True)):
        turn = (jnp.int32(quarter), jnp.array(mirror))
        occupied = features.turn_image(jnp.asarray(grid.occupied), *turn)
        turned = build_world(robot, dataclasses.replace(grid, occupied=np.asarray(occupied)))
        q_turned = features.to_world(features.turn_configuration(robot, local, *turn), middle)
        points = features.turn_points(frames(q) - shift, *turn)
        np.testing.assert_allclose(frames(q_turned) - shift, points, atol=2e-3)
        # Cover spheres of the Fetch are not quite as symmetric as it is; edges of cells round.
        agree = np.asarray(free(turned, q_turned)) == before
        assert agree.mean() > (0.995 if task == "snake" else 0.98)


def test_images_show_what_surrounds_the_start():
    robot, grid = load_robot("snake"), random_grid(1)
    world = build_world(robot, grid)
    config = ModelConfig.default("snake", "discriminator")
    padded = surrounding_map(config, world.field)
    q = jnp.zeros(8).at[:2].set(jnp.array([1.23, 4.77]))
    image, center = local_image(config, padded, q, jnp.float32(RESOLUTION), jnp.zeros(2))
    image = np.asarray(image)
    np.testing.assert_allclose(center, [1.2, 4.8], atol=1e-6)
    for cell in np.ndindex(40, 40):
        place = np.round(np.asarray(center) / RESOLUTION).astype(int) - 20 + cell
        inside = (place >= 0).all() and (place < 60).all()
        solid = not inside or grid.occupied[place[0], place[1], 0]
        assert (image[*cell, 0] == 0.0) == solid
    whole, middle = local_image(
        ModelConfig.default("snake", "cvae", "map"), padded, q, jnp.float32(0.1), jnp.zeros(2)
    )
    assert whole.shape == (100, 100, 1) and float(whole[:20].max()) == 0.0
    np.testing.assert_allclose(middle, [3.0, 3.0], atol=1e-6)
    np.testing.assert_array_equal(whole[20:80, 20:80] > 0, ~grid.occupied)
    assert local_map.SIDE == 40


def test_surroundings_are_read_where_the_robot_would_pass():
    robot = load_robot("snake")
    image = jnp.arange(1600.0).reshape(40, 40, 1)
    goal = jnp.full(8, 0.45).at[2].set(2 * np.pi - 1)  # the first joint goes round
    waypoint = jnp.zeros(8).at[:2].set(jnp.array([0.45, -0.45]))  # straight along +y, as the start
    q = jnp.stack([jnp.zeros(8), goal, waypoint])
    points = batch_link_features(robot, q)
    read = np.asarray(jax.jit(relations)(robot, image, q, points))[0]
    cells = []
    for fraction in (0.25, 0.5, 0.75, 1.0):
        for along in (*(0.12 * np.arange(1, 7)), 0.0):
            x, y = 0.45 * fraction, along - 0.45 * fraction
            cells.append((20 + int(np.floor(x / 0.1)), 20 + int(np.floor(y / 0.1 + 1e-4))))
    np.testing.assert_array_equal(read[:28], [40 * i + j for i, j in cells])
    arm = np.sqrt(5 * 0.45**2 + 1.0)
    np.testing.assert_allclose(read[28:], [np.hypot(0.45, 0.45), 0, 0.9, arm], atol=1e-4)


def test_candidates_are_judged_one_by_one():
    config = ModelConfig.default("snake", "discriminator")
    inputs = shapes(config, candidates=5)
    keys = jax.random.split(jax.random.key(1), len(inputs))
    inputs = [jax.random.normal(k, x.shape) for k, x in zip(keys, inputs, strict=True)]
    module = build_module(config, 0)
    variables = jax.jit(module.init)(jax.random.key(0), *inputs)
    apply = jax.jit(module.apply)
    together = apply(variables, *inputs)
    assert together.shape == (2, 5) and float(jnp.std(together)) > 0
    alone = apply(variables, *inputs[:3], *(x[:, 2:3] for x in inputs[3:]))
    np.testing.assert_allclose(alone[:, 0], together[:, 2], atol=1e-5)


def test_losses_by_hand():
    mask = jnp.array([[1.0, 1.0, 0.0]])
    loss = models.discriminator_loss(
        jnp.array([[0.0, 2.0, 9.0]]), jnp.array([[1.0, 0.0, 0.0]]), mask
    )
    np.testing.assert_allclose(loss, (np.log(2) + np.log1p(np.exp(2))) / 2, rtol=1e-6)
    config = ModelConfig.default("snake", "cvae")
    waypoints = jnp.zeros((1, 3, 2))
    made = waypoints.at[0, 0].set(jnp.array([1.0, 3.0])).at[0, 2].set(100.0)
    mean = jnp.zeros((1, 3, 8)).at[0, 1, 0].set(2.0)
    total, error, divergence = models.cvae_loss(config, waypoints, made, mean, 0 * mean, mask)
    np.testing.assert_allclose(error, 5.0 / 2)
    np.testing.assert_allclose(divergence, 2.0 / 2)
    np.testing.assert_allclose(total, 2.5 + 0.01, rtol=1e-6)


def test_models_come_back_and_damaged_ones_are_refused(tmp_path):
    config = ModelConfig.default("snake", "cvae")
    inputs = shapes(config)
    module = build_module(config, inputs[3].shape[-1])
    empty = jax.eval_shape(module.init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(0)
    variables = jax.tree.map(lambda x: rng.normal(size=x.shape).astype(np.float32), empty)
    model = Model(config=config, variables=variables, info={"num_outputs": inputs[3].shape[-1]})
    file = tmp_path / "model.npz"
    save_model(model, file)
    back = load_model(tmp_path)
    assert back.config == config and back.info == model.info
    assert build_module(back.config, back.info["num_outputs"]) == module
    planned = {"params": {k: v for k, v in variables["params"].items() if k != "encoder"}}
    for a, b in zip(jax.tree.leaves(planned), jax.tree.leaves(back.variables), strict=True):
        np.testing.assert_allclose(a, b, atol=3e-3)
    with pytest.raises(ValueError, match="task 'snake'; expected 'fetch'"):
        check_model(back, file, task="fetch")
    with pytest.raises(ValueError, match="kind 'cvae'; expected 'discriminator'"):
        check_model(back, file, task="snake", kind="discriminator")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(ValueError, match="not a readable model"):
        load_model(file)
    with pytest.raises(ValueError, match="no model at"):
        load_model(tmp_path / "none.npz")
