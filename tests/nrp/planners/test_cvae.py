"""CVAE-RRT and CVAE-IRRT*: which samples they take, and plans with packaged weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.cli import main
from nrp_jax.generators import GlobalCVAESampler
from nrp_jax.homes.houses import CELLS, generate_house
from nrp_jax.planner import Status, plan
from nrp_jax.planners.cvae import CVAERRT, CVAEInformedRRTStar
from nrp_jax.samplers import load_sampler
from nrp_jax.scene.exact import ExactScene
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.types import pytree

pytestmark = pytest.mark.light_compilation
START = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)
GOAL = np.array([4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)


@pytree
class Always:
    """Draws one configuration again and again."""

    q: jax.Array  # (D,)

    def draw(self, world, q_start, q_goal, num, key):
        """See :class:`nrp_jax.generators.GlobalCVAESampler`."""
        return jnp.broadcast_to(self.q, (num, len(self.q)))


@pytest.mark.parametrize("make", [CVAERRT, CVAEInformedRRTStar])
def test_shares_of_samples(home, make):
    """Uniform ones by their share; those that are too far to shorten a path are not taken."""
    world, goal = home[1], nrp_jax.ConfigurationGoal(q=jnp.asarray(GOAL))
    middle = jnp.asarray((START + GOAL) / 2)
    empty = make(sampler=Always(q=middle)).init(world, goal, START[None], 512)
    sample = jax.jit(make.sample)

    def learned(share, q=middle, cost=None):
        policy = make(sampler=Always(q=q), uniform_share=jnp.float32(share), lanes=256)
        tree = empty
        if cost is not None:  # as if the goal were a node
            score, costs = tree.score.at[0].set(0.0), tree.cost.at[0].set(cost)
            tree = dataclasses.replace(tree, score=score, cost=costs)
        samples = np.asarray(sample(policy, world, goal, tree, jax.random.key(0)))
        assert samples.shape == (256, 8)
        return float(np.mean(np.all(samples == np.asarray(q), axis=1)))

    assert learned(0.0) == 1.0 and learned(1.0) == 0.0
    assert learned(0.5) == pytest.approx(0.5, abs=0.1)
    shortest = float(world.distance(START, GOAL))
    assert learned(0.0, cost=1.1 * shortest) == 1.0
    away = middle.at[1].add(2.0)
    assert learned(0.0, q=away) == 1.0 and learned(0.0, q=away, cost=1.1 * shortest) == 0.0


@pytest.mark.parametrize("task", CELLS)
def test_packaged_samples_follow_paths_in_an_unseen_home(task):
    """They detour less than uniform ones, differ, and are inside the limits."""
    robot, house = nrp_jax.load_robot(task), generate_house(1_000_003, kind=task)
    grid = house.plan() if robot.planar else house.grid
    world, sampler = nrp_jax.build_world(robot, grid), load_sampler(task, "global-cvae")
    assert isinstance(sampler, GlobalCVAESampler) and sampler.config.scope == "map"
    uniform = sample_configurations(world, jax.random.key(1), 256)
    draw = jax.jit(sampler.draw, static_argnums=3)
    detour = {"learned": [], "uniform": []}
    for key, start, goal in zip(range(8), uniform, uniform[8:], strict=False):
        q = draw(world, start, goal, 64, jax.random.key(key))
        assert bool(jnp.all((q >= world.lower) & (q <= world.upper)))
        assert len(np.unique(np.asarray(q), axis=0)) == 64
        for name, samples in (("learned", q), ("uniform", uniform[-64:])):
            from_start, to_goal = samples - start, samples - goal
            length = [jnp.hypot(s[:, 0], s[:, 1]) for s in (from_start, to_goal)]
            straight = jnp.hypot(*(goal - start)[:2])
            detour[name].append(float(jnp.mean(length[0] + length[1]) - straight))
    assert np.mean(detour["learned"]) < 0.6 * np.mean(detour["uniform"])


def test_it_plans_through_the_door(snake, home):
    (grid, world), scene = home, ExactScene(snake, home[0])
    budget = {"capacity": 2048, "max_expansions": 1600, "goal_bias": 0.2}
    result = plan(
        snake,
        grid,
        START,
        GOAL,
        key=jax.random.key(0),
        method="cvae-rrt",
        world=world,
        scene=scene,
        **budget,
    )
    assert result.status is Status.SOLVED and result.ok
    np.testing.assert_allclose(result.path[-1], GOAL, atol=1e-5)
    cost = result.history[:, 4]
    assert np.all(cost[1:] <= cost[:-1] + 1e-4)
    assert result.expansions < 1600


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sampler": ("snake", "cvae")}, "the cvae of 'snake'; expected the global-cv"),
        ({"sampler": ("fetch", "global-cvae")}, "the global-cvae of 'fetch'; expected"),
        ({"sampler": object()}, "the sampler, a object, has no method draw; expected one as of"),
        ({"uniform_share": 1.5}, r"uniform_share=1.5 is out of range; expected \[0.0, 1.0\]"),
    ],
)
def test_bad_input(snake, home, options, message):
    if isinstance(which := options.get("sampler"), tuple):
        options = {"sampler": load_sampler(*which)}
    with pytest.raises(ValueError, match=message):
        plan(snake, home[0], START, GOAL, key=jax.random.key(0), method="cvae-rrt", **options)


def test_maps_too_large_and_missing_weights(snake, tmp_path, capsys):
    wide = nrp_jax.Grid(occupied=np.zeros((120, 50), bool))
    with pytest.raises(ValueError, match="120 x 50 cells; .* see 100 x 100 at most: crop it"):
        plan(snake, wide, START, GOAL, key=jax.random.key(0), method="cvae-rrt")
    wide.save(tmp_path / "wide.npz")
    numbers = [",".join(str(float(v)) for v in q) for q in (START, GOAL)]
    command = ["plan", "--map", str(tmp_path / "wide.npz"), f"--start={numbers[0]}"]
    command += [f"--goal={numbers[1]}", "--method", "cvae-rrt", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    told = capsys.readouterr().err
    assert "at most: crop it" in told and len(told.splitlines()) == 1
    assert main([*command, "--model", str(tmp_path / "none")]) == 2
    told = capsys.readouterr().err
    assert "no model at" in told and len(told.splitlines()) == 1
