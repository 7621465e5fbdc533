"""What training minimizes, and how a trained network is judged on homes held out."""

import functools
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import scipy.stats

from nrp_jax.learning import models
from nrp_jax.learning.batches import Batch, Examples, make_batch
from nrp_jax.learning.models import ModelConfig
from nrp_jax.scene.robots import MobileRobot


def init(config: ModelConfig, module: nn.Module, batch: Batch, key: jax.Array) -> dict[str, Any]:
    """Random variables of a module."""
    last = batch.relation if config.kind == "discriminator" else key
    return jax.jit(module.init)(key, batch.image, batch.start, batch.goal, batch.waypoints, last)


def loss_fn(
    config: ModelConfig,
    module: nn.Module,
    variables: dict[str, Any],
    batch: Batch,
    key: jax.Array,
    train: bool = False,
):
    """Compute the loss of a batch.

    Args:
        config: of the model.
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
    return loss, (error, changed)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _evaluate(config, module, robot, variables, examples, chosen, key):
    batch = make_batch(config, robot, examples, chosen)
    loss, (outputs, _) = loss_fn(config, module, variables, batch, key)
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
