"""From the ends of a search to a result: rivals, and matches without a way."""

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import HALF_TURNED, Q_GOAL, Q_START, picture

import vrrt_jax
from vrrt_jax import ImageGoal, PlannerConfig, VisualRRT
from vrrt_jax.core import tree as trees
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.search import SearchResult, StopReason
from vrrt_jax.visual import finish
from vrrt_jax.visual.join import join
from vrrt_jax.visual.polish import Polished
from vrrt_jax.visual.problem import make_problem


def finished(tree):
    return SearchResult(
        tree=tree,
        stopped=StopReason.REACHED,
        history=np.zeros((1, 6)),
        compile_s=0.0,
        search_s=0.0,
    )


def test_ambiguous_goals_are_told(panda, self_model, camera, open_world):
    """With a slack threshold, the hand after half a turn matches too: both ends are named."""
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    config = PlannerConfig().changed({"match.scale": 20.0})
    problem = make_problem(panda, ImageGoal(self_model, camera, image), Q_START, config)
    roots = np.stack([Q_START, Q_GOAL, HALF_TURNED])
    policy = VisualRRT.from_config(config, open_world)
    found = finished(policy.init(open_world, problem.goal, roots, config.tree.capacity))
    args = (panda, open_world, problem, policy, found, Q_START, jax.random.key(0), config)
    result = finish.finish_visual(*args)
    assert result.ok and result.match_probability > 0.5
    np.testing.assert_allclose(result.target, Q_GOAL, atol=0.02)
    assert len(result.alternatives) == 0  # an exact image tells them apart
    result = finish.finish_visual(*args[:-1], config.changed({"match.ambiguity": 1e9}))
    apart = np.abs(result.alternatives - HALF_TURNED).max(axis=1)
    assert len(apart) >= 1 and apart.min() < 0.3
    assert f"ambiguous: {len(apart)} other" in str(result)


def beside(y):
    """A box that leaves ``y`` - 0.15 m to the slider that passes it."""
    return vrrt_jax.Obstacle(name="box", kind="box", position=(0, y, 0), size=(0.05, 0.05, 0.05))


class NoPassage(vrrt_jax.ClosedFormWorld):
    """A world where nobody passes x = 0, which no obstacle tells."""

    def is_free(self, q):
        return super().is_free(q) & (jnp.abs(q[0]) > 0.05)


def test_a_way_obeys_an_is_free_of_ones_own(slider):
    world = vrrt_jax.build_world(slider, [], engine="closed_form")
    ends = np.array([[-0.5], [0.5]], np.float32)
    found = finished(trees.create(jnp.asarray(ends[:1]), jnp.zeros(1), None, 8))
    few = PlannerConfig().changed({"tree.lanes": 4, "budget.connect_iterations": 5})
    key = jax.random.key(0)
    assert join(world, RRTConnect.for_world(world), found, ends[1], key, few)[1] is not None
    fields = {field.name: getattr(world, field.name) for field in dataclasses.fields(world)}
    zone = NoPassage(**fields)
    assert join(zone, RRTConnect.for_world(zone), found, ends[1], key, few)[1] is None
    with pytest.raises(ValueError, match="the start is refused by NoPassage.is_free"):
        vrrt_jax.plan_to_configuration(slider, zone, [0.0], [0.5], key=jax.random.key(0))


def reached(q, loss, uncertainty):
    """Polished configurations that are all free."""
    uncertainty = np.full(q.shape, uncertainty)
    return Polished(q=q, loss=loss, colored_loss=loss, cost=loss, uncertainty=uncertainty)


def test_a_match_without_a_way_is_told(slider, monkeypatch):
    """What can be reached but does not match is no substitute for it."""
    world = vrrt_jax.build_world(slider, [beside(0.1)], engine="closed_form")
    start = np.array([-0.5], np.float32)
    q = np.array([[-0.4], [0.5]], np.float32)
    losses = np.array([2.0, 0.5])
    polished = reached(q, losses, 0.1)
    monkeypatch.setattr(finish, "polish", lambda *_: polished)
    found = finished(trees.create(jnp.asarray(start[None]), jnp.ones(1), None, 8))
    config = PlannerConfig().changed(
        {"tree.lanes": 4, "tree.capacity": 64, "budget.connect_iterations": 5}
    )
    goal = types.SimpleNamespace(threshold=1.0)
    problem: Any = types.SimpleNamespace(goal=goal, polishing=goal)
    args = (slider, world, problem, VisualRRT(), found, start, jax.random.key(0), config)
    result = finish.finish_visual(*args)
    assert result.status is vrrt_jax.Status.NO_PATH and result.target == q[1]
    assert len(result.alternatives) == 0 and result.verification is None
    assert "move the obstacles" in result.advice
    polished = reached(q, np.ones(2), 1.0)
    result = finish.finish_visual(*args)
    assert result.ok and result.target == q[0] and result.joint_uncertainty == 1.0
    assert "may be off: slide by 1" in result.advice
    polished = dataclasses.replace(reached(q, losses, 1.0), cost=np.full(2, np.inf))
    result = finish.finish_visual(*args)
    assert result.status is vrrt_jax.Status.NO_PATH and result.target == q[1]
    assert result.advice == "all that was found is in collision: move the obstacles"


def test_of_matches_that_look_the_same_cost_and_distance_decide(slider):
    world = vrrt_jax.build_world(slider, [], engine="closed_form")
    near, far = q = np.array([[0.3], [0.6]], np.float32)

    def taken(costs):
        polished = dataclasses.replace(reached(q, np.full(2, 0.5), 0.1), cost=np.array(costs))
        ends = finish._polished_ends(world, polished, 1.0, np.zeros(1, np.float32), PlannerConfig())
        assert sorted(ends.rivals) == [0, 1]
        return ends.q[ends.order[0]]

    assert taken([1.0, 1.0]) == near and taken([1.01, 1.0]) == near
    assert taken([1.05, 1.0]) == far  # the image tells them apart


@pytest.mark.parametrize("time_limit_s", [np.inf, 0.0])
def test_a_match_is_missed_before_a_way(slider, monkeypatch, time_limit_s):
    """Also where the time ran out on the way to what matches nothing."""
    world = vrrt_jax.build_world(slider, [beside(0.1)], engine="closed_form")
    q = np.array([[0.5]], np.float32)  # behind the obstacle
    polished = reached(q, np.array([2.0]), 1.0)
    monkeypatch.setattr(finish, "polish", lambda *_: polished)
    start = np.array([-0.5], np.float32)
    found = finished(trees.create(jnp.asarray(start[None]), jnp.ones(1), None, 8))
    config = PlannerConfig().changed(
        {"tree.lanes": 4, "tree.capacity": 64, "budget.connect_iterations": 5}
    )
    config = config.changed({"budget.time_limit_s": time_limit_s})
    goal = types.SimpleNamespace(threshold=1.0)
    problem: Any = types.SimpleNamespace(goal=goal, polishing=goal)
    args = (slider, world, problem, VisualRRT(), found, start, jax.random.key(0), config)
    result = finish.finish_visual(*args)
    assert result.status is vrrt_jax.Status.NO_MATCH and result.verification is None
    assert result.loss == 2.0 and "check the camera" in result.advice
    # If the time ended the search itself, that is what failed first.
    early = dataclasses.replace(found, stopped=StopReason.TIME_LIMIT)
    early_problem: Any = types.SimpleNamespace(
        goal=types.SimpleNamespace(threshold=0.1), polishing=None
    )
    result = finish.finish_visual(*args[:2], early_problem, VisualRRT(), early, *args[5:])
    assert result.status is vrrt_jax.Status.TIME_LIMIT
