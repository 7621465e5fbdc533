"""Training of NEXT: on an expert's paths first, then on those that its own planner finds.

After Chen et al. (ICLR 2020): the planner solves problems in the training homes, exploring ever less,
and every so many new states the network is trained again. Letters: ``K`` states of a path, ``D``
joints.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from nrp_jax.config import PlannerConfig
from nrp_jax.learning.checkpoint import Model, build_module, save_model
from nrp_jax.learning.data import Dataset, fingerprint, load_dataset
from nrp_jax.learning.difficulty import long_queries
from nrp_jax.learning.models import NEXT, ModelConfig
from nrp_jax.learning.next_rows import (
    PathExamples,
    even_states,
    next_loss,
    path_batch,
    path_examples,
    with_paths,
)
from nrp_jax.learning.recipe import TrainConfig
from nrp_jax.learning.train import split_by_home
from nrp_jax.learning.training_io import (
    CheckpointStore,
    State,
    claim_output_dir,
    epochs_since_best,
    plot_curves,
    write_log,
)
from nrp_jax.planners.by_name import policy_of
from nrp_jax.samplers import make_sampler
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import build_world
from vrrt_jax.core import command
from vrrt_jax.core.files import replacing
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.search import COST, make_termination, search
from vrrt_jax.core.settings import check_settings, setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnlineConfig:
    """How NEXT is trained; the defaults are those that the NRP paper's authors published."""

    epochs: int = setting(50, 1, 100_000)  # on the expert's paths
    batch: int = setting(256, 1, 65_536)  # states a step
    learning_rate: float = setting(1e-3, 1e-8, 1.0)
    weight_decay: float = setting(5e-5, 0.0, 1.0)  # in the gradient
    value_weight: float = setting(0.1, 0.0, 1e3)  # of the values' squared error in the loss
    augment: bool = False  # turn and mirror each path at random
    problems: int = setting(9000, 0, 1_000_000)  # that its planner tries in the training homes
    expansions: int = setting(500, 1, 1_000_000)  # of a problem
    states: int = setting(2000, 1, 1_000_000)  # new ones after which it is trained again
    round_epochs: int = setting(10, 1, 100_000)  # of each such training, on all paths so far
    explored: float = setting(1.0, 0.0, 1.0)  # share of RRT*'s expansions in the first problems
    least_explored: float = setting(0.1, 0.0, 1.0)  # and in the last ones, by tenths
    lanes: int = setting(32, 1, 4096)  # expansions at a time
    validation: float = 0.15  # share of the homes that is held out
    minutes: float = setting(1e6, 0.0, endless=True)  # no epoch begins after so many
    seed: int = setting(0, 0, 2**31)

    @classmethod
    def light(cls) -> Self:
        """For two cores: a tenth of the problems, fewer epochs, shorter rounds, and symmetries."""
        return cls(epochs=8, problems=900, states=1000, round_epochs=1, augment=True, minutes=60.0)

    def explored_in(self, problem: int) -> float:
        """The share of RRT*'s expansions in a problem."""
        tenths = int(10 * (self.explored - self.least_explored) * problem / max(self.problems, 1))
        return max(self.explored - tenths / 10, self.least_explored)


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

    An interrupted training goes on from its last checkpoint.

    Args:
        config: the architecture.
        robot: whose configurations the paths hold.
        dataset: of paths, from :func:`nrp_jax.learning.data.load_dataset`.
        out: folder for ``model.npz`` (the epoch that is best on the expert's paths in homes held
            out), ``log.csv``, ``curves.png``, ``checkpoint/`` and the paths that were found.
        settings: of the training; the published ones if None.
        stamp: names the data; a training goes on only with the same.
        progress: show progress bars.

    Raises:
        ValueError: ``out`` holds another training, the data set has no paths of this robot, or too
            few homes to hold some out.
        RuntimeError: the validation loss is not finite any more.
    """
    settings = OnlineConfig() if settings is None else settings
    check_settings(settings)
    began = time.perf_counter()
    examples = path_examples(config, robot, dataset, settings.problems)
    num_expert = len(dataset) // dataset.settings.waypoints
    home = np.asarray(examples.home)[:num_expert]
    split = TrainConfig(seed=settings.seed, validation=settings.validation)
    training, validation = split_by_home(home, split)
    recipe = dataclasses.asdict(dataclasses.replace(settings, minutes=0.0))
    parts = {"model": dataclasses.asdict(config), "settings": recipe, "data": stamp}
    out = claim_output_dir(Path(out), parts)

    # The network, the optimizer, and a random or restored state.
    module = build_module(config, robot.num_joints)
    optimizer = optax.chain(
        optax.add_decayed_weights(settings.weight_decay), optax.adam(settings.learning_rate)
    )
    first = jax.eval_shape(partial(path_batch, config, robot), examples, jnp.zeros(1, jnp.int32))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), first)
    key = jax.random.key(settings.seed)
    variables: Any = jax.jit(module.init)(key, zeros.image, zeros.goal, zeros.q)
    state = State(variables=variables, optimizer=optimizer.init(variables), step=jnp.int32(0))
    store = CheckpointStore(out / "checkpoint")
    state, best, history = store.restore(state)
    update, evaluate = _programs(config, robot, module, optimizer, settings)
    problems = _Problems(robot, dataset, np.unique(home[training]), settings)
    before_s = sum(row["seconds"] for row in history)

    def model_of(variables: Any) -> Model:
        info = {"num_outputs": robot.num_joints, "data": stamp}
        if history:
            info["best"] = min(history, key=lambda row: row["loss"])
        return Model(config=config, variables=variables, info=info)

    # Epochs on the expert's paths, then rounds of problems with epochs on all paths.
    size = max(settings.batch // (examples.q.shape[1] - 1), 1)
    size, num, tried, rounds, solved = min(size, len(training)), num_expert, 0, 0, 0.0
    bar = tqdm(desc=f"{config.task} {NEXT}", unit="epoch", disable=not progress)
    epoch = 0
    while True:
        wanted = max(0, (epoch - settings.epochs) // settings.round_epochs + 1)
        late = before_s + time.perf_counter() - began > 60 * settings.minutes
        is_old = epoch < len(history)
        if not is_old and (late or (wanted > rounds and tried >= settings.problems)):
            break
        started = time.perf_counter()
        while rounds < wanted:
            rounds += 1
            made = problems.solve(out / f"paths_{rounds:04d}.npz", tried, model_of(state.variables))
            examples = with_paths(robot, examples, num, made.home, made.q, made.length)
            solved = len(made.q) / max(made.tried - tried, 1)
            num, tried = num + len(made.q), made.tried
        if is_old:
            epoch += 1
            continue
        chosen = np.concatenate([training, np.arange(num_expert, num)])
        order = np.random.default_rng([settings.seed, epoch]).permutation(chosen)
        losses = []
        for part in order[: len(order) // size * size].reshape(-1, size):
            state, loss = update(state, examples, jnp.asarray(part))
            losses.append(loss)
        figures = _validated(evaluate, state.variables, examples, validation, size)
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
                "problems": tried,
                "paths": num - num_expert,
                "solved": solved,
                "seconds": round(time.perf_counter() - started, 2),
            }
        )
        if epochs_since_best(history) == 0:
            best = jax.device_get(state.variables)
            save_model(model_of(best), out / "model.npz")
        store.save(state, best, history, last=True)
        write_log(history, out)
        bar.update()
        bar.set_postfix_str(f"loss {figures['loss']:.3f}, {tried} problems, {solved:.0%} solved")
        epoch += 1
    bar.close()
    store.close()
    model = model_of(best)
    save_model(model, out / "model.npz")
    try:
        plot_curves(history, out / "curves.png", f"{config.task} {config.kind}")
    except ModuleNotFoundError:
        print("no curves: matplotlib is missing; pip install 'vrrt-jax[plot]'", file=sys.stderr)
    return model


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Found:
    """The paths that a round found."""

    home: np.ndarray  # (n,)
    q: np.ndarray  # (n, K, D)
    length: np.ndarray  # (n,) [m]
    tried: int  # problems up to the end of the round


class _Problems:
    """Long queries in the training homes, and the planner that tries them."""

    def __init__(
        self, robot: MobileRobot, dataset: Dataset, homes: np.ndarray, settings: OnlineConfig
    ):
        """Take these homes of a data set in turn; nothing is drawn before it is needed."""
        self.robot, self.dataset, self.homes, self.settings = robot, dataset, homes, settings
        self._drawn: dict[int, Any] = {}

    def solve(self, file: Path, first: int, model: Model) -> _Found:
        """Try problems from ``first`` on, until their paths have enough states; or read the file."""
        settings = self.settings
        num_states = self.dataset.settings.waypoints + 2
        if file.exists():
            with np.load(file) as saved:
                arrays = {name: saved[name] for name in ("home", "q", "length")}
                return _Found(**arrays, tried=int(saved["tried"]))
        homes, paths, lengths, problem = [], [], [], first
        while problem < settings.problems and len(paths) * (num_states - 1) < settings.states:
            home, world, path = self._solved(problem, model)
            problem += 1
            if path is not None:
                states, length = even_states(world, path, num_states)
                for column, value in zip(
                    (homes, paths, lengths), (home, states, length), strict=True
                ):
                    column.append(value)
        found = _Found(
            home=np.array(homes, np.int32),
            q=np.array(paths, np.float32).reshape(-1, num_states, self.robot.num_joints),
            length=np.array(lengths, np.float32),
            tried=problem,
        )
        with replacing(file) as handle:
            np.savez_compressed(handle, **vars(found))
        return found

    def _solved(self, problem: int, model: Model) -> tuple[int, Any, np.ndarray | None]:
        """The home of a problem, its world, and the path (P, D) that was found, if any."""
        settings, robot = self.settings, self.robot
        home = int(self.homes[problem % len(self.homes)])
        world, starts, goals = self._of_home(home)
        start, goal = (q[problem // len(self.homes)] for q in (starts, goals))
        key = jax.random.fold_in(jax.random.key(settings.seed), problem)
        planner = PlannerConfig(goal_bias=0.1, lanes=settings.lanes)
        policy: Any = policy_of(NEXT, robot, world, make_sampler(model), planner, (start, goal))
        share = jnp.float32(settings.explored_in(problem))
        policy = dataclasses.replace(policy, explored_share=share)
        target = ConfigurationGoal(q=jnp.asarray(goal))
        iterations = -(-settings.expansions // settings.lanes)
        room = 1 << (iterations * settings.lanes + 1).bit_length()
        tree = policy.init(world, target, start[None], room)
        rule = make_termination(policy.goal_score(target), max_iterations=iterations)
        found = search(world, target, policy, tree, key=key, termination=rule)
        if not np.isfinite(found.history[-1, COST]):
            return home, world, None
        return home, world, policy.extract_path(found.tree)

    def _of_home(self, home: int) -> tuple[Any, np.ndarray, np.ndarray]:
        """A home's world, with checks as fine as such a planner's, and all its starts and goals."""
        if home not in self._drawn:
            grid = self.dataset.grids[home]
            grid = grid.flatten() if self.robot.planar else grid
            world = build_world(self.robot, grid)
            num = -(-self.settings.problems // len(self.homes))
            ends = long_queries(self.robot, world, grid, num, self.settings.seed)
            world = dataclasses.replace(world, resolution=world.resolution / 2)
            self._drawn[home] = (world, *ends)
        return self._drawn[home]


def _programs(
    config: ModelConfig,
    robot: MobileRobot,
    module: Any,
    optimizer: optax.GradientTransformation,
    settings: OnlineConfig,
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled: a step of the optimizer on chosen paths (n,), and the errors of some."""
    loss_of = partial(next_loss, module)

    @jax.jit
    def update(state: State, examples: PathExamples, chosen: jax.Array):
        key = jax.random.fold_in(jax.random.key(settings.seed), state.step)
        batch = path_batch(config, robot, examples, chosen, key if settings.augment else None)
        gradient_of = jax.value_and_grad(loss_of, has_aux=True)
        (loss, _), gradient = gradient_of(state.variables, batch, settings.value_weight)
        updates, moments = optimizer.update(gradient, state.optimizer, state.variables)
        variables = optax.apply_updates(state.variables, updates)
        return State(variables=variables, optimizer=moments, step=state.step + 1), loss

    @jax.jit
    def evaluate(variables: Any, examples: PathExamples, chosen: jax.Array):
        batch = path_batch(config, robot, examples, chosen)
        return loss_of(variables, batch, settings.value_weight)

    return update, evaluate


def _validated(
    evaluate: Callable[..., Any],
    variables: Any,
    examples: PathExamples,
    chosen: np.ndarray,
    size: int,
) -> dict[str, float]:
    """Loss and errors on chosen paths (n,); the quality is minus the squared error of actions."""
    parts = np.resize(chosen, (-(-len(chosen) // size), size))
    found = [jax.device_get(evaluate(variables, examples, jnp.asarray(p))) for p in parts]
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
    figures = ", ".join(f"{name} {value:.4g}" for name, value in model.info["best"].items())
    print(f"wrote {Path(arguments.out) / 'model.npz'}: {figures}")
    return 0
