"""FIRE's network, which puts local primitives that are alike near each other.

A siamese network maps what is solid in a part of a home, and the query as seen from there, to a
latent. Its contrastive loss draws those that are alike together and drives the others apart, up to
a margin (Hadsell, Chopra and LeCun 2006; Chamzas et al. 2022). Sizes and rates are those that the
Neural Randomized Planner's authors published. Letters: ``n`` primitives, ``N`` entries of the
database, ``E`` features, ``D`` joints.
"""

import argparse
import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from nrp_jax.homes.grid import Grid
from nrp_jax.learning.data import fingerprint, load_dataset
from nrp_jax.learning.epochs import run_epochs
from nrp_jax.learning.experience_database import VERSION, Database, save_database
from nrp_jax.learning.models import FIRE
from nrp_jax.learning.primitives import (
    SIDE,
    Entries,
    Pairs,
    cells_of_parts,
    make_entries,
    make_pairs,
    query_features,
)
from nrp_jax.learning.training_io import State, claim_output_dir
from nrp_jax.scene.robots import MobileRobot, load_robot
from vrrt_jax.core.precision import single_precision

LATENT = 8
MARGIN = 0.5  # to which those that are not alike are driven apart, and within which all are near
FEW = 8  # pairs at a time, whose windows stay in the cache
MOST = 100_000  # entries that a database keeps; of more some are left out at random


@dataclasses.dataclass(frozen=True, kw_only=True)
class FireSettings:
    """How the network is trained; 100 epochs are published, without an early end."""

    epochs: int = 10
    patience: int = 3  # epochs without a lower loss, after which it ends
    batch: int = 32  # pairs
    learning_rate: float = 1e-3
    weight_decay: float = 5e-4  # in the gradient, as published
    pairs: int = 98_964
    seed: int = 0


class Convolution(nn.Module):
    """A convolution of 3 x 3 x 3 cells to 16 channels, as one matrix product.

    XLA takes eight times as long for the same by ``nn.Conv`` on a CPU, gradient included.
    """

    stride: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Channels (n, ceil(s / stride), ..., 16) of (n, s, s, s, C)."""
        side, channels = x.shape[1], x.shape[-1]
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (27 * channels, 16))
        bias = self.param("bias", nn.initializers.zeros, (16,))
        last = (-(-side // self.stride) - 1) * self.stride  # where the last window begins
        beside = max(last + 3 - side, 0)
        x = jnp.pad(x, [(0, 0), *[(beside // 2, beside - beside // 2)] * 3, (0, 0)])
        taken = [slice(first, first + last + 1, self.stride) for first in range(3)]
        windows = [x[:, i, j, k] for i, j, k in itertools.product(taken, repeat=3)]
        return jnp.concatenate(windows, axis=-1) @ kernel + bias


class Siamese(nn.Module):
    """The latent of a local primitive and a query."""

    @nn.compact
    def __call__(self, cells: jax.Array, query: jax.Array) -> jax.Array:
        """Latents (n, LATENT) of solid cells (n, SIDE, SIDE, SIDE) and features (n, E)."""
        x = cells.astype(jnp.float32)[..., None]
        for stride in (2, 2, 1):
            x = nn.relu(Convolution(stride)(x))
        x = nn.relu(nn.Dense(128)(x.reshape(len(x), -1)))
        for width in (50, 32, 16):
            query = nn.relu(nn.Dense(width)(query))
        return nn.Dense(LATENT)(jnp.concatenate([x, query], axis=-1))


def contrastive_loss(latents: jax.Array, alike: jax.Array) -> jax.Array:
    """The mean contrastive loss () of pairs of latents (2, m, LATENT), which may be alike (m,)."""
    apart = jnp.sqrt(jnp.sum((latents[0] - latents[1]) ** 2, axis=-1) + 1e-12)
    return jnp.mean(jnp.where(alike, apart**2, jnp.maximum(MARGIN - apart, 0.0) ** 2))


def cut(cells: jax.Array, home: jax.Array, corner: jax.Array) -> jax.Array:
    """Parts (n, SIDE, SIDE, SIDE) of homes (n,) of ``cells`` (H, X', Y', SIDE), from (n, 2) on."""
    size = (1, SIDE, SIDE, SIDE)
    part = jax.vmap(lambda h, c: jax.lax.dynamic_slice(cells, (h, c[0], c[1], 0), size)[0])
    return part(home, corner)


@single_precision
def train_fire(
    robot: MobileRobot,
    grids: Sequence[Grid],
    entries: Entries,
    out: str | Path,
    *,
    settings: FireSettings | None = None,
    stamp: str = "",
    progress: bool = True,
) -> Database:
    """Train the network on pairs of entries, and make the database of all entries.

    An interrupted training goes on from its last checkpoint. A seventh of the homes is held out:
    the epoch that is best on pairs with one of these counts.

    Args:
        robot: whose experiences they are.
        grids: the homes.
        entries: of these homes.
        out: folder for ``model.npz``, ``log.csv`` and ``checkpoint/``.
        settings: of the training; the default ones if None.
        stamp: names the data; a training goes on only with the same.
        progress: show a progress bar.

    Raises:
        ValueError: ``out`` holds another training, or the entries are too few.
    """
    settings = FireSettings() if settings is None else settings
    parts = {"model": FIRE, "version": VERSION, "settings": dataclasses.asdict(settings)}
    out = claim_output_dir(Path(out), {**parts, "data": stamp})
    rng = np.random.default_rng(settings.seed)
    pairs = make_pairs(robot, grids, entries, rng, settings.pairs)
    homes = rng.permutation(np.unique(entries.home))
    is_held_out = np.isin(entries.home, homes[: max(1, len(homes) // 7)])[pairs.index].any(axis=1)
    training, validation = np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out)
    if len(training) < settings.batch or not len(validation):
        raise ValueError(
            f"{len(training)} pairs to train on and {len(validation)} to validate; expected more "
            "homes or queries: nrp data --experiences"
        )
    cells = jnp.asarray(np.stack([cells_of_parts(grid.occupied) for grid in grids]))
    query = query_features(robot, entries.start, entries.goal)
    data = cells, jax.tree.map(jnp.asarray, (entries.home, entries.corner, query))
    optimizer = optax.chain(
        optax.add_decayed_weights(settings.weight_decay), optax.adam(settings.learning_rate)
    )
    shapes = jnp.zeros((1, SIDE, SIDE, SIDE)), jnp.zeros((1, query.shape[1]))
    variables = Siamese().init(jax.random.key(settings.seed), *shapes)
    state = State(variables=variables, optimizer=optimizer.init(variables), step=jnp.int32(0))
    update = _make_update(optimizer)
    best, history = run_epochs(
        state,
        out,
        update=lambda state, chosen: update(state, data, pairs.index[chosen], pairs.alike[chosen]),
        validate=lambda variables: _validated(variables, data, pairs, validation, settings.batch),
        training=training,
        batch=settings.batch,
        epochs=settings.epochs,
        patience=settings.patience,
        seed=settings.seed,
        title=f"{robot.name} {FIRE}",
        progress=progress,
    )
    kept = np.sort(rng.permutation(len(entries))[:MOST])
    latents = encode_parts(best, cells, entries.home[kept], entries.corner[kept], query[kept])
    figures = min(history, key=lambda row: row["loss"])
    info = {"data": stamp, "best": figures, "homes": len(grids), "entries": len(entries)}
    database = Database(
        task=robot.name,
        variables=best,
        latents=latents,
        samples=entries.sample[kept],
        info={**info, "pairs": len(pairs.index)},
    )
    save_database(database, out / "model.npz")
    return database


def _make_update(optimizer: optax.GradientTransformation) -> Callable[..., Any]:
    """A compiled step of the optimizer: the new state, and the loss ()."""

    @jax.jit
    def update(state: State, data: Any, index: jax.Array, alike: jax.Array):
        def of_few(pairs: tuple[jax.Array, jax.Array]):
            gradient_of = jax.value_and_grad(_evaluate, has_aux=True)
            (loss, _), gradient = gradient_of(state.variables, data, *pairs)
            return loss, gradient

        few = math.gcd(FEW, len(index))
        pairs = jax.tree.map(lambda x: x.reshape(-1, few, *x.shape[1:]), (index, alike))
        loss, gradient = jax.tree.map(lambda x: jnp.mean(x, 0), jax.lax.map(of_few, pairs))
        updates, moments = optimizer.update(gradient, state.optimizer, state.variables)
        variables = optax.apply_updates(state.variables, updates)
        return State(variables=variables, optimizer=moments, step=state.step + 1), loss

    return update


@jax.jit
def _evaluate(
    variables: Any, data: Any, index: jax.Array, alike: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Loss () of pairs (m, 2), which may be alike (m,), and the share () that it tells right."""
    cells, columns = data
    home, corner, seen = jax.tree.map(lambda column: column[index.T.reshape(-1)], columns)
    latents: Any = Siamese().apply(variables, cut(cells, home, corner), seen)
    latents = latents.reshape(2, -1, LATENT)
    right = (jnp.linalg.norm(latents[0] - latents[1], axis=-1) < MARGIN) == alike
    return contrastive_loss(latents, alike), jnp.mean(right)


def _validated(
    variables: Any, data: Any, pairs: Pairs, index: np.ndarray, batch: int
) -> dict[str, float]:
    """Mean loss of pairs, and the share that the margin tells right; the last batch may be cut."""
    found = [
        _evaluate(variables, data, pairs.index[part], pairs.alike[part])
        for part in index[: max(len(index) // batch, 1) * batch].reshape(-1, min(batch, len(index)))
    ]
    loss, right = np.mean(np.array(jax.device_get(found)), axis=0)
    return {"loss": float(loss), "right": float(right)}


@single_precision
def encode_parts(
    variables: Any, cells: jax.Array, home: np.ndarray, corner: np.ndarray, query: np.ndarray
) -> np.ndarray:
    """Latents (n, LATENT) of parts of homes and of queries as seen from there.

    Args:
        variables: of the network.
        cells: (H, X', Y', SIDE) of homes, see :func:`nrp_jax.learning.primitives.cells_of_parts`.
        home: (n,) their homes.
        corner: (n, 2) their first cells.
        query: (n, E) from :func:`nrp_jax.learning.primitives.query_features`.
    """
    size, found = 2 * FEW, []
    for first in range(0, len(home), size):
        part = [column[first : first + size] for column in (home, corner, query)]
        rows = len(part[0])
        padded = [np.pad(a, [(0, size - rows), *[(0, 0)] * (a.ndim - 1)]) for a in part]
        found.append(np.asarray(_encode(variables, cells, *padded))[:rows])
    return np.concatenate(found)


@jax.jit
def _encode(variables: Any, cells: jax.Array, home, corner, query) -> jax.Array:
    latents: Any = Siamese().apply(variables, cut(cells, home, corner), query)
    return latents


def run_command(arguments: argparse.Namespace) -> int:
    """Train FIRE's network and make its database, for ``nrp train --model fire``."""
    named = ("epochs", "patience", "batch", "learning_rate", "pairs", "seed")
    given = {name: getattr(arguments, name) for name in named}
    given = {name: value for name, value in given.items() if value is not None}
    dataset, robot = load_dataset(arguments.data), load_robot(arguments.task)
    if dataset.settings.task != robot.name or not dataset.settings.experiences:
        raise ValueError(
            f"'{arguments.data}' holds no experiences of '{robot.name}'; expected what this wrote: "
            f"nrp data --task {robot.name} --experiences"
        )
    entries = make_entries(dataset)
    stamp = f"{fingerprint(arguments.data)}, {len(entries)} entries"
    try:
        database = train_fire(
            robot,
            dataset.grids,
            entries,
            arguments.out,
            settings=FireSettings(**given),
            stamp=stamp,
        )
    except KeyboardInterrupt:
        print(f"the same command goes on from the last epoch in {arguments.out}")
        raise
    figures = ", ".join(f"{name} {value:.4g}" for name, value in database.info["best"].items())
    print(f"wrote {Path(arguments.out) / 'model.npz'}: {len(database.latents)} entries, {figures}")
    return 0
