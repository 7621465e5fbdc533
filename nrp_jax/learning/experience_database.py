"""FIRE's database on disk: one ``.npz`` with the network, the latents and the samples."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax
import numpy as np

from nrp_jax.learning.checkpoint import variables_of
from nrp_jax.learning.models import FIRE
from vrrt_jax.core.arrays_file import MOST_WEIGHTS, float32_of, read_arrays
from vrrt_jax.core.files import replacing
from vrrt_jax.core.precision import single_precision

VERSION = 1  # of primitives, features and network; databases of other versions are refused


@dataclasses.dataclass(frozen=True, kw_only=True)
class Database:
    """The network and what it has made of the entries."""

    task: str
    variables: Any  # flax variables
    latents: np.ndarray  # (N, LATENT)
    samples: np.ndarray  # (N, D) seen from the middles of their parts
    info: dict[str, Any]  # how it was made


def save_database(database: Database, path: str | Path) -> None:
    """Write a database in half precision; a killed process leaves the old file or the new one."""
    flat = flax.traverse_util.flatten_dict(jax.device_get(database.variables), sep="/")
    weights: dict[str, Any] = {
        f"variables/{name}": np.asarray(leaf, np.float16) for name, leaf in flat.items()
    }
    description = {"kind": FIRE, "version": VERSION, "task": database.task, "info": database.info}
    with replacing(Path(path)) as handle:
        np.savez_compressed(
            handle,
            description=np.array(json.dumps(description)),
            latents=database.latents.astype(np.float16),
            samples=database.samples.astype(np.float16),
            **weights,
        )


@single_precision
def load_database(path: str | Path, task: str) -> Database:
    """Read a database that :func:`save_database` wrote.

    Args:
        path: the file, or the folder that ``nrp train --model fire`` wrote.
        task: the robot that it has to be of.

    Raises:
        ValueError: there is none, it is damaged, or it is of another version or robot.
    """
    path = Path(path)
    path = path / "model.npz" if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"no database at '{path}'; make one with: nrp train --model {FIRE}")
    try:
        arrays = read_arrays(path, "description", "latents", "samples", most=MOST_WEIGHTS)
        description = json.loads(str(arrays.pop("description")))
        if (description["kind"], description["version"]) != (FIRE, VERSION):
            raise ValueError("it is of another kind or version")
        latents, samples = (float32_of(arrays.pop(n), n) for n in ("latents", "samples"))
        if latents.ndim != 2 or samples.ndim != 2 or len(latents) != len(samples):
            raise ValueError(f"its latents and samples are {latents.shape} and {samples.shape}")
        if not len(latents):
            raise ValueError("its latents are empty")
        variables = variables_of(arrays)
        found, info = description["task"], dict(description["info"])
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(
            f"'{path}' is not a readable database of this version ({error}); make it again with: "
            f"nrp train --model {FIRE}"
        ) from None
    if found != task:
        raise ValueError(
            f"'{path}' is a database of '{found}'; expected one of '{task}': give another file, or "
            f"make one with: nrp train --task {task} --model {FIRE}"
        )
    return Database(task=found, variables=variables, latents=latents, samples=samples, info=info)
