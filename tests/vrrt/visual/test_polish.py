"""Polishing: least squares where images tell little."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import HALF_TURNED, Q_GOAL, Q_START, picture

import vrrt_jax
import vrrt_jax.visual.polish as polish_module
from vrrt_jax import ImageGoal, PlannerConfig, PolishConfig
from vrrt_jax.visual.least_squares import derivatives, descend, evaluate_each, settle_each
from vrrt_jax.visual.polish import (
    _freed,
    _hand_goal,
    _settled_with_hand,
    joint_uncertainty,
    polish,
)
from vrrt_jax.visual.polish_samples import nearer_turns, redraw_outer
from vrrt_jax.visual.problem import make_problem


def polishing_of(panda, self_model, camera, image, config):
    problem = make_problem(panda, ImageGoal(self_model, camera, image), Q_START, config)
    assert problem.polishing is not None
    return problem.polishing


def test_steps_lead_where_the_gradient_does(panda, self_model, camera, image, open_world):
    """Differences that are too long lose the weak directions, where steps are the longest."""
    config = PlannerConfig(polish=PolishConfig(start_prior=0.0))
    coarse = polishing_of(panda, self_model, camera, image, config).coarse
    noise = np.random.default_rng(0).normal(size=(4, 7))
    q = (Q_GOAL + 0.03 * noise).astype(np.float32)
    gradient = jax.jit(jax.vmap(jax.grad(lambda q: coarse.goal.loss(open_world, q))))(q)
    model = derivatives(open_world, coarse, q)
    step = np.linalg.solve(model.matrix, model.slope[..., None])[..., 0]
    exact = np.linalg.solve(model.matrix, 0.5 * np.asarray(gradient)[..., None])[..., 0]
    np.testing.assert_allclose(step, exact, atol=0.1 * np.abs(exact).max())


def test_settling_ends_where_fresh_derivatives_at_each_step_do(
    panda, self_model, camera, open_world
):
    """Near a minimum the first derivatives serve all steps; the cost falls as far."""
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    fine = polishing_of(panda, self_model, camera, image, PlannerConfig()).fine
    q = Q_GOAL + 0.02 * np.random.default_rng(0).normal(size=(2, 7)).astype(np.float32)
    before = derivatives(open_world, fine, q)
    settled = settle_each(open_world, [fine, fine], q, 8)
    exact = descend(open_world, fine, q, 8)
    assert np.all(before.cost - settled.cost > 0.9 * (before.cost - exact.cost))
    assert np.all(settled.cost < 0.6 * before.cost)
    largest = np.abs(before.matrix).max()
    np.testing.assert_allclose(settled.matrix, before.matrix, atol=2e-3 * largest)


def test_soft_images_lead_back_from_farther_away(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    polishing = polishing_of(panda, self_model, camera, image, PlannerConfig())
    sharp = dataclasses.replace(
        polishing.soft, goal=dataclasses.replace(polishing.soft.goal, blocks=())
    )
    q = Q_GOAL + 0.3 * np.random.default_rng(0).normal(size=(8, 7)).astype(np.float32)
    led_back = []
    for objective in (polishing.soft, sharp):
        ends = descend(open_world, objective, q, 8)
        off = np.abs(ends.q - Q_GOAL)[:, :4]  # the image hardly tells the others
        led_back.append(np.mean(off.max(axis=1) < 0.1))
    assert led_back[0] >= led_back[1] + 0.25


def test_polishing_turns_the_wrist_back(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    config = PlannerConfig(polish=PolishConfig(hypotheses=2))
    polishing = polishing_of(panda, self_model, camera, image, config)
    turned = Q_GOAL + np.array([0.02, 0, -0.02, 0, 0.05, 0.05, 0.9], np.float32)
    found = polish(open_world, polishing, turned[None], 0)
    assert found.loss[0] < polishing.threshold and np.all(np.diff(found.cost) >= 0)
    assert np.abs(np.asarray(found.q[0]) - Q_GOAL).max() < 0.05
    inside_ball = vrrt_jax.move_obstacle(
        open_world, "ball", position=_hand_position(panda, Q_GOAL), size=(0.2, 0, 0)
    )
    found = polish(inside_ball, polishing, turned[None], 0)
    assert not np.isfinite(found.cost).any()  # what matches is in collision


def test_in_strange_light_colors_count_less(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    image[..., :3] *= np.linspace(0.1, 1.0, image.shape[1])[:, None]  # a lamp at the side
    polishing = polishing_of(panda, self_model, camera, image, PlannerConfig())
    assert float(polishing.as_judged.fine.goal.color_weight) < 0.2 * float(
        polishing.fine.goal.color_weight
    )
    ends = polish(open_world, polishing, Q_GOAL[None], seed=0)
    assert ends.loss[0] < polishing.threshold < ends.colored_loss[0]
    assert ends.cost[0] < ends.colored_loss[0]
    assert np.mean(np.abs(ends.q[0] - Q_GOAL)) < 0.02


def test_a_close_up_tells_half_a_turn(panda, self_model, camera, open_world):
    image = picture(panda, self_model, camera, Q_GOAL, level=3)
    polishing = polishing_of(panda, self_model, camera, image, PlannerConfig())
    assert polishing.close_up is not None
    hand, threshold = _hand_goal(open_world, polishing.fine, polishing.close_up, Q_GOAL)
    assert hand.goal.image.rgb.shape[1:3] == (polishing.close_up.px,) * 2
    q = np.stack([Q_GOAL, HALF_TURNED])
    losses = [evaluate_each(open_world, at, q)[0] for at in (polishing.fine, hand)]
    fine, close = (loss[1] / loss[0] for loss in losses)
    assert close > fine > 1 and losses[1][0] < threshold


def test_a_wrong_hand_is_drawn_anew_on_the_close_up(
    panda, self_model, camera, open_world, monkeypatch
):
    image = picture(panda, self_model, camera, Q_GOAL, level=3)
    polishing = polishing_of(panda, self_model, camera, image, PlannerConfig())
    wrong = Q_GOAL + np.array([0, 0, 0, 0, 0.8, -0.5, 1.3], np.float32)
    ends = derivatives(open_world, polishing.fine, wrong[None])

    def found() -> float:
        rng = np.random.default_rng(0)
        ends_found = _settled_with_hand(open_world, polishing, polishing.close_up, ends, rng)
        return float(np.abs(ends_found.q[0] - Q_GOAL).max())

    assert found() > 0.5  # it fits too badly for more than its half turn and its twins
    monkeypatch.setattr(polish_module, "HAND_FAR", np.inf)
    assert found() < 0.02


def _hand_position(panda, q):
    return np.asarray(vrrt_jax.link_poses(panda.chain, jnp.asarray(q)))[-1, :3, 3].tolist()


def test_uncertainty_is_how_far_a_joint_goes_before_the_loss_has_risen_by_the_threshold():
    # Of a parabola in two joints that make up for each other, and a third that no pixel tells.
    matrix = np.array([[[4.0, 3.8, 0.0], [3.8, 4.0, 0.0], [0.0, 0.0, 0.0]]])
    off = joint_uncertainty(matrix, threshold=0.01)[0]
    assert off[2] == np.pi
    partner = -3.8 / 4.0 * off[0]  # where the second joint follows as it likes best
    moved = np.array([off[0], partner, 0.0])
    assert moved @ matrix[0] @ moved == pytest.approx(0.01, rel=1e-3)


def test_outer_joints_are_drawn_anew(panda, open_world, rng):
    q = np.stack([panda.home, panda.home + 0.1]).astype(np.float32)
    samples = redraw_outer(open_world, q, 400, rng)
    near = np.abs(samples - np.resize(q, samples.shape)) < 0.3
    # The first joint always stays, the last never, the others the more rarely the farther out.
    share = near.mean(axis=0)
    assert share[0] == 1.0 and np.all(np.diff(share) < 0.05) and share[-1] < 0.3
    few = redraw_outer(open_world, q, 400, rng, joints=2, spread=0.0) == np.resize(q, (400, 7))
    assert few[:, :5].all() and 0.3 < few[:, 5].mean() < 0.7 and not few[:, 6].any()


def test_of_whole_turns_the_next_to_the_start_is_taken():
    """A UR5e has room for two turns of most joints, and its elbow for one."""
    ur5e = vrrt_jax.load_robot("ur5e")
    world = vrrt_jax.build_world(ur5e, [], engine="closed_form")
    start = np.array([6.0, -1.5, 1.5, 0.0, 0.5, -6.0])
    q = np.array([[0.3, 4.5, -3.0, -6.0, 0.6, 0.0]])
    nearer = nearer_turns(world, q, start)
    # The first joint has no room for 0.3 + 2 pi, the elbow none for -3.0 + 2 pi.
    expected = [[0.3, 4.5 - 2 * np.pi, -3.0, -6.0 + 2 * np.pi, 0.6, -2 * np.pi]]
    np.testing.assert_allclose(nearer, expected)
    poses = [vrrt_jax.link_poses(ur5e.chain, jnp.asarray(a[0], jnp.float32)) for a in (q, nearer)]
    np.testing.assert_allclose(*poses, atol=1e-5)


def test_an_end_that_touches_gives_way_to_a_free_one_beside_it(panda, self_model, camera):
    hand, away = _hand_position(panda, Q_GOAL), 0.3
    for _ in range(20):  # a ball that the hand is in by 2 mm
        place = tuple(float(x) for x in hand + np.array([away, 0.0, 0.0]))
        ball = vrrt_jax.Obstacle(name="ball", kind="sphere", position=place, size=(0.03, 0.0, 0.0))
        world = vrrt_jax.build_world(panda, [ball], engine="closed_form")
        away -= float(world.obstacle_clearance(jnp.asarray(Q_GOAL))) + 0.002
    image = picture(panda, self_model, camera, Q_GOAL, level=2)
    fine = polishing_of(panda, self_model, camera, image, PlannerConfig()).fine
    q = np.stack([Q_GOAL, Q_START]).astype(np.float32)
    before = derivatives(world, fine, q)
    assert before.free.tolist() == [False, True]
    after = _freed(world, fine, before, 0)
    assert after.free.all() and bool(world.is_free(jnp.asarray(after.q[0])))
    assert np.abs(after.q[0] - Q_GOAL).mean() < 0.02
    assert before.cost[0] < after.cost[0] < before.cost[1]
    np.testing.assert_array_equal(after.q[1], before.q[1])
    # Deep inside nothing beside it is free: it stays as it is.
    ball = vrrt_jax.Obstacle(name="ball", kind="sphere", position=tuple(hand), size=(0.2, 0.0, 0.0))
    deep = vrrt_jax.build_world(panda, [ball], engine="closed_form")
    assert not _freed(deep, fine, derivatives(deep, fine, q[:1]), 0).free[0]
