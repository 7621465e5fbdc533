"""Training of the discriminator and the CVAE."""

import argparse
import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nrp_jax.learning import models, similarity
from nrp_jax.learning.batches import Examples, empty_batch, load_examples, make_batch
from nrp_jax.learning.checkpoint import Model, build_module, save_model
from nrp_jax.learning.data import fingerprint, load_dataset
from nrp_jax.learning.epochs import History, run_epochs
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.objective import init, loss_fn, validate
from nrp_jax.learning.recipe import TrainConfig, check_settings, make_optimizer
from nrp_jax.learning.training_io import State, claim_output_dir, plot_curves
from nrp_jax.scene.robots import MobileRobot, load_robot
from vrrt_jax.core import command
from vrrt_jax.core.precision import single_precision


@single_precision
def train(
    config: ModelConfig,
    robot: MobileRobot,
    examples: Examples,
    out: str | Path,
    *,
    settings: TrainConfig | None = None,
    stamp: str = "",
    progress: bool = True,
) -> Model:
    """Train a model.

    An interrupted training continues from its last checkpoint, with the same result.

    Args:
        config: the architecture.
        robot: whose configurations the examples hold.
        examples: from :func:`nrp_jax.learning.batches.load_examples`.
        out: folder for ``model.npz`` (the best epoch), ``log.csv``, ``curves.png`` and
            ``checkpoint/`` (a recent epoch).
        settings: of the training; the default ones if None.
        stamp: names the data; a training continues only on the same data.
        progress: show a progress bar.

    Returns:
        The model of the best epoch.

    Raises:
        ValueError: ``out`` holds a training of another model, data or settings, or there are too
            few homes to hold some out.
        RuntimeError: the validation loss is not finite any more.
    """
    # The folder, and which homes are held out.
    settings = TrainConfig() if settings is None else settings
    recipe = {k: v for k, v in dataclasses.asdict(settings).items() if v is not None}
    parts = {"model": dataclasses.asdict(config), "settings": recipe}
    training, validation = split_by_home(np.asarray(examples.home), settings)
    out = claim_output_dir(Path(out), {**parts, "data": stamp})
    # The network, the optimizer, and a random or restored state.
    sample = empty_batch(config, robot, examples)
    module = build_module(config, sample.waypoints.shape[-1])
    size = min(settings.batch, len(training))
    steps = settings.epochs * (len(training) // size)
    optimizer = make_optimizer(settings, steps)
    variables = init(config, module, sample, jax.random.key(settings.seed))
    state = State(
        variables=variables,
        optimizer=optimizer.init(variables["params"]),
        step=jnp.int32(0),
    )
    update = _make_update(config, robot, module, optimizer, settings)

    def export(best: Any, history: History) -> Model:
        figures = min(history, key=lambda row: row["loss"])
        info = {"num_outputs": sample.waypoints.shape[-1], "data": stamp, "best": figures}
        model = Model(config=config, variables=best, info=info)
        save_model(model, out / "model.npz")
        return model

    best, history = run_epochs(
        state,
        out,
        update=lambda state, chosen: update(state, examples, jnp.asarray(chosen)),
        validate=lambda variables: validate(config, module, robot, variables, examples, validation),
        training=training,
        batch=size,
        epochs=settings.epochs,
        patience=settings.patience,
        seed=settings.seed,
        title=f"{config.task} {config.kind}",
        progress=progress,
        on_best=export,
    )
    model = export(best, history)
    try:
        plot_curves(history, out / "curves.png", f"{config.task} {config.kind}")
    except ModuleNotFoundError:
        print("no curves: matplotlib is missing; pip install 'vrrt-jax[plot]'", file=sys.stderr)
    return model


def _make_update(
    config: ModelConfig,
    robot: MobileRobot,
    module: Any,
    optimizer: optax.GradientTransformationExtraArgs,
    settings: TrainConfig,
) -> Callable[[State, Examples, jax.Array], tuple[State, jax.Array]]:
    """A compiled step of the optimizer on chosen queries (n,): the new state, and the loss ()."""

    @jax.jit
    def update(state: State, examples: Examples, chosen: jax.Array):
        # Random numbers depend on the step alone, so that a restored training repeats them.
        key, key_turn = jax.random.split(
            jax.random.fold_in(jax.random.key(settings.seed), state.step)
        )
        batch = make_batch(config, robot, examples, chosen, key_turn if settings.augment else None)

        def objective(params):
            variables = {**state.variables, "params": params}
            return loss_fn(config, robot, module, variables, batch, key, train=True)

        (loss, (_, changed)), gradient = jax.value_and_grad(objective, has_aux=True)(
            state.variables["params"]
        )
        params = state.variables["params"]
        updates, moments = optimizer.update(gradient, state.optimizer, params, value=loss)
        params = optax.apply_updates(params, updates)
        variables = {**state.variables, **changed, "params": params}
        return State(variables=variables, optimizer=moments, step=state.step + 1), loss

    return update


def split_by_home(home: np.ndarray, settings: TrainConfig) -> tuple[np.ndarray, np.ndarray]:
    """Split queries into training and validation queries; no home is in both.

    Args:
        home: (Q,) the home of each query.
        settings: its seed and share of held-out homes.

    Returns:
        Indices of the training queries and of the validation queries.

    Raises:
        ValueError: all queries are of one home.
    """
    homes = np.random.default_rng(settings.seed).permutation(np.unique(home))
    if len(homes) < 2:
        raise ValueError("the data are of one home; expected two or more, to hold one out")
    held_out = homes[: max(1, round(settings.validation * len(homes)))]
    is_held_out = np.isin(home, held_out)
    return np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out)


def add_arguments(subparsers: Any) -> None:
    """Add the ``train`` command to a command line."""
    parser = subparsers.add_parser("train", help="train a sampler, or go on training it")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", required=True, choices=models.TASKS, help="whose sampler")
    parser.add_argument(
        "--model", required=True, choices=(*models.KINDS, models.FIRE), help="which"
    )
    parser.add_argument(
        "--architecture",
        choices=("light", "published"),
        default="light",
        help="published: the paper's networks, and its recipe where no option says otherwise",
    )
    parser.add_argument(
        "--global", dest="whole_map", action="store_true", help="see the whole map, not a window"
    )
    parser.add_argument("--data", required=True, help="folder that nrp data wrote")
    parser.add_argument("--out", required=True, help="folder for the model, log and curves")
    parser.add_argument(
        "--epochs", type=command.whole(1, 100_000), help=f"at most; {TrainConfig.epochs}"
    )
    parser.add_argument(
        "--batch", type=command.whole(1, 65_536), help=f"queries a step; {TrainConfig.batch}"
    )
    parser.add_argument(
        "--learning-rate",
        type=command.real(1e-8, 1.0),
        help=f"at its peak; {TrainConfig.learning_rate:g}",
    )
    parser.add_argument(
        "--patience",
        type=command.whole(1, 100_000),
        help=f"epochs without progress; {TrainConfig.patience}",
    )
    parser.add_argument(
        "--pairs", type=command.whole(1, 10_000_000), help="of fire's experiences; 98964"
    )
    parser.add_argument("--hard", action="store_true", help="labels 0 and 1, none between")
    parser.add_argument(
        "--seed", type=command.seed, default=TrainConfig.seed, help="of weights and batches"
    )


def _run_command(arguments: argparse.Namespace) -> int:
    if arguments.model == models.FIRE:
        return similarity.run_command(arguments)
    task, kind, published = arguments.task, arguments.model, arguments.architecture == "published"
    make = ModelConfig.published if published else ModelConfig.default
    config = make(task, kind, "map" if arguments.whole_map else "window")
    settings = TrainConfig.published(task, kind) if published else TrainConfig()
    named = ("epochs", "batch", "learning_rate", "patience", "seed")
    given = {name: getattr(arguments, name) for name in named}
    given = {name: value for name, value in given.items() if value is not None}
    settings = dataclasses.replace(settings, **given)
    check_settings(settings)
    robot = load_robot(task)
    dataset = load_dataset(arguments.data)
    soft = not (arguments.hard or published)
    examples = load_examples(config, robot, dataset, soft=soft)
    stamp = f"{fingerprint(arguments.data)}, {len(dataset)} rows, soft {soft}"
    try:
        model = train(config, robot, examples, arguments.out, settings=settings, stamp=stamp)
    except KeyboardInterrupt:
        print(f"the same command goes on from the last epoch in {arguments.out}")
        raise
    figures = ", ".join(f"{name} {value:.4g}" for name, value in model.info["best"].items())
    print(f"wrote {Path(arguments.out) / 'model.npz'}: {figures}")
    return 0
