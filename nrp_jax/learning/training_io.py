"""Files that training writes: checkpoints to continue from, a log, and curves."""

import contextlib
import csv
import json
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
import optax
import orbax.checkpoint as ocp

from vrrt_jax.core.files import NO_ROOM, UNFINISHED, replacing
from vrrt_jax.core.types import pytree

SECONDS_BETWEEN = 10.0  # between two checkpoints, at least [s]
SPARE = 2**18  # of a checkpoint, for what is no array [bytes]


@pytree
class State:
    """The state of a training: what every step changes."""

    variables: Any  # flax variables of the network
    optimizer: optax.OptState
    step: jax.Array  # () steps done


class CheckpointStore:
    """Keeps a recent epoch on disk, with orbax: a checkpoint appears whole or not at all."""

    def __init__(self, folder: Path):
        """Open a folder, or make it."""
        options = ocp.CheckpointManagerOptions(max_to_keep=1)
        self._manager = ocp.CheckpointManager(folder.resolve(), options=options)
        self._saved = 0.0

    def restore(self, state: State) -> tuple[State, Any, list[dict[str, float]]]:
        """Read the checkpoint.

        Args:
            state: a state of the same shapes; returned as it is if there is no checkpoint.

        Returns:
            The state, the variables of the best epoch, and the history: a row for each epoch.
        """
        best = jax.device_get(state.variables)
        epoch = self._manager.latest_step()
        if epoch is None:
            return state, best, []
        leaves = ocp.args.StandardRestore({"state": _plain(state), "best": best})
        arguments = ocp.args.Composite(arrays=leaves, history=ocp.args.JsonRestore())
        try:
            saved = self._manager.restore(epoch, args=arguments)
        except Exception as error:  # of orbax and what it stands on, of many kinds
            raise ValueError(
                f"the checkpoint in '{self._manager.directory}' is not readable "
                f"({type(error).__name__}); delete that folder to begin again, or choose another "
                "with --out"
            ) from error
        leaves = jax.tree.leaves(saved.arrays["state"])
        state = jax.tree.unflatten(jax.tree.structure(state), leaves)
        return state, saved.arrays["best"], saved.history

    def save(self, state: State, best: Any, history: list[dict[str, float]], last: bool) -> None:
        """Write a checkpoint, then drop the one before.

        Skipped within ``SECONDS_BETWEEN`` of the one before, unless this is the last epoch.
        """
        if not last and time.monotonic() - self._saved < SECONDS_BETWEEN:
            return
        self._saved = time.monotonic()
        arrays = {"state": _plain(state), "best": best}
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(arrays)) + SPARE
        arrays = ocp.args.StandardSave(arrays)
        arguments = ocp.args.Composite(arrays=arrays, history=ocp.args.JsonSave(cast(Any, history)))
        folder = Path(self._manager.directory)
        with _told_if_full(folder):
            _check_room(folder.with_name(f"room{UNFINISHED}"), size)
            self._manager.save(len(history), args=arguments)
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Finish writing and close the folder."""
        self._manager.close()


def _check_room(file: Path, size: int) -> None:
    """Ask the disk for so many bytes, and give them back.

    Where they run out under way, threads of orbax print pages that nothing can catch.
    """
    if not hasattr(os, "posix_fallocate"):  # as on macOS
        return
    try:
        with file.open("wb") as handle:
            os.posix_fallocate(handle.fileno(), 0, size)
    finally:
        file.unlink(missing_ok=True)


@contextlib.contextmanager
def _told_if_full(folder: Path) -> Iterator[None]:
    """Orbax logs pages of what goes wrong, and raises it as all kinds of errors.

    Raises:
        OSError: there is no room on the disk.
    """
    logging.disable(logging.CRITICAL)
    try:
        yield
    except Exception as error:
        for number in NO_ROOM:
            if os.strerror(number) in str(error):
                kept = "an epoch before is kept, if there is one, and the same command goes on"
                raise OSError(number, f"{os.strerror(number)}; {kept}", str(folder)) from None
        raise
    finally:
        logging.disable(logging.NOTSET)


def _plain(state: State) -> list[jax.Array]:
    """The state's arrays; orbax cannot restore optax's own types."""
    return jax.tree.leaves(state)


def epochs_since_best(history: list[dict[str, float]]) -> int:
    """Number of epochs since the one with the lowest validation loss."""
    if not history:
        return 0
    return len(history) - 1 - int(np.argmin([row["loss"] for row in history]))


def claim_output_dir(out: Path, parts: dict[str, Any]) -> Path:
    """Make a folder for one training, or open it to continue the same training.

    Args:
        out: folder.
        parts: what the training depends on; kept in ``training.json``.

    Raises:
        ValueError: the folder holds a training with other parts.
    """
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(parts, indent=1)
    file = out / "training.json"
    if file.exists() and file.read_text() != text:
        raise ValueError(
            f"'{out}' holds a training of another model, data set or settings; choose another "
            "folder with --out, or delete it"
        )
    with replacing(file, "w") as handle:
        handle.write(text)
    return out


def write_log(history: list[dict[str, float]], out: Path) -> None:
    """Write the history, a row for each epoch, to ``log.csv``."""
    with replacing(out / "log.csv", "w") as handle:
        writer = csv.DictWriter(handle, list(history[0]))
        writer.writeheader()
        writer.writerows(history)


def plot_curves(history: list[dict[str, float]], path: Path, title: str) -> None:
    """Draw training and validation loss, and quality, over the epochs."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    epochs = [row["epoch"] for row in history]
    left.plot(epochs, [row["train_loss"] for row in history], label="training homes")
    left.plot(epochs, [row["loss"] for row in history], label="held-out homes")
    left.set(xlabel="epoch", ylabel="loss", title=title)
    left.legend()
    right.plot(epochs, [row["quality"] for row in history])
    right.set(xlabel="epoch", ylabel="quality on held-out homes")
    figure.savefig(path, dpi=120)
