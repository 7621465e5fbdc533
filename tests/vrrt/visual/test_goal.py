"""Image goals: losses and residuals agree, several views, masks, losses of one's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import Q_GOAL, Q_START, picture

import vrrt_jax
from vrrt_jax import ImageGoal, ImageObjective
from vrrt_jax.visual.problem import make_problem

pytestmark = pytest.mark.light_compilation

IMAGE_PX = 64


def test_residuals_make_the_loss(panda, self_model, camera, image, open_world, rng):
    mask = rng.random(image.shape[:2]) < 0.8
    goal = ImageGoal(self_model, [camera, camera], [image, image], [mask, mask])
    objective = goal.at(panda, IMAGE_PX)
    assert 0.5 < float(objective.image.valid.mean()) < 0.9
    q = jnp.asarray(Q_START)
    residual = jax.jit(objective.residual)(open_world, q)
    loss = jax.jit(objective.loss)(open_world, q)
    assert float(jnp.sum(residual**2)) == pytest.approx(float(loss), rel=1e-4)


def test_a_mask_that_hides_the_robot_is_refused(panda, self_model, camera, image, rng):
    hiding = image[..., 3] == 0
    with pytest.raises(ValueError, match="the masks leave nothing of the robot"):
        ImageGoal(self_model, camera, image, hiding).at(panda, IMAGE_PX)
    scattered = rng.random(image.shape[:2]) < 0.5  # of each shrunk pixel too little is left
    with pytest.raises(ValueError, match="the masks leave nothing of the robot on images of 60 px"):
        ImageGoal(self_model, camera, image, scattered).at(panda, IMAGE_PX)


def test_several_views(panda, self_model, camera, image, open_world):
    second = vrrt_jax.look_at((-0.4, 1.9, 0.9), (0.1, 0.0, 0.4), height=480, width=480)
    images = [image, picture(panda, self_model, second, Q_GOAL)]
    objective = ImageGoal(self_model, [camera, second], images).at(panda, IMAGE_PX)
    assert objective.image.rgb.shape[0] == 2
    loss = jax.jit(objective.loss)
    at_goal, at_start = (float(loss(open_world, jnp.asarray(q))) for q in (Q_GOAL, Q_START))
    assert at_goal < 0.1 * at_start


class HalfLoss(ImageObjective):
    """Half of the image loss."""

    def loss(self, world, q):
        return 0.5 * super().loss(world, q)


def test_a_loss_of_ones_own_reaches_search_polishing_and_match(
    panda, self_model, camera, image, open_world
):
    q = jnp.asarray(Q_START)
    losses = []
    for objective in (ImageObjective, HalfLoss):
        goal = ImageGoal(self_model, camera, image, objective=objective)
        problem = make_problem(panda, goal, Q_START, vrrt_jax.PlannerConfig())
        polishing = problem.polishing
        assert polishing is not None and polishing.close_up is not None
        stages = (
            problem.goal,
            polishing.coarse.goal,
            polishing.fine.goal,
            polishing.close_up.objective,
        )
        assert all(type(stage) is objective for stage in stages)
        loss = float(problem.goal.loss(open_world, q))
        residual = problem.goal.residual(open_world, q)
        assert float(jnp.sum(residual**2)) == pytest.approx(loss, rel=1e-4)
        losses.append(loss)
    assert losses[1] == pytest.approx(0.5 * losses[0], rel=1e-5)


class Silhouette(ImageObjective):
    """What the robot covers, whatever its color."""

    def residual(self, world, q):
        return super().residual(world, q).reshape(-1, 4)[:, 3]


def test_a_residual_of_ones_own_ignores_color(panda, self_model, camera, image, open_world):
    striped = image.copy()
    dark = np.arange(len(striped)) // 48 % 2 == 0  # wider than the pixels of the small image
    striped[dark, :, :3] = 0.0
    q = jnp.asarray(Q_GOAL)
    full, outline = (
        ImageGoal(self_model, camera, striped, objective=objective).at(panda, IMAGE_PX)
        for objective in (ImageObjective, Silhouette)
    )
    assert float(full.loss(open_world, q)) > 2 * float(outline.loss(open_world, q))
    assert float(outline.loss(open_world, q)) < float(outline.threshold)
    assert float(outline.loss(open_world, jnp.asarray(Q_START))) > 10 * float(outline.threshold)
