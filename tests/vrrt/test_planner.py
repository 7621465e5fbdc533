"""Planning from the outside: goals, planners, no re-compilation, attempts, batches."""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import Q_GOAL, Q_START, picture

import vrrt_jax
from vrrt_jax import ImageGoal
from vrrt_jax import attempts as attempts_module
from vrrt_jax.core import search as searches
from vrrt_jax.core import tree as trees
from vrrt_jax.core.result import with_time_of


def test_plan_finds_the_pose_and_new_numbers_do_not_retrace(
    panda, self_model, camera, image, open_world
):
    searches._chunk.clear_cache()

    def run(world=open_world, image=image, q_start=Q_START, model=self_model, changes=None):
        return vrrt_jax.plan(
            panda,
            world,
            ImageGoal(model, camera, image),
            q_start,
            key=jax.random.key(0),
            config=vrrt_jax.PlannerConfig().changed(changes or {}),
        )

    result = run()
    assert result.ok and result.verification is not None and result.verification.ok
    assert np.abs(result.q_goal - Q_GOAL).mean() < 0.05
    np.testing.assert_allclose(result.path[0], Q_START, atol=1e-6)
    assert result.draw.goal.image is image  # what notebooks show beside the end
    again = run()
    np.testing.assert_array_equal(result.path, again.path)

    moved = vrrt_jax.move_obstacle(open_world, "ball", position=(0.0, -0.9, 0.9))
    lighter = dataclasses.replace(
        self_model,
        levels=tuple(
            dataclasses.replace(
                level, splats=dataclasses.replace(level.splats, rgb=0.9 * level.splats.rgb)
            )
            for level in self_model.levels
        ),
    )
    before = searches._chunk._cache_size()
    assert 1 <= before <= 2  # one of the visual search, one of the connection to its match
    few = {"budget.max_iterations": 4, "budget.attempts": 1}
    run(world=moved, changes=few)
    run(image=picture(panda, self_model, camera, Q_GOAL + 0.1), changes=few)
    run(q_start=Q_START + 0.1, changes=few)
    run(model=lighter, changes=few)
    own = {"radius": 1.0, "samples": 64, "jumps": 1, "steps": 3, "young": 1, "alpha": 0.02}
    run(changes=few | {f"lineages.{name}": value for name, value in own.items()})
    run(changes=few | {"expand.beta1": 0.5, "expand.beta2": 0.5})
    assert searches._chunk._cache_size() == before


def test_batch_equals_single_plans(panda, self_model, camera, image, open_world):
    config = vrrt_jax.PlannerConfig().changed(
        {
            "budget.max_iterations": 10,
            "budget.settle_iterations": 0,
            "budget.attempts": 1,
            "polish.hypotheses": 0,
            "lineages.trees": 1,  # as in a batch
        }
    )
    other = picture(panda, self_model, camera, Q_GOAL + 0.2)
    key = jax.random.key(5)
    starts = np.stack([Q_START, Q_START + 0.05])
    batch = vrrt_jax.plan_batch(
        panda, open_world, self_model, camera, [image, other], starts, key=key, config=config
    )
    for i, goal in enumerate((image, other)):
        single = vrrt_jax.plan(
            panda,
            open_world,
            ImageGoal(self_model, camera, goal),
            starts[i],
            key=jax.random.fold_in(key, i),
            config=config,
        )
        size = int(single.tree.size)
        assert int(batch[i].tree.size) == size
        assert batch[i].status is single.status
        assert batch[i].draw.goal.image is goal
        # Sums of floats differ in order, and sign-like Adam steps amplify it: compare early nodes.
        np.testing.assert_allclose(batch[i].tree.q[:80], single.tree.q[:80], atol=1e-3)


def test_goals_are_visited_in_turn(panda, self_model, camera, image, open_world):
    run = {"key": jax.random.key(0)}
    shown, home = ImageGoal(self_model, camera, image), vrrt_jax.ConfigurationGoal(q=Q_START)
    legs = vrrt_jax.plan_waypoints(panda, open_world, [shown, home], Q_START, **run)
    assert [leg.ok for leg in legs] == [True, True]
    assert np.abs(legs[0].path[-1] - Q_GOAL).mean() < 0.05
    np.testing.assert_array_equal(legs[1].path[0], legs[0].path[-1])
    np.testing.assert_allclose(legs[1].path[-1], Q_START, atol=1e-3)
    way = np.concatenate([Q_START[None], *(leg.path[1:] for leg in legs)])
    assert vrrt_jax.verify_path(panda, open_world, way).ok
    # The first leg that fails is the last; nothing is planned where one goal makes no sense.
    short = vrrt_jax.PlannerConfig().changed({"budget.time_limit_s": 1e-9})
    legs = vrrt_jax.plan_waypoints(
        panda, open_world, [shown, home], Q_START, **run | {"config": short}
    )
    assert [leg.status for leg in legs] == [vrrt_jax.Status.TIME_LIMIT]
    far = vrrt_jax.ConfigurationGoal(q=Q_START + 9)
    for goals, told in (([shown, far], "goal 1: .*limit"), ([], "empty list")):
        with pytest.raises(ValueError, match=told):
            vrrt_jax.plan_waypoints(panda, open_world, goals, Q_START, **run)


def test_the_short_form_is_an_image_goal(panda, self_model, camera, image, open_world):
    config = vrrt_jax.PlannerConfig().changed({"budget.max_iterations": 3, "budget.attempts": 1})
    mask = np.ones(image.shape[:2], bool)
    mask[360:] = False
    run: dict = {"key": jax.random.key(3), "config": config}
    short = vrrt_jax.plan(panda, open_world, self_model, camera, image, Q_START, mask=mask, **run)
    goal = ImageGoal(self_model, camera, image, mask)
    long = vrrt_jax.plan(panda, open_world, goal, q_start=Q_START, **run)
    np.testing.assert_array_equal(short.path, long.path)
    assert short.loss == long.loss
    with pytest.raises(ValueError, match=r"expected ImageGoal\(..., mask=mask\)"):
        vrrt_jax.plan(panda, open_world, goal, Q_START, mask=mask, **run)
    with pytest.raises(ValueError, match="got 1 inputs after the goal; expected camera"):
        vrrt_jax.plan(panda, open_world, self_model, Q_START, **run)  # type: ignore[call-overload]


def test_holes_in_the_image_are_planned_around(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=3)
    mask = np.random.default_rng(0).random(image.shape[:2]) < 0.9
    mask[360:] = False  # the foot of the robot
    holed = np.where(mask[..., None], image, 1.0)
    key = jax.random.key(2)
    result = vrrt_jax.plan(
        panda, open_world, self_model, camera, holed, Q_START, key=key, mask=mask
    )
    assert result.ok, str(result)
    assert np.abs(result.q_goal - Q_GOAL).max() < 0.05


def test_another_attempt_while_nothing_matches(
    panda, self_model, camera, image, open_world, monkeypatch
):
    brief = {"lineages.samples": 32, "lineages.jumps": 6, "lineages.young": 0, "lineages.steps": 1}
    config = vrrt_jax.PlannerConfig().changed(brief | {"match.scale": 1e-6, "polish.hypotheses": 0})
    args = (panda, open_world, self_model, camera, image, Q_START)
    results, begun = [], []
    for attempts in (1, 3):
        seen = []
        results.append(
            vrrt_jax.plan(
                *args,
                key=jax.random.key(0),
                config=config.changed({"budget.attempts": attempts}),
                on_progress=lambda state, seconds: seen.append(int(state.tree.iteration)),  # noqa: B023
            )
        )
        begun.append(1 + int(np.sum(np.diff(seen) <= 0)))
    assert begun == [1, 3]
    assert all(r.status is vrrt_jax.Status.NO_MATCH for r in results)
    assert results[1].loss <= results[0].loss
    spent = with_time_of(results[0], *results).timing["search_s"]
    assert spent == results[0].timing["search_s"] + results[1].timing["search_s"]

    ended = dataclasses.replace(results[1], status=vrrt_jax.Status.INTERRUPTED, loss=0.0)
    attempts = iter([results[0], ended])  # whose losses are of other images
    monkeypatch.setattr(attempts_module, "attempt", lambda *_: next(attempts))
    result = vrrt_jax.plan(*args, key=jax.random.key(0), config=config)
    assert result.status is vrrt_jax.Status.INTERRUPTED and result.loss == results[0].loss

    # Attempts that agree on what does not match say so.
    rough = dataclasses.replace(results[0], loss=1.24 * results[0].match_threshold)
    monkeypatch.setattr(attempts_module, "attempt", lambda *_: rough)
    result = vrrt_jax.plan(*args, key=jax.random.key(0), config=config)
    assert result.advice.startswith("6 of 6 attempts end at the same pose")
    scale = float(result.advice.split("match.scale=")[1].split()[0]) / config.match.scale
    assert 1.24 < scale < 1.5  # so that it would match

    # A match in doubt is looked for again, and longer if it is unlikely too; under another lamp
    # until it is found twice.
    threshold = results[0].match_threshold
    for loss, color, probability, apart, expected in (
        (0.4, 0.9, 0.3, 0.0, 1),
        (0.6, 0.9, 0.8, 0.0, 3),
        (0.4, 1.1, 0.8, 0.0, 3),
        (0.6, 0.9, 0.3, 0.0, 6),
        (0.6, 2.1, 0.3, 0.0, 2),
        (0.6, 2.1, 0.8, 0.2, 3),
        (0.6, 2.1, 0.3, 0.2, 6),
    ):
        match = dataclasses.replace(
            results[0],
            status=vrrt_jax.Status.SOLVED,
            loss=loss * threshold,
            colored_loss=color * threshold,
            match_probability=probability,
        )
        attempts = itertools.count(1)

        def attempt(*_, match=match, attempts=attempts, apart=apart):
            return dataclasses.replace(match, target=match.target + apart * next(attempts))

        monkeypatch.setattr(attempts_module, "attempt", attempt)
        assert vrrt_jax.plan(*args, key=jax.random.key(0), config=config).ok
        assert next(attempts) - 1 == expected


def test_a_guess_becomes_a_root(panda, self_model, camera, image, open_world):
    config = vrrt_jax.PlannerConfig().changed({"budget.max_iterations": 3, "polish.hypotheses": 0})
    args = (panda, open_world, self_model, camera, image, Q_START)
    told = vrrt_jax.plan(*args, key=jax.random.key(0), config=config, q_guess=Q_GOAL + 0.05)
    np.testing.assert_allclose(told.tree.q[1], Q_GOAL + 0.05, atol=1e-6)
    other = vrrt_jax.plan(*args, key=jax.random.key(0), config=config, q_guess=Q_START + 0.05)
    assert told.loss < other.loss
    with pytest.raises(ValueError, match="the guess is outside the limits: joint 'joint4'"):
        vrrt_jax.plan(*args, key=jax.random.key(0), config=config, q_guess=np.zeros(7) + 1)


TURNTABLE = """<mujoco><worldbody><body name="arm"><joint name="turn" axis="0 0 1" limited="false"/>
<geom type="sphere" size="0.05" pos="0.3 0 0"/></body></worldbody></mujoco>"""


def test_paths_go_on_where_a_joint_wraps(tmp_path, panda):
    (tmp_path / "turntable.xml").write_text(TURNTABLE)
    robot = vrrt_jax.load_robot(tmp_path / "turntable.xml")
    world = vrrt_jax.build_world(robot, [])
    q_start, q_goal = np.array([3.0 + 2 * np.pi]), np.array([-3.0])
    result = vrrt_jax.plan_to_configuration(robot, world, q_start, q_goal, key=jax.random.key(0))
    assert result.ok and np.isnan(result.clearance)  # there is nothing to keep away from
    assert result.path[0] == pytest.approx(q_start, abs=1e-5)
    assert result.path[-1] == pytest.approx(4 * np.pi - 3.0, abs=1e-5)
    with pytest.raises(ValueError, match="the world is of a robot with joints turn; this one"):
        vrrt_jax.plan_to_configuration(panda, world, Q_START, Q_GOAL, key=jax.random.key(0))


def test_joint_goals(panda, wall_world):
    goal = Q_START * np.array([-1, 1, 1, 1, 1, 1, 1], np.float32)
    result = vrrt_jax.plan_to_configuration(panda, wall_world, Q_START, goal, key=jax.random.key(0))
    assert result.ok
    np.testing.assert_allclose(result.path[[0, -1]], [Q_START, goal], atol=1e-5)
    with pytest.raises(ValueError, match="unknown planner 'prm'; have: rrt, rrt-star"):
        vrrt_jax.plan_to_configuration(
            panda, wall_world, Q_START, goal, key=jax.random.key(0), planner="prm"
        )


@vrrt_jax.pytree
class HandGoal(vrrt_jax.LeastSquaresGoal):
    """The hand should be at a place: a goal of somebody's own."""

    place: jax.Array  # (3,) [m]
    threshold: Any = 1e-5  # [m^2]

    def residual(self, world, q):
        return vrrt_jax.link_poses(world.chain, q)[-1, :3, 3] - self.place


def test_a_goal_of_ones_own(panda, open_world):
    place = vrrt_jax.link_poses(panda.chain, jnp.asarray(Q_GOAL))[-1, :3, 3]
    result = vrrt_jax.plan(panda, open_world, HandGoal(place=place), Q_START, key=jax.random.key(0))
    assert result.ok, str(result)
    hand = vrrt_jax.link_poses(panda.chain, jnp.asarray(result.path[-1]))[-1, :3, 3]
    assert float(jnp.linalg.norm(hand - place)) < 4e-3
    with pytest.raises(ValueError, match="'rrt-connect' needs a ConfigurationGoal"):
        vrrt_jax.plan(
            panda,
            open_world,
            HandGoal(place=place),
            Q_START,
            key=jax.random.key(0),
            planner="rrt-connect",
        )


def test_what_is_no_goal_and_what_is_no_planner_is_refused(panda, open_world):
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="the goal ndarray lacks loss, threshold"):
        vrrt_jax.plan(panda, open_world, Q_GOAL, Q_START, key=key)
    goal = vrrt_jax.ConfigurationGoal(q=Q_GOAL)
    with pytest.raises(ValueError, match="the planner RRT is a class; expected an object"):
        vrrt_jax.plan(panda, open_world, goal, Q_START, key=key, planner=vrrt_jax.RRT)
    with pytest.raises(ValueError, match="the planner object lacks edge_steps, lanes, init"):
        vrrt_jax.plan(panda, open_world, goal, Q_START, key=key, planner=object())


def test_a_batch_has_goals_of_one_kind(panda, open_world, self_model, camera, image):
    goals = [vrrt_jax.ConfigurationGoal(q=Q_GOAL), ImageGoal(self_model, camera, image)]
    starts = np.stack([Q_START] * 2)
    with pytest.raises(ValueError, match="problem 1: the goal is an object of ImageGoal, that"):
        vrrt_jax.plan_batch(panda, open_world, goals, starts, key=jax.random.key(0))


def test_what_does_not_go_with_a_goal_is_refused(panda, open_world, self_model, camera, image):
    key, goal = jax.random.key(0), vrrt_jax.ConfigurationGoal(q=Q_GOAL)
    with pytest.raises(ValueError, match="q_guess is for goals that are not known"):
        vrrt_jax.plan(panda, open_world, goal, Q_START, key=key, q_guess=Q_GOAL)
    image_goal = ImageGoal(self_model, camera, image)
    with pytest.raises(ValueError, match="'RRT' needs a ConfigurationGoal, and the goal"):
        vrrt_jax.plan(panda, open_world, image_goal, Q_START, key=key, planner=vrrt_jax.RRT())
    planner = vrrt_jax.RRTStar(intermediate=True)
    with pytest.raises(ValueError, match="keeps no sub-steps as nodes"):
        vrrt_jax.plan(panda, open_world, goal, Q_START, key=key, planner=planner)


def test_expansions_count_the_planners_own_lanes(panda, open_world):
    result = vrrt_jax.plan_to_configuration(
        panda, open_world, Q_START, Q_GOAL, key=jax.random.key(0), planner=vrrt_jax.RRT(lanes=8)
    )
    assert result.expansions == 8 * result.iterations > 0
    assert f"{result.expansions} expansions" in str(result)


def test_a_path_that_does_not_begin_at_the_start_is_told(panda, open_world):
    class Forgetful(vrrt_jax.RRT):
        def extract_path(self, tree):
            return super().extract_path(tree)[1:]

    goal = vrrt_jax.ConfigurationGoal(q=Q_GOAL)
    with pytest.raises(ValueError, match="Forgetful.extract_path returned begins at"):
        vrrt_jax.plan(panda, open_world, goal, Q_START, key=jax.random.key(0), planner=Forgetful())


def test_the_score_of_a_planner_is_not_believed_as_a_loss(panda, open_world):
    place = vrrt_jax.link_poses(panda.chain, jnp.asarray(Q_GOAL))[-1, :3, 3]
    goal = HandGoal(place=place)
    config = vrrt_jax.PlannerConfig().changed(
        {"polish.hypotheses": 0, "budget.max_iterations": 2, "budget.attempts": 1}
    )
    result = vrrt_jax.plan(
        panda,
        open_world,
        goal,
        Q_START,
        key=jax.random.key(0),
        planner=FlatScores(),
        config=config,
    )
    assert not result.ok
    expected = goal.loss(open_world, jnp.asarray(result.target))
    assert result.loss == pytest.approx(float(expected), rel=1e-4)


@vrrt_jax.pytree
class FlatScores:
    """A planner whose scores are no losses."""

    lanes: int = vrrt_jax.static(default=8)
    edge_steps: int = vrrt_jax.static(default=8)

    def init(self, world, goal, q_roots, capacity):
        return trees.create(jnp.asarray(q_roots), jnp.full(len(q_roots), 1e-9), None, capacity)

    def goal_score(self, goal):
        return float(goal.threshold)

    def propose(self, world, goal, tree, key):
        step = 0.1 * jax.random.normal(key, (self.lanes, tree.q.shape[1]))
        yes = jnp.ones(self.lanes, bool)
        parent = jnp.zeros(self.lanes, jnp.int32)
        target = tree.q[parent] + step
        return vrrt_jax.Proposals(parent=parent, target=target, valid=yes, partial=yes, aux=None)

    def evaluate(self, world, goal, q, proposals):
        return jnp.full(self.lanes, 1e-9), None

    def after_insert(self, world, goal, tree, proposals, expansion):
        return tree

    def extract_path(self, tree):
        return trees.best_path(tree)
