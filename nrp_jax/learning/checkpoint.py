"""Trained models on disk: one ``.npz`` with the weights and a description of the network."""

import dataclasses
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.learning.models import CVAE, NEXT, Discriminator, ModelConfig
from nrp_jax.learning.next_network import PlanningNetwork
from vrrt_jax.core.files import replacing
from vrrt_jax.core.precision import single_precision

VERSION = 2  # of the features that networks see; models of other versions are refused


@dataclasses.dataclass(frozen=True, kw_only=True)
class Model:
    """A trained model."""

    config: ModelConfig
    variables: Any  # flax variables: params, and batch_stats of the published models
    info: dict[str, Any]  # "num_outputs", and how the model was trained, with its best epoch


def build_module(config: ModelConfig, num_outputs: int) -> Discriminator | CVAE | PlanningNetwork:
    """Build the flax module of a configuration.

    Args:
        config: the architecture.
        num_outputs: features that a CVAE generates, or joints that NEXT moves; unused for a
            discriminator.
    """
    if config.kind == NEXT:
        return PlanningNetwork(config, num_outputs)
    return Discriminator(config) if config.kind == "discriminator" else CVAE(config, num_outputs)


def save_model(model: Model, path: str | Path) -> None:
    """Write what planning needs of a model, in half precision: of a CVAE, all but its encoder.

    A killed process leaves the old file or the new one.
    """
    path = Path(path)
    flat = flax.traverse_util.flatten_dict(jax.device_get(model.variables))
    arrays: dict[str, Any] = {
        f"variables/{'/'.join(name)}": np.asarray(leaf, np.float16)
        for name, leaf in flat.items()
        if not name[1].startswith("encoder")
    }
    config = dataclasses.asdict(model.config)
    description = json.dumps({"version": VERSION, "config": config, "info": model.info})
    with replacing(path) as handle:
        np.savez_compressed(handle, description=np.array(description), **arrays)


@single_precision
def load_model(path: str | Path) -> Model:
    """Read a model that :func:`save_model` wrote.

    Raises:
        ValueError: there is no model, the file is damaged, or it is of another version.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "model.npz"
    if not path.is_file():
        raise ValueError(f"no model at '{path}'; train one with: nrp train")
    try:
        with np.load(path) as saved:
            description = json.loads(str(saved["description"]))
            if description["version"] != VERSION:
                raise ValueError("another version")
            flat = {
                name.removeprefix("variables/"): jnp.asarray(saved[name], jnp.float32)
                for name in saved.files
                if name != "description"
            }
        # JSON has no tuples.
        given = description["config"].items()
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in given}
        config, info = ModelConfig(**fields), description["info"]
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile, zlib.error):
        raise ValueError(
            f"'{path}' is not a readable model of this version; train it again with: nrp train"
        ) from None
    variables = flax.traverse_util.unflatten_dict(flat, sep="/")
    return Model(config=config, variables=variables, info=info)


def check_model(model: Model, path: str | Path, **expected: str) -> None:
    """Raise a ValueError unless the model's configuration holds the expected values."""
    for name, value in expected.items():
        got = getattr(model.config, name)
        if got != value:
            raise ValueError(
                f"'{path}' holds a model with {name} '{got}'; expected '{value}': give another "
                "file, or train one with: nrp train"
            )
