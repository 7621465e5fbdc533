"""The benchmarks by name: the paper's tasks, pose reconstruction, the ablations."""

import math
from collections.abc import Sequence

from vrrt_jax.bench.methods import CONFIGS, METHODS
from vrrt_jax.bench.problem_tasks import files_of, usable_problems
from vrrt_jax.bench.runner import Benchmark, Variant
from vrrt_jax.bench.tasks import RANDOM, Scenery, bench_robot
from vrrt_jax.config import PlannerConfig
from vrrt_jax.scene.world import ENGINES

# By the settings that are varied, one by one. Of the paper's, the values that the paper varies; of
# the default, what it does and the paper does not: each is taken away, after the whole.
ABLATIONS = {
    "paper": {
        "expand.exploration": (0.1, 0.3, 0.5, 0.7, 0.9),
        "expand.rho": (0.7, 0.04),
        "expand.eta": (0.0, 0.2, 0.4, 0.6, 0.8, 1.0),
        "expand.kappa": (0.5, 0.8, 0.9, 0.95, 0.99),
        "expand.beta1": (0.5, 0.9, 0.99),
        "expand.beta2": (0.9, 0.999),
        "tree.lanes": (8, 32, 128),
        "expand.inherit": (True, False),
    },
    "default": {
        "budget.max_iterations": (400, 1),
        "lineages.samples": (256,),
        "lineages.jumps": (0,),
        "lineages.steps": (1,),
        "lineages.num": (16, 1),
        "polish.hypotheses": (0, 1),
        "polish.close_px": (0,),
        "polish.start_prior": (0.0,),
        "match.ambiguity": (1.0,),
        "budget.attempts": (1,),
        "budget.settle_iterations": (0,),
    },
}
WORLDS = ("standard", "hard")
GUESS_SIGMAS = (0.05, 0.10, 0.15, 0.20)  # [rad]


def benchmark(
    what: str,
    robot: str,
    *,
    levels: Sequence[float | str],
    tasks_per_level: int,
    seed: int,
    method: str = "vrrt",
    config: str = "default",
    only: str | None = None,
    engine: str = "mjx",
    scenery: Scenery | None = None,
    time_limit_s: float = 60.0,
    worlds: str = "standard",
    problems: str | None = None,
) -> Benchmark:
    """Put a benchmark together.

    Args:
        what: "visual" (the paper's tasks), "pose" (no obstacles) or "ablation".
        robot: one of :data:`~vrrt_jax.bench.tasks.ROBOTS`, or a folder of ``vrrt fit``.
        levels: distances from start to goal [rad], or "random" for any pairs.
        tasks_per_level: number of tasks at each.
        seed: of tasks and method.
        method: one of :data:`~vrrt_jax.bench.methods.METHODS`.
        config: "default" or "paper"; what an ablation varies.
        only: one of its settings, all of them if None.
        engine: of the world that is planned in.
        scenery: what goal images look like.
        time_limit_s: of one search [s].
        worlds: "standard", or "hard" for tasks whose straight line is blocked.
        problems: a folder of joint-goal problems, whose scenes, starts and goals are the tasks; the
            levels are then its files.

    Raises:
        FileNotFoundError: there are no problems in the folder.
        ValueError: a name is unknown, or a number makes no sense.
    """
    bench_robot(robot)
    for name, value, known in (
        ("method", method, METHODS),
        ("config", config, CONFIGS),
        ("engine", engine, ENGINES),
        ("worlds", worlds, WORLDS),
        ("ablation", only, (None, *map(_short, ABLATIONS.get(config, ())), "guess")),
    ):
        if value not in known:
            names = ", ".join(str(n) for n in known if n is not None)
            raise ValueError(f"unknown {name} '{value}'; have: {names}")
    if problems is not None:
        if what == "pose" or worlds == "hard":
            raise ValueError("problems come with their own worlds; drop 'pose', or 'hard'")
        levels = _levels_of(problems, robot, tasks_per_level)
    if tasks_per_level < 1 or not levels or not all(map(_is_level, levels)):
        raise ValueError(
            f"got levels {list(levels)} and {tasks_per_level} tasks a level; expected distances "
            f"above 0 or '{RANDOM}', and at least one task"
        )
    settings = PlannerConfig.paper() if config == "paper" else PlannerConfig()
    settings = settings.changed({"budget.time_limit_s": time_limit_s})
    base = Variant(name=method, method=method, config=settings)
    return Benchmark(
        what=what,
        robot=robot,
        levels=tuple(levels),
        tasks_per_level=tasks_per_level,
        seed=seed,
        engine=engine,
        variants=_ablations(config, only, base.config) if what == "ablation" else (base,),
        scenery=scenery or Scenery(),
        hard=worlds == "hard",
        problems=problems or "",
    )


def _is_level(level: float | str) -> bool:
    return isinstance(level, str) or 0 < level < math.inf


def _levels_of(folder: str, robot: str, tasks: int) -> tuple[str, ...]:
    """The files of a folder of problems, each of which has enough of them."""
    for file in files_of(folder, robot).values():
        if tasks > (num := len(usable_problems(file, robot))):
            raise ValueError(
                f"'{file}' has {num} problems whose ends are free; expected {tasks}: lower "
                "tasks_per_level"
            )
    return tuple(files_of(folder, robot))


def _ablations(config: str, only: str | None, base: PlannerConfig) -> tuple[Variant, ...]:
    variants = [
        Variant(name=f"{_short(name)}={value}", config=base.changed({name: value}))
        for name, values in ABLATIONS[config].items()
        if only in (None, _short(name))
        for value in values
    ]
    if only in (None, "guess"):
        variants += [
            Variant(name=f"guess={sigma}", config=base, guess_sigma=sigma) for sigma in GUESS_SIGMAS
        ]
    return tuple(variants)


def _short(name: str) -> str:
    """A setting of the paper's own by its symbol, ``eta``; others with their stage."""
    stage, _, last = name.partition(".")
    return last if stage in ("expand", "tree") else name
