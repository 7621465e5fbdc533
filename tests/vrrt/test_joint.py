"""Plans to joint goals: the clearance that they keep, and many at once."""

import signal

import jax
import numpy as np
import pytest
from core_cases import GOAL, START

import vrrt_jax
import vrrt_jax.joint
from vrrt_jax import ConfigurationGoal, Obstacle, PlannerConfig, Status
from vrrt_jax.scene.verify import interpolate
from vrrt_jax.scene.world import keeping_clearance, with_margin

KEY = jax.random.key(0)


def smallest_clearance(robot, world, path):
    """Of the collision spheres on a path, at every hundredth of a radian."""
    q = interpolate(robot, np.asarray(path, float), 0.01).q.astype(np.float32)
    return float(np.min(jax.jit(jax.vmap(vrrt_jax.obstacle_clearance, (None, 0)))(world, q)))


def plan(robot, world, goal=GOAL, **changes):
    config = PlannerConfig().changed(changes)
    return vrrt_jax.plan(robot, world, ConfigurationGoal(q=goal), START, key=KEY, config=config)


def test_a_path_keeps_its_distance_where_it_can(panda, wall_world):
    grazing = plan(panda, wall_world, **{"path.margin": 0.0})
    wary = plan(panda, wall_world)
    wide = plan(panda, wall_world, **{"path.margin": 0.03})
    for result in (grazing, wary, wide):
        assert result.ok
        measured = smallest_clearance(panda, wall_world, result.path)
        assert result.clearance == pytest.approx(measured, abs=2e-3)
    assert grazing.clearance < 0.009 < wary.clearance - 5e-4 < 0.03 < wide.clearance + 1e-3


def test_less_is_kept_where_an_end_is_nearer(panda, wall_world):
    low, high = 0.0, 0.6  # moves the goal towards the wall
    for _ in range(12):
        middle = (low + high) / 2
        goal = GOAL - np.array([middle, 0, 0, 0, 0, 0, 0], np.float32)
        near = float(vrrt_jax.obstacle_clearance(wall_world, goal))
        low, high = (middle, high) if near > 0.004 else (low, middle)
    goal = GOAL - np.array([low, 0, 0, 0, 0, 0, 0], np.float32)
    assert 0.003 < float(vrrt_jax.obstacle_clearance(wall_world, goal)) < 0.006
    result = plan(panda, wall_world, goal)
    assert result.ok and 0.002 < result.clearance < 0.006


def test_the_margin_that_is_kept_is_the_widest_that_ends_allow(wall_world):
    ends = np.stack([START, GOAL])
    clear = float(np.min([vrrt_jax.obstacle_clearance(wall_world, q) for q in ends]))
    fits = keeping_clearance(wall_world, ends, 0.4 * clear)  # links of the arm are nearer
    np.testing.assert_allclose(fits.margin, 0.4 * clear, rtol=1e-5)
    # What does not fit is halved until it does, between links too.
    half = keeping_clearance(wall_world, ends, 1.5 * clear)
    halvings = np.log2(1.5 * clear / float(half.margin))
    np.testing.assert_allclose(halvings, max(round(halvings), 1), atol=1e-4)
    wider = with_margin(wall_world, 2 * half.margin)
    assert all(vrrt_jax.is_free(half, q) for q in ends)
    assert not all(vrrt_jax.is_free(wider, q) for q in ends)
    assert keeping_clearance(wall_world.by_spheres_alone(), ends, 0.0).spheres.narrow_phase is None
    blocked = (START + GOAL)[None] / 2
    assert keeping_clearance(wall_world, blocked, 0.01) is wall_world


def test_another_attempt_begins_from_another_key(panda, wall_world, monkeypatch):
    keys = []

    def search(world, goal, policy, tree, *, key, **rest):
        keys.append(jax.random.key_data(key).tolist())
        return real(world, goal, policy, tree, key=key, **rest)

    real = vrrt_jax.joint.search
    monkeypatch.setattr(vrrt_jax.joint, "search", search)
    few = {"budget.max_iterations": 1, "path.margin": 0.0}
    alone = wall_world.by_spheres_alone()  # or each attempt searches twice
    result = plan(panda, alone, **few, **{"budget.attempts": 3})
    assert result.status is Status.MAX_ITERATIONS
    assert len({str(key) for key in keys}) == len(keys) == 3
    assert result.expansions == 3 * 32


def worlds_of(world):
    """The wall where it is, a little farther on, and none at all."""
    moved = vrrt_jax.move_obstacle(world, "wall", position=(0.45, 0.05, 0.4))
    gone = [o for o in vrrt_jax.obstacle_list(world) if o.name != "wall"]
    return [world, moved, vrrt_jax.with_obstacles(world, gone)]


def test_a_batch_of_joint_goals_has_a_world_each(panda, wall_world):
    worlds = worlds_of(wall_world)
    goals, starts = [ConfigurationGoal(q=GOAL)] * 3, np.stack([START] * 3)
    results = vrrt_jax.plan_batch(panda, worlds, goals, starts, key=KEY)
    keys = [jax.random.fold_in(KEY, i) for i in range(3)]
    for world, key, result in zip(worlds, keys, results, strict=True):
        alone = vrrt_jax.plan(panda, world, goals[0], START, key=key)
        assert result.ok
        np.testing.assert_array_equal(result.path, alone.path)
    assert results[2].cost < 0.99 * results[0].cost
    one_world = vrrt_jax.plan_batch(panda, wall_world, goals[:1], starts[:1], key=KEY)
    np.testing.assert_array_equal(one_world[0].path, results[0].path)


def test_what_is_wrong_in_a_batch_is_named_before_anything_is_planned(panda, wall_world):
    goals, starts = [ConfigurationGoal(q=GOAL)] * 2, np.stack([START] * 2)
    run = {"key": KEY, "on_progress": lambda *_: pytest.fail("a search has begun")}
    inside = Obstacle(name="block", kind="sphere", position=(0.45, 0, 0.4), size=(0.6, 0, 0))
    blocked = vrrt_jax.with_obstacles(wall_world, [inside])
    with pytest.raises(ValueError, match="problem 1: the start is in collision.*block"):
        vrrt_jax.plan_batch(panda, [wall_world, blocked], goals, starts, **run)
    with pytest.raises(ValueError, match="got 1 worlds and 2 goals"):
        vrrt_jax.plan_batch(panda, [wall_world], goals, starts, **run)
    far = [goals[0], ConfigurationGoal(q=np.full(7, 9.0))]
    with pytest.raises(ValueError, match="problem 1: the goal is outside the limits"):
        vrrt_jax.plan_batch(panda, wall_world, far, starts, **run)


def test_ctrl_c_ends_a_batch_with_results(panda, wall_world):
    goals, starts = [ConfigurationGoal(q=GOAL)] * 3, np.stack([START] * 3)
    signals = []

    def once(*_):
        if not signals:
            signals.append(signal.raise_signal(signal.SIGINT))

    # RRT without any lane that aims at the goal would go on for long.
    results = vrrt_jax.plan_batch(
        panda,
        wall_world,
        goals,
        starts,
        key=KEY,
        planner=vrrt_jax.RRT.for_world(wall_world, goal_bias=0.0),
        on_progress=once,
        config=PlannerConfig().changed({"budget.max_iterations": 100_000}),
    )
    assert [result.status for result in results] == [Status.INTERRUPTED] * 3
    assert all(result.iterations <= 8 for result in results)


def test_a_planner_that_improves_has_all_its_iterations(panda, wall_world):
    """With a clearance to keep, and without."""
    config = PlannerConfig().changed({"budget.max_iterations": 40})
    goal = ConfigurationGoal(q=START + np.array([-0.4, 0, 0, 0, 0, 0, 0], np.float32))
    planner = vrrt_jax.RRTStar.for_world(wall_world, goal_bias=0.3)
    result = vrrt_jax.plan(panda, wall_world, goal, START, key=KEY, planner=planner, config=config)
    assert result.ok and result.iterations == 40


def test_without_a_path_that_keeps_the_margin_one_without_is_searched_for(
    panda, wall_world, monkeypatch
):
    """A tree of one branch that never reaches the goal is no path to it."""
    searched = []

    def search(world, goal, policy, tree, **rest):
        searched.append(float(world.margin))
        return real(world, goal, policy, tree, **rest)

    real = vrrt_jax.joint.search
    monkeypatch.setattr(vrrt_jax.joint, "search", search)
    config = PlannerConfig().changed({"budget.max_iterations": 20, "budget.attempts": 1})
    planner = vrrt_jax.RRT.for_world(wall_world, goal_bias=0.0)
    goal = ConfigurationGoal(q=GOAL)
    result = vrrt_jax.plan(panda, wall_world, goal, START, key=KEY, planner=planner, config=config)
    assert not result.ok
    # At last it is searched for with polytopes where spheres touch.
    np.testing.assert_allclose(searched, [0.01, 0.0, 0.0], atol=1e-6)
