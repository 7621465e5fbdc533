"""What Visual-RRT is compared with: one gradient chain, alone, with a penalty, or with RRT*.

Dr.Robot (Liu et al., CoRL 2024) follows the image gradient from the start; its iterates are the
path. Prof.Robot (CVPR 2025) adds a penalty from a collision classifier, learned per scene
with an Eikonal term that keeps its gradient alive. All use the renderer, the self-models and the
optimizer of Visual-RRT.
"""

import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from vrrt_jax import checks
from vrrt_jax.config import Budget, PlannerConfig, TreeConfig
from vrrt_jax.core.edges import joint_error
from vrrt_jax.core.types import pytree
from vrrt_jax.planner import plan_to_configuration
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World, batch_is_free
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import Camera
from vrrt_jax.visual.descent import adam_descent
from vrrt_jax.visual.goal import ImageGoal, ImageObjective

WIDTH, DEPTH, JOINT_FEATURES = 128, 4, 8  # of the classifier; the paper's is 512 wide
SAMPLES = 200_000  # labeled configurations; the paper has 10 million
TRAIN_STEPS, TRAIN_BATCH, LEARNING_RATE = 1500, 4096, 1e-3
EIKONAL = 0.1  # weight of (|grad g| - 1)^2, as in the published code
PENALTY, PENALTY_MARGIN = 5.0, 0.1  # the planner's 5 relu(g + 0.1), likewise
MAX_STEPS = 1024  # of a chain
IMAGE_SCALE = 100.0  # mean squared errors are small beside the penalty


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChainConfig:
    """One Adam chain; what these settings reach was found not to gain from others."""

    steps: int = 300
    alpha: float = 0.04  # [rad]
    beta1: float = 0.9
    beta2: float = 0.9


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaselineResult:
    """Where a baseline went."""

    path: np.ndarray  # (P, D)
    loss: float  # image loss of its end
    match_threshold: float  # at or below which the image is matched
    found_path: bool  # False if there was an estimate of the goal, but no way to it
    search_s: float  # without compilation
    refused: int = 0  # paths that the exact check refused


@pytree
class Classifier:
    """A learned ``g(q)``, positive in collision."""

    params: Any
    center: jax.Array  # (D,) of the joints' ranges
    scale: jax.Array  # (D,) half of them

    def __call__(self, q: jax.Array) -> jax.Array:
        """Sign of collision () of a configuration (D,); about a distance [rad]."""
        return jnp.asarray(_Network().apply(self.params, (q - self.center) / self.scale))


class _Network(nn.Module):
    """Features of every joint, fed those of the joint before, into a leaky perceptron."""

    @nn.compact
    def __call__(self, q: jax.Array) -> jax.Array:
        features, parent = [], jnp.zeros(JOINT_FEATURES)
        for joint in range(q.shape[-1]):
            own = jnp.concatenate([q[joint : joint + 1], parent])
            parent = nn.leaky_relu(nn.Dense(JOINT_FEATURES)(own))
            features.append(parent)
        x = jnp.concatenate([*features, q])
        for _ in range(DEPTH):
            x = nn.leaky_relu(nn.Dense(WIDTH)(x))
        return nn.Dense(1)(x)[0]


def train_classifier(robot: Robot, world: World, *, seed: int = 0) -> tuple[Classifier, float]:
    """Learn where a scene is in collision (Prof.Robot).

    Args:
        robot: whose limits configurations are drawn from.
        world: what labels them.
        seed: of configurations and training.

    Returns:
        The classifier, and its accuracy on unseen configurations, the mean over the free and the
        colliding ones.
    """
    key = jax.random.key(seed)
    low, high = jnp.asarray(robot.lower, jnp.float32), jnp.asarray(robot.upper, jnp.float32)
    q = jax.random.uniform(key, (SAMPLES + SAMPLES // 10, len(low)), minval=low, maxval=high)
    labels = jnp.concatenate([~batch_is_free(world, part) for part in jnp.array_split(q, 100)])
    classifier = Classifier(
        params=_Network().init(key, jnp.zeros(len(low))),
        center=(low + high) / 2,
        scale=(high - low) / 2,
    )
    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, TRAIN_STEPS))
    share = jnp.mean(labels[:SAMPLES])
    weight = jnp.where(labels, 0.5 / share, 0.5 / (1.0 - share))
    params = _train(classifier, optimizer, q[:SAMPLES], labels[:SAMPLES], weight[:SAMPLES], key)
    classifier = dataclasses.replace(classifier, params=params)
    right = (jax.jit(jax.vmap(classifier))(q[SAMPLES:]) > 0) == labels[SAMPLES:]
    held_out = labels[SAMPLES:]
    accuracy = 0.5 * (jnp.mean(right, where=held_out) + jnp.mean(right, where=~held_out))
    return classifier, float(accuracy)


@functools.partial(jax.jit, static_argnums=1)
def _train(classifier, optimizer, q, labels, weight, key):
    """Parameters after balanced cross entropy with the Eikonal term; the sharpness is learned."""

    def loss(trained, rows):
        params, log_sharpness = trained
        g_and_gradient = jax.value_and_grad(dataclasses.replace(classifier, params=params).__call__)
        g, gradient = jax.vmap(g_and_gradient)(q[rows])
        logit = jnp.exp(log_sharpness) * g
        entropy = optax.sigmoid_binary_cross_entropy(logit, labels[rows].astype(logit.dtype))
        slope = jnp.sqrt(jnp.sum(gradient**2, axis=1) + 1e-12)
        return jnp.mean(weight[rows] * entropy) + EIKONAL * jnp.mean((slope - 1.0) ** 2)

    def step(i, carry):
        trained, state = carry
        rows = jax.random.randint(jax.random.fold_in(key, i), (TRAIN_BATCH,), 0, len(q))
        updates, state = optimizer.update(jax.grad(loss)(trained, rows), state)
        return optax.apply_updates(trained, updates), state

    trained = (classifier.params, jnp.log(10.0))
    trained, _ = jax.lax.fori_loop(0, TRAIN_STEPS, step, (trained, optimizer.init(trained)))
    return trained[0]


def dr_robot(
    robot: Robot,
    world: World,
    self_model: SelfModel,
    camera: Camera | Sequence[Camera],
    goal_image: np.ndarray | Sequence[np.ndarray],
    q_start: np.ndarray,
    *,
    config: ChainConfig | None = None,
    classifier: Classifier | None = None,
    mask: Any = None,
) -> BaselineResult:
    """Follow the image gradient from the start; the iterates up to the best are the path.

    Args:
        robot: as for :func:`vrrt_jax.plan`, and so are the next five.
        world: its obstacles are not looked at.
        self_model: of the robot.
        camera: of the goal image.
        goal_image: to match.
        q_start: (D,).
        config: settings, the default ones if None.
        classifier: adds the penalty of Prof.Robot.
        mask: as for :func:`vrrt_jax.plan`.
    """
    config = config or ChainConfig()
    q_start = checks.check_start(robot, world, q_start)
    checks.check_self_model(robot, self_model)
    goal = ImageGoal(self_model, camera, goal_image, mask).at(robot, TreeConfig().image_px)
    checks.check_cameras(robot, goal.splats, goal.cameras, q_start)
    numbers = jnp.float32([config.alpha, config.beta1, config.beta2])
    run = functools.partial(_chain, world, goal, classifier, jnp.asarray(q_start), numbers)
    jax.block_until_ready(run(1))
    started = time.perf_counter()
    q, losses = (np.asarray(a) for a in run(config.steps))
    best = int(np.argmin(losses))
    return BaselineResult(
        path=q[: best + 1],
        loss=float(losses[best]),
        match_threshold=float(goal.threshold),
        found_path=True,
        search_s=time.perf_counter() - started,
    )


@jax.jit
def _chain(world, goal: ImageObjective, classifier, q, numbers, steps):
    """Configurations (MAX_STEPS, D) and image losses; those beyond ``steps`` are infinite."""
    alpha, beta1, beta2 = numbers

    def objective(q):
        loss = goal.loss(world, q)
        total = IMAGE_SCALE * loss
        if classifier is not None:
            total += PENALTY * jax.nn.relu(classifier(q) + PENALTY_MARGIN)
        return total, loss

    def gradient(q):
        (_, loss), slope = jax.value_and_grad(objective, has_aux=True)(q)
        return slope, loss

    def observe(seen, i, q, loss):
        path, losses = seen
        return path.at[i].set(q), losses.at[i].set(loss)

    _, seen = adam_descent(
        world,
        gradient,
        q,
        steps=steps,
        step_size=lambda i: alpha,
        beta1=beta1,
        beta2=beta2,
        observe=observe,
        seen=(jnp.zeros((MAX_STEPS, len(q))), jnp.full(MAX_STEPS, jnp.inf)),
    )
    return seen


def rrt_star_to_estimate(
    robot: Robot, world: World, estimate: BaselineResult, *, key: jax.Array, iterations: int = 60
) -> BaselineResult:
    """Plan with RRT* from where :func:`dr_robot` began to where it ended.

    Args:
        robot: as for :func:`dr_robot`.
        world: robot and obstacles.
        estimate: of the goal.
        key: random key of RRT*.
        iterations: of RRT*, of 32 samples each.
    """
    q_start, q_goal = estimate.path[0], estimate.path[-1]
    if not bool(batch_is_free(world, jnp.asarray(q_goal)[None])[0]):
        return dataclasses.replace(estimate, found_path=False)
    found = plan_to_configuration(
        robot,
        world,
        q_start,
        q_goal,
        key=key,
        planner="rrt-star",
        config=PlannerConfig(budget=Budget(max_iterations=iterations)),
    )
    reached = len(found.path) > 1 or np.allclose(q_start, q_goal, atol=1e-3)
    reached &= bool(np.linalg.norm(joint_error(world, found.path[-1], q_goal)) < 1e-2)
    return BaselineResult(
        path=found.path,
        loss=estimate.loss,
        match_threshold=estimate.match_threshold,
        found_path=reached,
        search_s=estimate.search_s + found.timing["search_s"] + found.timing["shortcut_s"],
        refused=found.refused,
    )
