"""What training minimizes, and how a trained network is judged on homes held out."""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from nrp_jax.homes.grid import RESOLUTION
from nrp_jax.learning import features, models
from nrp_jax.learning.batches import Batch, Examples, make_batch
from nrp_jax.learning.models import ModelConfig
from nrp_jax.scene.robots import MobileRobot

LATENTS = 8  # random ones of a query, the ways to whose waypoints are looked at
WAY_SAMPLES = 8  # places on each of these ways
CLEARANCE = 0.1  # distance to obstacles from which on a place is clear [m]


def init(config: ModelConfig, module: nn.Module, batch: Batch, key: jax.Array) -> dict[str, Any]:
    """Random variables of a module."""
    last = batch.relation if config.kind == "discriminator" else key
    return jax.jit(module.init)(key, batch.image, batch.start, batch.goal, batch.waypoints, last)


def loss_fn(
    config: ModelConfig,
    robot: MobileRobot,
    module: nn.Module,
    variables: dict[str, Any],
    batch: Batch,
    key: jax.Array,
    train: bool = False,
):
    """Compute the loss of a batch.

    Args:
        config: of the model.
        robot: whose configurations they are.
        module: from :func:`nrp_jax.learning.checkpoint.build_module`.
        variables: of the module.
        batch: of n queries.
        key: for the latents of a CVAE.
        train: normalize by this batch.

    Returns:
        The loss (); and a pair: logits (n, W) of a discriminator or the reconstruction error () of
        a CVAE, and the changed batch statistics.
    """
    last = batch.relation if config.kind == "discriminator" else key
    inputs = (batch.image, batch.start, batch.goal, batch.waypoints, last)
    outputs, changed = module.apply(variables, *inputs, train=train, mutable=["batch_stats"])
    if config.kind == "discriminator":
        return models.discriminator_loss(outputs, batch.target, batch.weight), (outputs, changed)
    loss, error, _ = models.cvae_loss(config, batch.waypoints, *outputs, mask=batch.weight)
    if config.blocked_weight:
        z = jax.random.normal(
            jax.random.fold_in(key, 1), (len(batch.start), LATENTS, config.latent)
        )
        made: Any = module.apply(
            variables, batch.image, batch.start, batch.goal, z, method=models.CVAE.decode
        )
        share = jnp.mean(blocked_share(config, robot, batch.image, batch.start, made))
        loss = loss + config.blocked_weight * share
    return loss, (error, changed)


def blocked_share(
    config: ModelConfig, robot: MobileRobot, image: jax.Array, start: jax.Array, made: jax.Array
) -> jax.Array:
    """How much of the ways from starts to generated waypoints obstacles block (n, C), 0 to 1.

    A place on a way counts as 0 if nothing is within ``CLEARANCE``, as 1 inside of obstacles, and
    else between. The gradient moves waypoints to where they can be reached. A CVAE that only
    repeats good waypoints does not learn that of what it generates between them.

    Args:
        config: of the CVAE.
        robot: whose configurations they are.
        image: (n, X, Y, Z) distances to obstacles around the starts [m].
        start: (n, E) features.
        made: (n, C, E) features of waypoints.
    """

    def one(image: jax.Array, start: jax.Array, made: jax.Array) -> jax.Array:
        # Features begin with the place of the base.
        begin, end = (
            features.standing_points(robot, q, features.generated_points(config, robot, q))
            for q in (start, made)
        )
        passed = features.passed_points(begin, end, WAY_SAMPLES)
        return jnp.mean(nn.relu(1.0 - features.interpolate(image, passed, RESOLUTION) / CLEARANCE))

    return jax.vmap(jax.vmap(one, (None, None, 0)))(image, start, made)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _evaluate(config, module, robot, variables, examples, chosen, key):
    batch = make_batch(config, robot, examples, chosen)
    loss, (outputs, _) = loss_fn(config, robot, module, variables, batch, key)
    return loss, outputs, batch.target, batch.weight


def validate(
    config: ModelConfig,
    module: nn.Module,
    robot: MobileRobot,
    variables: dict[str, Any],
    examples: Examples,
    chosen: np.ndarray,
    size: int = 64,
) -> dict[str, float]:
    """Measure ``loss`` and ``quality`` on chosen queries (n,).

    The quality of a discriminator is the area under its ROC curve, that of a CVAE is minus its
    reconstruction error.
    """
    # Batches of one size: the last is filled up with the first queries.
    parts = np.resize(chosen, (-(-len(chosen) // size), size))
    key = jax.random.key(0)
    found = [
        jax.device_get(_evaluate(config, module, robot, variables, examples, part, key))
        for part in parts
    ]
    loss = float(np.mean([part[0] for part in found]))
    if config.kind != "discriminator":
        return {"loss": loss, "quality": -float(np.mean([part[1] for part in found]))}
    logits, target, weight = (
        np.concatenate([part[i].ravel() for part in found]) for i in (1, 2, 3)
    )
    return {"loss": loss, "quality": ranking_quality(logits[weight > 0], target[weight > 0])}


def ranking_quality(score: np.ndarray, target: np.ndarray) -> float:
    """Area under the ROC curve: how often a good waypoint scores above a bad one.

    Args:
        score: (n,) of the waypoints.
        target: (n,) above one half for good waypoints.
    """
    good = target > 0.5
    ranks = scipy.stats.rankdata(score)
    pairs = max(1, good.sum() * (~good).sum())
    return float((ranks[good].sum() - good.sum() * (good.sum() + 1) / 2) / pairs)
