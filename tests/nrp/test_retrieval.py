"""FIRE: what is retrieved for a query, what is drawn of it, and plans with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.config import PlannerConfig
from nrp_jax.homes.houses import generate_house
from nrp_jax.learning.experience_database import Database
from nrp_jax.learning.similarity import LATENT, MARGIN, Siamese
from nrp_jax.planner import plan
from nrp_jax.planners.by_name import check_names, policy_of
from nrp_jax.planners.cvae import CVAERRT, CVAEInformedRRTStar
from nrp_jax.retrieval import SIGMA, UNIFORM_SHARE, ExperienceSampler, Mixture
from nrp_jax.samplers import load_sampler, packaged_file
from nrp_jax.scene.world import batch_is_free

pytestmark = pytest.mark.light_compilation
REST = [0.1, 1.3, 1.4, -0.2, 1.7, 0.0, 1.6, 0.0]
START = np.array([0.8, 0.8, 0.3, *REST])
GOAL = np.array([2.2, 1.6, -0.5, *REST])


@pytest.fixture(scope="module")
def home():
    robot = nrp_jax.load_robot("fetch")
    grid = nrp_jax.Grid(occupied=np.zeros((30, 25, 20), bool), origin=(10.0, 20.0, 0.0))
    return robot, grid, nrp_jax.build_world(robot, grid)


@pytest.fixture(scope="module")
def database(home):
    """Weights of no training; one latent that is near all of them, and one that is far."""
    variables = Siamese().init(jax.random.key(0), jnp.zeros((1, 20, 20, 20)), jnp.zeros((1, 38)))
    variables = jax.tree.map(jnp.zeros_like, variables)
    latents = np.zeros((2, LATENT), np.float32)
    latents[1, 0] = MARGIN + 0.1
    samples = np.array([[0.2, -0.1, 0.5, *REST], [0.0] * 11], np.float32)
    return Database(task="fetch", variables=variables, latents=latents, samples=samples, info={})


def test_what_is_near_is_placed_where_it_was_found(home, database):
    robot, _, world = home
    start, goal = (q + [10, 20, *[0] * 9] for q in (START, GOAL))
    mixture = ExperienceSampler(robot, database).retrieve(world, start, goal)
    assert int(mixture.num) == 6  # one of each part of the room
    means = np.asarray(mixture.means)[:6]
    middles = [[11 + x, 21 + y] for x in (0, 0.5, 1) for y in (0, 0.5)]
    np.testing.assert_allclose(means[:, :2], np.array(middles) + [0.2, -0.1], atol=1e-5)
    np.testing.assert_allclose(means[:, 2:], np.tile([0.5, *REST], (6, 1)), atol=1e-5)


def test_samples_are_around_the_means_and_inside_the_limits(home):
    _, _, world = home
    mean = jnp.array([11.5, 21.0, 3.1, *REST])
    one = Mixture(means=jnp.stack([mean, 0 * mean]), num=jnp.int32(1), sigma=jnp.float32(SIGMA))
    q = np.asarray(one.draw(world, mean, mean, 2000, jax.random.key(0)))
    assert np.all((q >= world.lower) & (q <= world.upper))
    np.testing.assert_allclose(q[:, :2].std(axis=0), SIGMA, rtol=0.1)
    np.testing.assert_allclose(q[:, :2].mean(axis=0), mean[:2], atol=0.02)
    turned = np.angle(np.exp(1j * (q[:, 2] - 3.1)))
    assert turned.std() == pytest.approx(SIGMA, rel=0.1) and q[:, 2].min() < -3  # wraps
    none = Mixture(means=one.means, num=jnp.int32(0), sigma=one.sigma)
    uniform = np.asarray(none.draw(world, mean, mean, 2000, jax.random.key(0)))
    assert uniform[:, 0].std() > 2 * SIGMA and len(np.unique(uniform, axis=0)) == 2000


def test_planners_draw_from_what_is_retrieved(home, database):
    robot, _, world = home
    sampler, config = ExperienceSampler(robot, database), PlannerConfig(lanes=64)
    start, goal = ((q + [10, 20, *[0] * 9]).astype(np.float32) for q in (START, GOAL))
    star = policy_of("fire-star", robot, world, sampler, config, (start, goal))
    assert isinstance(star, CVAEInformedRRTStar) and isinstance(star.sampler, Mixture)
    policy = policy_of("fire", robot, world, sampler, config, (start, goal))
    assert isinstance(policy, CVAERRT)
    to = nrp_jax.ConfigurationGoal(q=jnp.asarray(goal))
    tree = policy.init(world, to, start[None], 128)
    q = np.asarray(jax.jit(CVAERRT.sample)(policy, world, to, tree, jax.random.key(0)))
    from_mixture = np.abs(q[:, 3:] - REST).max(axis=1) < 5 * SIGMA
    assert from_mixture.mean() == pytest.approx(1 - UNIFORM_SHARE, abs=0.15)


def test_the_packaged_database_knows_where_an_unseen_home_is_free():
    robot, grid = nrp_jax.load_robot("fetch"), generate_house(1_000_030, kind="fetch").grid
    world = nrp_jax.build_world(robot, grid)
    uniform = jax.random.uniform(
        jax.random.key(0), (1024, 11), minval=world.lower, maxval=world.upper
    )
    free = np.asarray(batch_is_free(world, uniform))
    start, goal = np.asarray(uniform)[free][:2]
    mixture = load_sampler("fetch", "fire").retrieve(world, start, goal)
    assert int(mixture.num) > 100
    drawn = mixture.draw(world, start, goal, 1024, jax.random.key(1))
    assert np.asarray(batch_is_free(world, drawn)).mean() > 1.5 * free.mean()
    assert {"fire", "fire-star"} <= {*check_names("fetch", None)}
    assert packaged_file("fetch", "fire").stat().st_size < 10e6


@pytest.mark.parametrize("planner", ["fire", "fire-star"])
def test_other_samplers_and_robots_are_refused(home, planner):
    robot, grid, world = home
    start, goal = (q + [10, 20, *[0] * 9] for q in (START, GOAL))
    shared = {"key": jax.random.key(0), "planner": planner, "world": world}
    with pytest.raises(ValueError, match="the cvae of 'fetch'; expected the fire of 'fetch'"):
        plan(robot, grid, start, goal, sampler=load_sampler("fetch", "cvae"), **shared)
    with pytest.raises(ValueError, match="a object, has no method retrieve; expected one as of"):
        plan(robot, grid, start, goal, sampler=object(), **shared)
    snake = nrp_jax.load_robot("snake")
    floor = nrp_jax.Grid(occupied=np.zeros((60, 60), bool))
    q = np.array([3.0, 3, 0.3, 0.2, 0, 0.1, 0, 0])
    with pytest.raises(ValueError, match=f"planner '{planner}' is for the fetch"):
        plan(snake, floor, q, q, key=jax.random.key(0), planner=planner)
