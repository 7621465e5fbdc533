"""The benchmark of joint goals on files of problems from elsewhere, resumed from its results."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from vrrt_jax.bench import arm_trials, ompl_peers
from vrrt_jax.bench.arm_problems import ArmProblems, read_problems
from vrrt_jax.bench.arm_trials import Refusal, Trial
from vrrt_jax.bench.runner import total_refused
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.results_file import plain, resume, write
from vrrt_jax.core.timing import machine, versions
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.world import World, build_world

FORMAT = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmBenchmark:
    """Everything that decides the numbers, but for the files."""

    robot: Robot
    planner: str = "rrt-connect"
    config: PlannerConfig = PlannerConfig()
    engine: str | None = None  # of the world; the usual one if None
    base: tuple[float, ...] | None = None  # see arm_problems.read_problems
    limit: int | None = None  # problems of a file, evenly taken; all if None
    batch: int | None = None  # size of the batches whose rate is measured; none if None
    peers: bool = False  # OMPL's planners too
    seed: int = 0

    def header(self) -> dict[str, Any]:
        """What a results file must agree on, to be gone on with.

        Raises:
            ModuleNotFoundError: the peers are asked for, and not installed.
        """
        settings = ("planner", "engine", "base", "limit", "batch", "seed")
        return plain(
            {
                "format": FORMAT,
                "what": "arm",
                "robot": self.robot.name,
                "joints": self.robot.joint_names,
                "verified_with": exact_scene(self.robot, []).geometry,
                **{name: getattr(self, name) for name in settings},
                "config": dataclasses.asdict(self.config),
                "peer_settings": ompl_peers.settings() if self.peers else None,
                "versions": versions(),
            }
        )


def run(
    benchmark: ArmBenchmark,
    files: Sequence[Path],
    results_file: str | Path | None,
    say: Callable[[str], Any] = print,
) -> dict[str, Any]:
    """Run the files that the results lack; they are written after each.

    Args:
        benchmark: what to run.
        files: of problems; their names must differ.
        results_file: JSON for the results, None to keep them in memory.
        say: gets a line for each file whose robot differs from this one.

    Returns:
        What the results file holds: the header, ``machine`` and ``scenes``, by name of file.

    Raises:
        ValueError: a file is damaged or of another robot, or the results are of another benchmark.
        OSError: the results cannot be written; what they held stays.
        KeyboardInterrupt: Ctrl-C was pressed; the files done before are kept.
    """
    _check(benchmark)
    header = benchmark.header()
    results = {**header, "machine": machine(), "scenes": {}}
    # All files are read before the first plan, so that a bad one is told at once.
    problems = [read_problems(file, benchmark.robot, benchmark.base) for file in files]
    if results_file is not None:
        results = resume(Path(results_file), header, results)
    _check_done(results["scenes"], problems)
    # One world for all: its slots are refilled, so that nothing compiles twice.
    most = max(len(obstacles) for own in problems for obstacles in own.obstacles)
    settings: dict[str, Any] = {} if benchmark.engine is None else {"engine": benchmark.engine}
    world = build_world(benchmark.robot, [], num_slots=most, **settings)
    for own in problems:
        if own.differences:
            say(f"{own.name}: {'; '.join(own.differences)}")
        if own.name not in results["scenes"]:
            results["scenes"][own.name] = _run_scene(benchmark, world, own)
            results |= _totals(results["scenes"])
            if results_file is not None:
                write(Path(results_file), results)
    return results


def _totals(scenes: Mapping[str, Any]) -> dict[str, Any]:
    """What is told of all files together: rates of batches, and peers by name."""
    totals: dict[str, Any] = {}
    timed = [scene for scene in scenes.values() if scene.get("batch_problems_per_s")]
    if timed:
        tried = [len(scene["rows"]) for scene in timed]
        seconds = sum(
            num / scene["batch_problems_per_s"] for num, scene in zip(tried, timed, strict=True)
        )
        totals["batch_problems_per_s"] = round(sum(tried) / seconds, 2)
    names = {name for scene in scenes.values() for name in scene.get("peers", {})}
    if names:
        totals["peers"] = {
            name: {
                "scenes": {
                    file: {"n": scene["n"], "refused": scene["refused"]}
                    | {key: part for key, part in scene["peers"][name].items() if key != "rows"}
                    for file, scene in scenes.items()
                    if name in scene.get("peers", {})
                }
            }
            for name in sorted(names)
        }
    return totals


def _check(benchmark: ArmBenchmark) -> None:
    for name in ("limit", "batch"):
        value = getattr(benchmark, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name} is {value}; expected at least 1")
    if benchmark.batch is not None and benchmark.planner == arm_trials.POSE:
        raise ValueError("--batch is for joint goals; drop it for --planner pose")


def _check_done(scenes: Mapping[str, Any], problems: Sequence[ArmProblems]) -> None:
    """Refuse results of a file that has changed since."""
    for own in problems:
        done = scenes.get(own.name)
        if done is not None and done["fingerprint"] != own.fingerprint:
            raise ValueError(
                f"'{own.name}' was run on a file with the fingerprint {done['fingerprint']}, which "
                f"is {own.fingerprint} now: results of different files are not mixed; choose "
                "another --json"
            )


def _run_scene(benchmark: ArmBenchmark, world: World, problems: ArmProblems) -> dict[str, Any]:
    """All of one file: ours, batches, peers."""
    robot, chosen = benchmark.robot, evenly(len(problems.q_start), benchmark.limit)
    posed = [arm_trials.pose_problem(robot, world, problems, index) for index in chosen]
    refused = [found for found in posed if isinstance(found, Refusal)]
    trials = [found for found in posed if isinstance(found, Trial)]
    settings = {
        "planner_name": benchmark.planner,
        "config": benchmark.config,
        "seed": benchmark.seed,
    }
    ours = partial(arm_trials.solve, robot, **settings)
    for group in arm_trials.alike(trials):  # this plan compiles, and is planned again with others
        ours(group[0])
    rows = _rows(trials, ours, problems.name)
    scene = {
        "fingerprint": problems.fingerprint,
        "differences": list(problems.differences),
        "n": len(chosen),
        "refused": [dataclasses.asdict(refusal) for refusal in refused],
        **summarize(rows),
        "held_attached": sum(row["held_attached"] for row in rows),
        "recompiled": sum(row["recompiled"] for row in rows),
    }
    if benchmark.batch is not None and trials:
        rate = arm_trials.batch_rate(robot, trials, size=benchmark.batch, **settings)
        scene["batch_problems_per_s"] = round(rate, 2)
    if benchmark.peers:
        scene["peers"] = {}
        for name in ompl_peers.PEERS:
            peer = partial(ompl_peers.solve, robot, name=name, seed=benchmark.seed)
            peer_rows = _rows(trials, peer, f"{problems.name}, {name}")
            scene["peers"][name] = {
                **summarize(peer_rows),
                "found": sum(row["found"] for row in peer_rows),
                "rows": _rounded(peer_rows),
            }
    scene["rows"] = _rounded(rows)
    return scene


def _rows(
    trials: Sequence[Trial], solve: Callable[[Trial], dict[str, Any]], name: str
) -> list[dict[str, Any]]:
    bar = tqdm(trials, desc=name, unit="problem", disable=None, leave=False)
    return [solve(trial) for trial in bar]


def evenly(count: int, limit: int | None) -> list[int]:
    """Every k-th index below ``count``, at most ``limit`` of them."""
    step = 1 if limit is None else max(count // limit, 1)
    return list(range(0, count, step))[:limit]


def summarize(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What is told of the rows of one planner on one file.

    Returns:
        ``solved``, ``failed``, and of all that were tried the times ``median_ms``, ``p95_ms``,
        ``search_median_ms`` and ``stages_ms``; ``cost`` is the median of what was solved,
        ``raw_cost`` that before it was shortened; ``refused_paths`` is how many paths the exact
        check refused before. None where there is nothing to tell.
    """
    walls = [row["wall_ms"] for row in rows]
    names = rows[0]["stages_ms"] if rows else ()
    stages = {name: _median(row["stages_ms"][name] for row in rows) for name in names}
    return {
        "solved": sum(row["solved"] for row in rows),
        "failed": [
            {"index": row["index"], "status": row["status"]} for row in rows if not row["solved"]
        ],
        "median_ms": _median(walls),
        "p95_ms": round(float(np.quantile(walls, 0.95)), 2) if walls else None,
        "search_median_ms": stages.get("search"),
        "stages_ms": stages,
        "raw_cost": _median(row["raw_cost"] for row in rows),
        "cost": _median(row["cost"] for row in rows),
        "refused_paths": total_refused(rows),
    }


def _median(values: Any) -> float | None:
    values = [value for value in values if value is not None]
    return round(float(np.median(values)), 3) if values else None


def _rounded(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows as JSON keeps them."""

    def rounded(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: rounded(part) for name, part in value.items()}
        return round(value, 4) if isinstance(value, float) else value

    return [rounded(row) for row in rows]
