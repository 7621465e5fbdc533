"""NEXT: which nodes it chooses, how it counts what it tried, and plans with packaged weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.cli import main
from nrp_jax.guides import UniformGuide
from nrp_jax.planner import Status, plan
from nrp_jax.planners.next_planner import NEXTPlanner
from nrp_jax.samplers import load_sampler
from nrp_jax.scene.grid_world import GridWorld
from vrrt_jax.core.expand import expand
from vrrt_jax.core.types import pytree

pytestmark = pytest.mark.light_compilation
START = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9], np.float32)
GOAL = np.array([4.0, 1.0, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)


@pytree
class EastGuide:
    """Values grow towards +x; steps go there, too."""

    def predict(self, world, q):
        """See :class:`nrp_jax.guides.QueryGuide`."""
        return jnp.zeros_like(q).at[:, 0].set(0.25), q[:, 0]

    def draw(self, world, q, action, num, key):
        """See :class:`nrp_jax.guides.QueryGuide`."""
        return jnp.broadcast_to((q + action)[:, None], (len(q), num, q.shape[1]))


def test_it_follows_its_guide_to_the_wall_and_counts_what_failed(home):
    """One lane goes east in steps of a quarter of a meter, until the wall blocks it."""
    policy = NEXTPlanner(
        guide=EastGuide(),
        lanes=1,
        goal_bias=jnp.float32(0.0),
        explored_share=jnp.float32(0.0),
        bonus=jnp.float32(0.01),
    )
    # The first expansion of all aims at the goal, and goes two meters at most.
    start, turned = START, np.array([0, 0, 0, 0, 0, 0, 0, 0.5], np.float32)
    goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(start - turned))
    tree = policy.init(home[1], goal, start[None], 64)
    assert np.asarray(tree.payload.density)[0] == 1.0
    step = jax.jit(expand)
    for _ in range(7):
        tree = step(home[1], goal, policy, tree, jax.random.key(0))
    size = int(tree.size)
    q, rejected = np.asarray(tree.q)[:size], int(tree.rejected.sum())
    east = q[np.isclose(q[:, -1], start[-1], atol=1e-5)]
    assert len(east) >= 2 and rejected >= 2 and size + rejected == 8
    np.testing.assert_allclose(np.diff(east[:, 0]), 0.25, atol=1e-5)
    # Densities are Gaussians around all nodes, and around where failed expansions began: the last.
    tried = np.concatenate([q, np.repeat(east[-1:], rejected, axis=0)])
    everywhere = jnp.asarray(tried), jnp.asarray(q), jnp.array(True)
    apart = np.asarray(GridWorld.distances(home[1], *everywhere))
    expected = np.exp(-((apart / 0.5) ** 2)).sum(axis=1)
    np.testing.assert_allclose(np.asarray(tree.payload.density)[:size], expected, rtol=1e-4)


def test_lanes_choose_one_after_the_other(home):
    """Nodes whose values are alike are chosen in turn: each choice makes its node less certain."""
    policy = NEXTPlanner(guide=UniformGuide(), lanes=8, goal_bias=jnp.float32(0.0))
    world, goal = home[1], nrp_jax.ConfigurationGoal(q=jnp.asarray(GOAL))
    far = START + np.array([0, 2.5, 0, 0, 0, 0, 0, 0], np.float32)
    tree = policy.init(world, goal, np.stack([START, far]), 64)
    chosen = np.asarray(jax.jit(NEXTPlanner._selected)(policy, world, goal, tree))
    assert sorted(chosen) == [0] * 4 + [1] * 4 and np.all(chosen[1:] != chosen[:-1])
    at_goal = dataclasses.replace(tree, score=tree.score.at[0].set(0.0))
    chosen = np.asarray(jax.jit(NEXTPlanner._selected)(policy, world, goal, at_goal))
    assert np.all(chosen == 1)


def test_it_plans_through_the_door(snake, home):
    """With packaged weights; paths get shorter until the budget ends."""
    grid, world = home
    result = plan(
        snake,
        grid,
        START,
        GOAL,
        key=jax.random.key(0),
        planner="next",
        world=world,
        capacity=1024,
        max_expansions=960,
    )
    assert result.status is Status.SOLVED and result.expansions == 960
    np.testing.assert_allclose(result.path[-1], GOAL, atol=1e-5)
    cost = result.history[:, 4]
    assert np.all(cost[1:] <= cost[:-1] + 1e-4) and np.isfinite(cost[-1])


def test_bad_weights_and_maps_are_refused_in_one_line(snake, home, tmp_path, capsys):
    def refused(message, **options):
        grid = options.pop("grid", home[0])
        with pytest.raises(ValueError, match=message):
            plan(snake, grid, START, GOAL, key=jax.random.key(0), planner="next", **options)

    refused("the next of 'fetch'; expected the next of", sampler=load_sampler("fetch", "next"))
    refused("the global-cvae of 'snake'; exp", sampler=load_sampler("snake", "global-cvae"))
    refused("a object, has no method of_query; expected one", sampler=object())
    wide = nrp_jax.Grid(occupied=np.zeros((120, 50), bool))
    refused("120 x 50 cells; .* see 100 x 100 at most: crop it", grid=wide)
    wide.save(tmp_path / "wide.npz")
    numbers = [",".join(str(float(v)) for v in q) for q in (START, GOAL)]
    command = ["plan", "--map", str(tmp_path / "wide.npz"), f"--start={numbers[0]}"]
    command += [f"--goal={numbers[1]}", "--method", "next", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    told = capsys.readouterr().err
    assert "at most: crop it" in told and len(told.splitlines()) == 1
