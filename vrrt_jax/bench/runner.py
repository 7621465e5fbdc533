"""Run many tasks: streamed to a file, resumed from it, over several processes."""

import bisect
import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from vrrt_jax.bench.methods import CAUSES, solve
from vrrt_jax.bench.problem_tasks import files_of, problem_task
from vrrt_jax.bench.tasks import Scenery, Task, bench_robot, make_task
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.interrupt import uninterrupted
from vrrt_jax.core.results_file import fingerprint, plain, resume, write
from vrrt_jax.core.timing import machine, versions
from vrrt_jax.core.workers import in_workers
from vrrt_jax.problems import self_model_path

FORMAT = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Variant:
    """One row of an ablation, or the only row of a benchmark."""

    name: str
    config: PlannerConfig
    method: str = "vrrt"
    guess_sigma: float = 0.0  # [rad]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Everything that decides the numbers."""

    what: str  # visual, pose or ablation
    robot: str
    levels: tuple[float | str, ...]  # the string "random", or names of problem files
    tasks_per_level: int
    seed: int
    variants: tuple[Variant, ...]
    scenery: Scenery
    engine: str  # of the world that is planned in
    hard: bool = False  # only tasks whose straight line is blocked
    problems: str = ""  # a folder of joint-goal problems, whose goals are shown as images

    @property
    def collisions(self) -> bool:
        """Whether there are obstacles, and paths are judged."""
        return self.what != "pose"

    def task(self, level: float | str, index: int) -> Task:
        """The task of a level with a number, drawn again from the seed."""
        if self.problems:
            return problem_task(self.problems, self.robot, str(level), index)
        return make_task(
            self.robot, level, index, self.seed, obstacles=self.collisions, hard=self.hard
        )

    def header(self) -> dict[str, Any]:
        """What a results file must agree on, to be gone on with."""
        return {
            "format": FORMAT,
            **{name: getattr(self, name) for name in ("what", "robot", "seed", "engine", "hard")},
            "problems": _fingerprints(self.problems, self.robot),
            "scenery": dataclasses.asdict(self.scenery),
            "variants": [plain(dataclasses.asdict(variant)) for variant in self.variants],
            "versions": versions(),
            "self_model": fingerprint(self_model_path(bench_robot(self.robot))),
        }


def run(
    benchmark: Benchmark, file: str | Path | None, *, jobs: int = 1, cluster: str | None = None
) -> dict[str, Any]:
    """Run what is not in the file yet, and write every task at once.

    Args:
        benchmark: what to run; more levels or tasks than the file has are added to it.
        file: JSON for the results, None to keep them in memory.
        jobs: processes.
        cluster: address of a Ray cluster, instead of processes.

    Returns:
        What the file holds: the header, ``tasks``, and a summary of each variant.

    Raises:
        ValueError: the file holds another benchmark, version or seed.
        OSError: the file cannot be written; what it held stays.
    """
    results = _fresh(benchmark, jobs)
    if file is not None:
        results = resume(Path(file), benchmark.header(), results)
    done = {_key(row) for row in results["tasks"]}
    todo = [
        (variant.name, level, index)
        for index in range(benchmark.tasks_per_level)
        for level in benchmark.levels
        for variant in benchmark.variants
        if (variant.name, level, index) not in done
    ]
    # Rows stand in the order of tasks, whatever comes first.
    order = partial(_place, benchmark)
    results["tasks"].sort(key=order)
    with tqdm(total=len(todo), unit="task", disable=None) as bar:
        won = 0
        rows = in_workers(partial(_run_task, benchmark), todo, jobs, cluster)
        for count, row in enumerate(rows, 1):
            bisect.insort(results["tasks"], row, key=order)
            results.update(_summary(benchmark, results["tasks"]))
            if file is not None:
                write(Path(file), results)
            won += row["success"]
            bar.set_postfix_str(f"{100 * won / count:.0f} % solved")
            bar.update()
    results.update(_summary(benchmark, results["tasks"]))
    return results


def _run_task(benchmark: Benchmark, item: tuple[str, float | str, int]) -> dict[str, Any]:
    name, level, index = item
    variant = next(v for v in benchmark.variants if v.name == name)
    task = benchmark.task(level, index)
    with uninterrupted():
        row = solve(
            benchmark.robot,
            task,
            method=variant.method,
            config=variant.config,
            scenery=benchmark.scenery,
            seed=benchmark.seed,
            guess_sigma=variant.guess_sigma,
            collisions=benchmark.collisions,
            engine=benchmark.engine,
        )
    return {"variant": name, **row}


def _place(benchmark: Benchmark, row: dict[str, Any]) -> tuple[int, ...]:
    """Where a row stands in a file; levels that were asked for in an earlier run are last."""
    names, levels = [v.name for v in benchmark.variants], list(benchmark.levels)
    level = levels.index(row["level"]) if row["level"] in levels else len(levels)
    return row["index"], level, names.index(row["variant"])


def _key(row: dict[str, Any]) -> tuple[str, float | str, int]:
    return row["variant"], row["level"], row["index"]


def _fingerprints(folder: str, robot: str) -> dict[str, str]:
    """Of the files of problems, by name; {} without a folder."""
    files = files_of(folder, robot) if folder else {}
    return {name: fingerprint(file) for name, file in files.items()}


def _fresh(benchmark: Benchmark, jobs: int) -> dict[str, Any]:
    here = machine()
    here["cores"] = max(1, int(here["cores"]) // jobs)  # that a task has
    return {**benchmark.header(), "machine": here, "tasks": []}


def _summary(benchmark: Benchmark, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Success and more by level; of an ablation, by variant."""
    by_variant = {
        variant.name: summarize([row for row in rows if row["variant"] == variant.name])
        for variant in benchmark.variants
    }
    if len(by_variant) == 1:
        return next(iter(by_variant.values()))
    return {"by_variant": by_variant}


def summarize(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """``average_success``, the mean of the levels', and ``levels``."""
    levels = []
    # Distances in order, then the levels that have names.
    for level in sorted({row["level"] for row in rows}, key=lambda x: (isinstance(x, str), x)):
        own = [row for row in rows if row["level"] == level]
        won = [row for row in own if row["success"]]
        levels.append(
            {
                "level": level,
                "distance_rad": _median(row.get("distance_rad", level) for row in own),
                "n": len(own),
                "success": _mean(row["success"] for row in own),
                "false_solved": _mean(row["false_solved"] for row in own if "false_solved" in row),
                # Of what is solved, the share whose whole path came out of the search's tree.
                "from_tree": _mean(
                    row["tree_share"] == 1 for row in won if row.get("tree_share") is not None
                ),
                "median_time_s": _median(row["time_s"] for row in own),
                "p95_time_s": round(float(np.quantile([row["time_s"] for row in own], 0.95)), 2),
                "path_length": _mean(row["path_length"] for row in won),
                "path_over_reference": _median(
                    row["path_over_reference"] for row in won if row["path_over_reference"]
                ),
                "mean_error_rad": _mean(row["mean_error_rad"] for row in own),
                "median_psnr_db": _median(row["psnr_db"] for row in own),
                "refused_paths": total_refused(own),
                "straight_blocked": _mean(row["straight_is_blocked"] for row in own),
                "causes": {
                    cause: count
                    for cause in CAUSES
                    if (count := sum(row["cause"] == cause for row in own))
                },
            }
        )
    return {"average_success": _mean(level["success"] for level in levels), "levels": levels}


def total_refused(rows: Sequence[Mapping[str, Any]]) -> int | None:
    """Paths that the exact check refused; None where an older file did not count them."""
    counts = [row["refused_paths"] for row in rows if "refused_paths" in row]
    return sum(counts) if len(counts) == len(rows) else None


def _mean(values) -> float | None:
    values = list(values)
    return round(float(np.mean(values)), 4) if values else None


def _median(values) -> float | None:
    values = list(values)
    return round(float(np.median(values)), 3) if values else None
