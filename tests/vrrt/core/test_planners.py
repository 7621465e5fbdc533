"""RRT, RRT-IS, RRT* and RRT-Connect to a joint goal."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_cases import GOAL, START, assert_free

import vrrt_jax
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners import PLANNERS, RRT, RRTConnect, RRTStar
from vrrt_jax.core.rewire import with_costs
from vrrt_jax.core.search import StopReason, make_termination, search


def test_rrt_connect_goes_around_the_wall(wall_world, free, connected):
    assert connected.stopped is StopReason.REACHED
    path = RRTConnect().extract_path(connected.tree)
    np.testing.assert_allclose(path[[0, -1]], [START, GOAL], atol=1e-5)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 128 * 0.02 + 1e-4
    assert_free(wall_world, free, path)


def test_tree_invariants(wall_world, connected):
    tree = connected.tree
    size, parent = int(tree.size), np.asarray(tree.parent)
    assert np.all(parent[2:size] < np.arange(2, size)), "a child comes after its parent"
    assert np.all(parent[size:] == -1) and np.all(np.isinf(tree.score[size:]))
    assert size == 2 + 32 * int(tree.iteration) - int(np.sum(tree.rejected))
    recomputed = with_costs(wall_world, tree).cost
    np.testing.assert_allclose(recomputed, tree.cost, atol=1e-4)
    side = np.asarray(tree.payload.side)
    assert np.all(side[parent[2:size]] == side[2:size]), "trees do not mix"


def test_rrt_star_improves_on_rrt_with_right_costs(wall_world, free):
    goal = ConfigurationGoal(q=jnp.asarray(GOAL))

    def run(policy):
        return search(
            wall_world,
            goal,
            policy,
            policy.init(wall_world, goal, START[None], 8192),
            key=jax.random.key(3),
            termination=make_termination(-1.0, max_iterations=100),
        ).tree

    plain, star = run(RRT()), run(RRTStar())
    for tree in (plain, star):
        np.testing.assert_allclose(with_costs(wall_world, tree).cost, tree.cost, atol=2e-4)
    mean_plain = float(np.mean(plain.cost[: int(plain.size)]))
    mean_star = float(np.mean(star.cost[: int(star.size)]))
    assert mean_star < 0.85 * mean_plain
    path = RRTStar().extract_path(star)
    np.testing.assert_allclose(path[0], START, atol=1e-6)
    assert_free(wall_world, free, path)


@pytest.mark.parametrize("planner", [*PLANNERS, RRT(intermediate=True, keep_partial=True)], ids=str)
def test_planners_by_name_and_as_objects_reach_a_joint_goal(panda, wall_world, planner):
    near = START - np.array([0.4, 0.3, 0, 0, 0, 0, 0], np.float32)
    config = vrrt_jax.PlannerConfig(budget=vrrt_jax.Budget(max_iterations=60))
    result = vrrt_jax.plan(
        panda,
        wall_world,
        vrrt_jax.ConfigurationGoal(q=near),
        START,
        key=jax.random.key(0),
        planner=planner,
        config=config,
    )
    assert result.ok, str(result)
    np.testing.assert_allclose(result.path[[0, -1]], [START, near], atol=1e-5)
    np.testing.assert_allclose(result.trajectory[[0, -1]], [START, near], atol=1e-5)
    steps = np.linalg.norm(np.diff(result.trajectory, axis=0), axis=1)
    assert steps.max() <= config.budget.verify_step + 1e-5
    assert result.loss <= result.match_threshold and result.advice == ""


def test_rrt_is_keeps_every_sub_step(panda, wall_world):
    """Sub-steps are nodes as far apart as the checks, on edges of the plain tree."""
    goal = ConfigurationGoal(q=jnp.asarray(GOAL))
    policy = RRT(intermediate=True, keep_partial=True)
    tree = search(
        wall_world,
        goal,
        policy,
        policy.init(wall_world, goal, START[None], 8192),
        key=jax.random.key(0),
        termination=make_termination(-1.0, max_iterations=3),
    ).tree
    size = int(tree.size)
    scored = np.isfinite(np.asarray(tree.score[:size]))
    assert 1 < scored.sum() < size / 4  # sub-steps have no score
    np.testing.assert_allclose(with_costs(wall_world, tree).cost, tree.cost, atol=2e-4)
    first = np.asarray(tree.q[1:size])[np.asarray(tree.parent[1:size]) == 0]
    lengths = np.sort(np.linalg.norm(first - START, axis=1))
    assert lengths[0] <= float(wall_world.resolution) + 1e-5


def test_rrt_connect_gives_up_a_sixteenth_of_blocked_edges_however_fine_they_are(wall_world):
    for resolution, steps in ((0.02, 128), (0.005, 512)):
        world = dataclasses.replace(wall_world, resolution=jnp.float32(resolution))
        policy = PLANNERS["rrt-connect"].for_world(world)
        assert (policy.edge_steps, policy.edge_slack) == (steps, steps // 16)


def test_rrt_connect_samples_around_its_roots_at_all_scales(wall_world, connected):
    policy = RRTConnect.for_world(wall_world, lanes=256)
    sample = np.asarray(policy._samples(wall_world, connected.tree, jax.random.key(0)))
    lane = np.arange(256)
    is_at_root = (lane // 2 % 4 == 1) & (lane // 8 % 2 == 0)
    roots = np.asarray(connected.tree.q)[lane % 2]
    apart = np.linalg.norm(sample - roots, axis=1)[is_at_root]
    assert len(apart) == 32 and apart.min() >= 1 / 3 - 1e-3 and apart.max() <= 3 + 1e-3
    assert apart.min() < 0.6 and apart.max() > 2.0


def test_rrt_connect_of_two_lanes_draws_samples_of_all_kinds_for_both_trees(wall_world, connected):
    goal, policy = ConfigurationGoal(q=jnp.asarray(GOAL)), RRTConnect(lanes=2)
    draw = jax.jit(policy.propose)
    sides, samples = set(), []
    for key in jax.random.split(jax.random.key(0), 200):
        proposals = draw(wall_world, goal, connected.tree, key)
        sides.add(int(proposals.aux.side[0]))
        samples.append(np.asarray(proposals.target[0]))
    apart = np.min(np.linalg.norm(np.array(samples)[:, None] - [START, GOAL], axis=2), axis=1)
    assert sides == {0, 1} and apart.min() < 0.5
    lower, upper = np.minimum(START, GOAL) - 1, np.maximum(START, GOAL) + 1
    outside = np.any((samples < lower - 0.01) | (samples > upper + 0.01), axis=1)
    assert 40 < outside.sum() < 160  # a quarter is anywhere, another around nodes


def test_rrt_connect_of_an_arm_keeps_nothing_of_blocked_edges_to_the_other_tree(
    wall_world, connected
):
    goal = ConfigurationGoal(q=jnp.asarray(GOAL))
    for policy, kept in ((RRTConnect.for_world(wall_world), False), (RRTConnect(), True)):
        tree = policy.init(wall_world, goal, START[None], 64)
        proposals = policy.propose(wall_world, goal, tree, jax.random.key(0))
        connects = np.asarray(proposals.aux.connects)
        assert connects.any() and not connects.all()
        assert np.all(np.asarray(proposals.partial) == (kept | ~connects))
