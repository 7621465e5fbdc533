"""The epochs of a training, which goes on from its last checkpoint and keeps the best epoch."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from nrp_jax.learning.training_io import CheckpointStore, State, epochs_since_best, write_log

History = list[dict[str, float]]  # a row for each epoch


def run_epochs(
    state: State,
    out: Path,
    *,
    update: Callable[[State, np.ndarray], tuple[State, jax.Array]],
    validate: Callable[[Any], dict[str, float]],
    training: np.ndarray,
    batch: int,
    epochs: int,
    patience: int,
    seed: int,
    title: str,
    progress: bool = True,
    on_best: Callable[[Any, History], Any] | None = None,
) -> tuple[Any, History]:
    """Do the epochs that are not done yet.

    Args:
        state: at the start; a checkpoint in ``out`` takes its place.
        out: folder for ``log.csv`` and ``checkpoint/`` (a recent epoch).
        update: a step on examples (batch,): the new state, and the loss ().
        validate: the figures of variables on held-out homes, ``loss`` among them.
        training: (n,) examples to train on.
        batch: examples a step, at most n.
        epochs: at most.
        patience: ends after so many epochs without a lower validation loss.
        seed: of the order of the examples, with the epoch.
        title: of the progress bar.
        progress: show it.
        on_best: called with the variables and the history after each epoch that is the best so far.

    Returns:
        The variables of the best epoch, and the history.

    Raises:
        RuntimeError: the validation loss is not finite any more.
    """
    store = CheckpointStore(out / "checkpoint")
    state, best, history = store.restore(state)
    bar = tqdm(
        range(len(history), epochs),
        initial=len(history),
        total=epochs,
        desc=title,
        unit="epoch",
        disable=not progress,
    )
    for epoch in bar:
        if epochs_since_best(history) >= patience:
            break
        # All training examples in a random order that the seed and the epoch fix.
        started = time.perf_counter()
        order = np.random.default_rng([seed, epoch]).permutation(training)
        losses = []
        for chosen in order[: len(order) // batch * batch].reshape(-1, batch):
            state, loss = update(state, chosen)
            losses.append(loss)
        # The held-out homes decide whether this epoch is the best so far.
        figures = validate(state.variables)
        if not np.isfinite(figures["loss"]):
            store.close()
            raise RuntimeError(
                f"training diverged in epoch {epoch}: the best epoch before is kept in '{out}'; "
                "lower --learning-rate and choose another folder with --out"
            )
        history.append(
            {
                "epoch": epoch,
                "train_loss": float(np.mean(jax.device_get(losses))),
                **figures,
                "seconds": round(time.perf_counter() - started, 2),
            }
        )
        if epochs_since_best(history) == 0:
            best = jax.device_get(state.variables)
            if on_best is not None:
                on_best(best, history)
        finished = len(history) == epochs or epochs_since_best(history) >= patience
        store.save(state, best, history, last=finished)
        write_log(history, out)
        bar.set_postfix_str(", ".join(f"{name} {value:.4f}" for name, value in figures.items()))
    store.close()
    return best, history
