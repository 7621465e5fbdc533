"""Trained models on disk: one ``.npz`` with the weights and a description of the network."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.learning.models import CVAE, NEXT, Discriminator, ModelConfig, check_choices
from nrp_jax.learning.next_network import PlanningNetwork
from vrrt_jax.core.arrays_file import MOST_WEIGHTS, float32_of, read_arrays
from vrrt_jax.core.fields import record_of
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
        arrays = read_arrays(path, "description", most=MOST_WEIGHTS)
        description = json.loads(str(arrays.pop("description")))
        if description["version"] != VERSION:
            raise ValueError(f"it is of version {description['version']!r}, not {VERSION}")
        config = record_of(ModelConfig, description["config"], "its config")
        check_choices(config.task, config.kind, config.scope)
        info = dict(description["info"])
        variables = variables_of(arrays)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(
            f"'{path}' is not a readable model of this version ({error}); train it again with: nrp "
            "train"
        ) from None
    return Model(config=config, variables=variables, info=info)


def variables_of(arrays: Mapping[str, np.ndarray]) -> Any:
    """Flax variables of a file's arrays, whose names are paths.

    Raises:
        ValueError: an array is of another kind, or has values that no training leaves.
    """
    flat = {}
    for name, array in arrays.items():
        flat[name.removeprefix("variables/")] = jnp.asarray(float32_of(array, name))
    return flax.traverse_util.unflatten_dict(flat, sep="/")


def check_model(model: Model, path: str | Path, **expected: str) -> None:
    """Raise a ValueError unless the model's configuration holds the expected values."""
    for name, value in expected.items():
        got = getattr(model.config, name)
        if got != value:
            raise ValueError(
                f"'{path}' holds a model with {name} '{got}'; expected '{value}': give another "
                "file, or train one with: nrp train"
            )
