"""Training of NEXT: on an expert's paths first, then on those that its own planner finds.

After Chen et al. (ICLR 2020): the planner solves problems in the training homes, exploring ever
less, and every so many new states the network is trained again. Letters: ``K`` states of a path,
``D`` joints.
"""

import argparse
import dataclasses
import itertools
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from nrp_jax.learning.checkpoint import Model, build_module, save_model
from nrp_jax.learning.data import Dataset, fingerprint, load_dataset
from nrp_jax.learning.models import NEXT, ModelConfig
from nrp_jax.learning.next_rows import (
    PathExamples,
    next_loss,
    path_batch,
    path_examples,
    with_paths,
)
from nrp_jax.learning.recipe import OnlineConfig, TrainConfig
from nrp_jax.learning.train import split_by_home
from nrp_jax.learning.training_io import (
    CheckpointStore,
    State,
    claim_output_dir,
    plot_curves,
    write_log,
)
from nrp_jax.online_problems import FoundPaths, Problems
from nrp_jax.scene.robots import MobileRobot, load_robot
from vrrt_jax.core import command
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.settings import check_settings


@single_precision
def train_online(
    config: ModelConfig,
    robot: MobileRobot,
    dataset: Dataset,
    out: str | Path,
    *,
    settings: OnlineConfig | None = None,
    stamp: str = "",
    progress: bool = True,
) -> Model:
    """Train NEXT.

    An interrupted training goes on from its last epoch.

    Args:
        config: the architecture.
        robot: whose configurations the paths hold.
        dataset: of paths, from :func:`nrp_jax.learning.data.load_dataset`.
        out: folder for ``model.npz`` (the last epoch, as published), ``log.csv``, ``curves.png``,
            ``checkpoint/`` and the paths that were found.
        settings: of the training; the published ones if None.
        stamp: names the data; a training goes on only with the same.
        progress: show a progress bar.

    Raises:
        ValueError: ``out`` holds another training, the data set has no paths of this robot, or too
            few homes to hold some out.
        RuntimeError: the validation loss is not finite any more.
    """
    began = time.perf_counter()
    settings = OnlineConfig() if settings is None else settings
    check_settings(settings)
    data = _Data.of(config, robot, dataset, settings)
    recipe = dataclasses.asdict(dataclasses.replace(settings, minutes=0.0))
    parts = {"model": dataclasses.asdict(config), "settings": recipe, "data": stamp}
    out = claim_output_dir(Path(out), parts)
    module, optimizer, state = _network(config, robot, data.examples, settings)
    store = CheckpointStore(out / "checkpoint")
    state, _, history = store.restore(state)
    update, evaluate = _programs(config, robot, module, optimizer, settings)
    problems = Problems(robot, dataset, data.training_homes, settings)
    before_s = sum(row["seconds"] for row in history)

    def model_of(variables: Any) -> Model:
        info: dict[str, Any] = {"num_outputs": robot.num_joints, "data": stamp}
        if history:
            info["last"] = history[-1]
        return Model(config=config, variables=variables, info=info)

    # Epochs on the expert's paths, then rounds of problems, each with epochs on all paths.
    bar = tqdm(
        desc=f"{config.task} {NEXT}", initial=len(history), unit="epoch", disable=not progress
    )
    for epoch in itertools.count():
        started = time.perf_counter()
        rounds = max(0, (epoch - settings.epochs) // settings.round_epochs + 1)
        is_new = epoch >= len(history)
        late = epoch > 0 and before_s + started - began > 60 * settings.minutes
        nothing_new = rounds > data.rounds and data.tried >= settings.problems
        if is_new and (late or nothing_new):
            break
        while data.rounds < rounds:
            file = out / f"paths_{data.rounds + 1:04d}.npz"
            data = data.after(robot, problems.solve(file, data.tried, model_of(state.variables)))
        if not is_new:
            continue
        losses = []
        for chosen in data.batches([settings.seed, epoch]):
            state, loss = update(state, data.examples, jnp.asarray(chosen))
            losses.append(loss)
        figures = _validated(evaluate, state.variables, data)
        if not np.isfinite(figures["loss"]):
            store.close()
            raise RuntimeError(
                f"training diverged in epoch {epoch}: the epoch before is kept in '{out}'; "
                "lower --learning-rate and choose another folder with --out"
            )
        row = {"epoch": epoch, "train_loss": float(np.mean(jax.device_get(losses))), **figures}
        row |= {"problems": data.tried, "paths": data.num - data.num_expert}
        row |= {"solved": data.solved, "seconds": round(time.perf_counter() - started, 2)}
        history.append(row)
        save_model(model_of(state.variables), out / "model.npz")
        store.save(state, jax.device_get(state.variables), history, last=True)
        write_log(history, out)
        bar.update()
        bar.set_postfix_str(f"loss {figures['loss']:.3f}, {data.solved:.0%} of problems solved")
    bar.close()
    store.close()
    model = model_of(state.variables)
    save_model(model, out / "model.npz")
    try:
        plot_curves(history, out / "curves.png", f"{config.task} {config.kind}")
    except ModuleNotFoundError:
        print("no curves: matplotlib is missing; pip install 'vrrt-jax[plot]'", file=sys.stderr)
    return model


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Data:
    """The paths so far: the expert's, and those that the planner found, each to its own goal."""

    examples: PathExamples
    training: np.ndarray  # indices of the expert's goals to train on
    validation: np.ndarray  # and of those in homes held out
    training_homes: np.ndarray
    size: int  # goals of a batch
    num_expert: int
    num: int  # goals in all
    tried: int = 0  # problems
    rounds: int = 0
    solved: float = 0.0  # share of the last round's problems

    @classmethod
    def of(
        cls, config: ModelConfig, robot: MobileRobot, dataset: Dataset, settings: OnlineConfig
    ) -> "_Data":
        """The expert's paths, with room for one of each problem."""
        examples, num = path_examples(config, robot, dataset, settings.problems)
        home = np.asarray(examples.home)[:num]
        split = TrainConfig(seed=settings.seed, validation=settings.validation)
        training, validation = split_by_home(home, split)
        most = examples.length.shape[1]
        size = max(settings.batch // (examples.q.shape[1] - most), 1)
        return cls(
            examples=examples,
            training=training,
            validation=validation,
            training_homes=np.unique(home[training]),
            size=min(size, len(training)),
            num_expert=num,
            num=num,
        )

    def after(self, robot: MobileRobot, found: FoundPaths) -> "_Data":
        """With what a round found."""
        added = found.home, found.q[:, None], found.length[:, None]
        return dataclasses.replace(
            self,
            examples=with_paths(robot, self.examples, self.num, *added),
            num=self.num + len(found.q),
            solved=len(found.q) / max(found.tried - self.tried, 1),
            tried=found.tried,
            rounds=self.rounds + 1,
        )

    def batches(self, seed: list[int]) -> np.ndarray:
        """All goals to train on, in a random order, as batches (k, size)."""
        chosen = np.concatenate([self.training, np.arange(self.num_expert, self.num)])
        order = np.random.default_rng(seed).permutation(chosen)
        return order[: len(order) // self.size * self.size].reshape(-1, self.size)


def _network(
    config: ModelConfig, robot: MobileRobot, examples: PathExamples, settings: OnlineConfig
) -> tuple[Any, optax.GradientTransformation, State]:
    """The network, its optimizer and a random state."""
    module = build_module(config, robot.num_joints)
    optimizer = optax.chain(
        optax.add_decayed_weights(settings.weight_decay), optax.adam(settings.learning_rate)
    )
    batch_of = partial(path_batch, config, robot, step=settings.step)
    shapes = jax.eval_shape(batch_of, examples, jnp.zeros(1, jnp.int32))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    key = jax.random.key(settings.seed)
    variables: Any = jax.jit(module.init)(key, zeros.image, zeros.goal, zeros.q)
    state = State(variables=variables, optimizer=optimizer.init(variables), step=jnp.int32(0))
    return module, optimizer, state


def _programs(
    config: ModelConfig,
    robot: MobileRobot,
    module: Any,
    optimizer: optax.GradientTransformation,
    settings: OnlineConfig,
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled: a step of the optimizer on chosen goals (n,), and the errors of some."""
    loss_of = partial(next_loss, module)

    @jax.jit
    def update(state: State, examples: PathExamples, chosen: jax.Array):
        key = jax.random.fold_in(jax.random.key(settings.seed), state.step)
        key = key if settings.augment else None
        batch = path_batch(config, robot, examples, chosen, settings.step, key)
        gradient_of = jax.value_and_grad(loss_of, has_aux=True)
        (loss, _), gradient = gradient_of(state.variables, batch, settings.value_weight)
        updates, moments = optimizer.update(gradient, state.optimizer, state.variables)
        variables = optax.apply_updates(state.variables, updates)
        return State(variables=variables, optimizer=moments, step=state.step + 1), loss

    @jax.jit
    def evaluate(variables: Any, examples: PathExamples, chosen: jax.Array):
        batch = path_batch(config, robot, examples, chosen, settings.step)
        return loss_of(variables, batch, settings.value_weight)

    return update, evaluate


def _validated(evaluate: Callable[..., Any], variables: Any, data: _Data) -> dict[str, float]:
    """Loss and errors in homes held out; the quality is minus the squared error of actions."""
    chosen = data.validation
    parts = np.resize(chosen, (-(-len(chosen) // data.size), data.size))
    found = [jax.device_get(evaluate(variables, data.examples, jnp.asarray(p))) for p in parts]
    loss = float(np.mean([part[0] for part in found]))
    action, value = (float(np.mean([part[1][k] for part in found])) for k in (0, 1))
    return {"loss": loss, "quality": -action, "value_error": value**0.5}


def add_arguments(subparsers: Any) -> None:
    """Add ``--model next`` to the train command, which is there already."""
    parser = subparsers.choices["train"]
    parser.set_defaults(run=partial(_run_command, parser.get_default("run")))
    light = OnlineConfig.light()
    parser.add_argument(
        "--problems",
        type=command.whole(0, 1_000_000),
        help=f"of next: that its planner tries; {light.problems}",
    )
    parser.add_argument(
        "--minutes",
        type=command.real(0.01, 1e6),
        help=f"of next: no epoch begins after so many; {light.minutes:g}",
    )


def _run_command(others: Callable[..., int], arguments: argparse.Namespace) -> int:
    """Train NEXT, or what else was asked for."""
    if arguments.model != NEXT:
        return others(arguments)
    published = arguments.architecture == "published"
    config = (ModelConfig.published if published else ModelConfig.default)(arguments.task, NEXT)
    settings = OnlineConfig() if published else OnlineConfig.light()
    named = ("epochs", "batch", "learning_rate", "seed", "problems", "minutes")
    given = {name: getattr(arguments, name) for name in named}
    given = {name: value for name, value in given.items() if value is not None}
    settings = dataclasses.replace(settings, **given)
    robot, dataset = load_robot(arguments.task), load_dataset(arguments.data)
    stamp = f"{fingerprint(arguments.data)}, {len(dataset)} rows"
    try:
        model = train_online(config, robot, dataset, arguments.out, settings=settings, stamp=stamp)
    except KeyboardInterrupt:
        print(f"the same command goes on from the last epoch in {arguments.out}")
        raise
    figures = ", ".join(f"{name} {value:.4g}" for name, value in model.info["last"].items())
    print(f"wrote {Path(arguments.out) / 'model.npz'}: {figures}")
    return 0
