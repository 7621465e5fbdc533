"""The ``nrp bench curves`` command: success and path optimality over time, as the paper measures.

Rows are written as they come, into a file beside the results, so that a run that was stopped goes
on where it was.
"""

import argparse
import dataclasses
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from nrp_jax.bench import curve_homes, ompl_peers
from nrp_jax.bench.curve_rows import ROADMAP, Item, Setting, run_item
from nrp_jax.bench.curve_stats import NOTES, REFERENCE, curves, grid_to, references
from nrp_jax.bench.curve_table import to_text
from nrp_jax.homes.houses import CELLS
from nrp_jax.planners.by_name import KINDS, check_names
from nrp_jax.samplers import check_fits, load_sampler
from nrp_jax.scene.robots import load_robot
from nrp_jax.scene.world import build_world
from vrrt_jax.core import command, workers
from vrrt_jax.core.peers import ompl_version
from vrrt_jax.core.results_file import append_row, plain, resume_rows, write
from vrrt_jax.core.timing import machine, versions
from vrrt_jax.core.workers import in_workers

FORMAT = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class CurveBenchmark:
    """What to measure; planners and runs can be added to rows that are there."""

    setting: Setting
    planners: tuple[str, ...]  # of by_name.PLANNERS or ompl_peers.PEERS
    runs: int = 1
    jobs: int = 1
    cluster: str | None = None  # address of a Ray cluster, instead of processes

    def header(self) -> dict[str, Any]:
        """What rows must agree on, to be gone on with."""
        homes = self.setting.homes
        numbers = ("task", "budget_s", "lanes", "nodes", "seed")
        return plain(
            {
                "format": FORMAT,
                "what": "execution" if self.setting.quickened else "curves",
                **{name: getattr(self.setting, name) for name in numbers},
                "jobs": self.jobs,
                "homes": {home.name: home.fingerprint() for home in homes},
                "versions": versions(),
            }
        )

    def items(self) -> list[Item]:
        """All that there is to do, planners in turn, so that what disturbs them hits all alike."""
        homes = self.setting.homes
        roadmaps = range(len(homes)) if self.setting.nodes else ()
        return [Item(planner=ROADMAP, home=home) for home in roadmaps] + [
            Item(planner=planner, home=home, query=query, run=run)
            for run in range(self.runs)
            for home in range(len(homes))
            for query in range(len(homes[home].starts))
            for planner in self.planners
        ]


def run(benchmark: CurveBenchmark, file: Path | None) -> dict[str, Any]:
    """Measure what is not in the file of rows yet, and tell the curves.

    Args:
        benchmark: what to measure.
        file: JSON for the results, None to keep them in memory. Rows are in a file beside it, whose
            name ends in ``.rows``; each is written at once.

    Returns:
        What the JSON holds: the header, ``machine``, ``planners`` (see
        :func:`nrp_jax.bench.curve_stats.curves`) and more.

    Raises:
        ValueError: the rows are of another benchmark, version or seed, or a planner's network does
            not fit a home's map.
        OSError: a file cannot be written; the rows that were written stay.
    """
    header, rows = measure(benchmark, file)
    results = summary(benchmark, header, rows)
    if file is not None:
        write(file, results)
    return results


def measure(
    benchmark: CurveBenchmark, file: Path | None
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The header and all rows of a benchmark; arguments and errors are those of :func:`run`."""
    header, homes = benchmark.header(), benchmark.setting.homes
    rows_file = None if file is None else file.with_name(f"{file.name}.rows")
    rows = [] if rows_file is None else resume_rows(rows_file, header)
    _check_samplers(benchmark)
    done = {(row["planner"], row["home"], row["query"], row["run"]) for row in rows}
    todo = [
        item
        for item in benchmark.items()
        if (item.planner, homes[item.home].name, item.query, item.run) not in done
    ]
    work = partial(run_item, benchmark.setting)
    won = tried = 0
    with tqdm(total=len(todo), unit="plan", disable=None) as bar:
        for row in in_workers(work, todo, benchmark.jobs, benchmark.cluster):
            rows.append(row)
            if rows_file is not None:
                append_row(rows_file, row)
            won, tried = won + row.get("solved", 0), tried + ("solved" in row)
            bar.set_postfix_str(f"{100 * won / max(tried, 1):.0f} % solved")
            bar.update()
    return header, rows


def _check_samplers(benchmark: CurveBenchmark) -> None:
    """Refuse at once what would end a run half way: a map that a planner's network cannot see."""
    robot = load_robot(benchmark.setting.task)
    learned = [name for name in benchmark.planners if name in KINDS]
    samplers = {kind: load_sampler(robot.name, kind) for kind in {KINDS[name] for name in learned}}
    for home in benchmark.setting.homes if learned else ():
        world = build_world(robot, home.grid)
        for name in learned:
            try:
                check_fits(samplers[KINDS[name]], robot, world, KINDS[name])
            except ValueError as error:
                raise ValueError(f"{name} in '{home.name}': {error}") from None


def summary(
    benchmark: CurveBenchmark, header: dict[str, Any], rows: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """All that is told of the rows of the planners that were asked for."""
    here = machine()
    here["cores"] = max(1, int(here["cores"]) // benchmark.jobs)  # that a plan has
    setting = benchmark.setting
    roadmaps = {row["home"]: row["reference"] for row in rows if row["planner"] == ROADMAP}
    plans = [row for row in rows if row["planner"] != ROADMAP]
    reference = references(plans, roadmaps)
    grids = {
        "time_s": grid_to(setting.budget_s, 0.1),
        "expansions": grid_to(max(row["expansions"] for row in plans), 10),
        "checks": grid_to(max(row["checks"] for row in plans), 1000),
    }
    return {
        **header,
        "machine": here,
        "command": shlex.join(["nrp", *sys.argv[1:]]),
        "runs": benchmark.runs,
        "queries": {home.name: len(home.starts) for home in setting.homes},
        "labels": {home.name: home.labels for home in setting.homes if home.labels},
        "poses": {home.name: home.notes for home in setting.homes if home.notes},
        "ompl": ompl_version() if {*benchmark.planners} & {*ompl_peers.PEERS} else None,
        "reference": {"what": REFERENCE, "roadmaps": roadmaps, "costs": reference},
        "notes": NOTES,
        "planners": {
            planner: curves([row for row in plans if row["planner"] == planner], reference, grids)
            for planner in benchmark.planners
        },
    }


def add_arguments(subparsers: Any) -> None:
    """Add ``curves`` to the bench command."""
    parser = subparsers.add_parser("curves", help="success and path optimality over time")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", default="snake", choices=tuple(CELLS), help="whose queries")
    parser.add_argument("--planners", help="names for nrp_jax.plan; all of the robot's by default")
    parser.add_argument("--peers", action="store_true", help="OMPL's planners too")
    parser.add_argument(
        "--homes", default="test", help="test for unseen random ones; or a folder of maps, or a map"
    )
    parser.add_argument("--poses", help="JSON or .npz of named configurations: all ordered pairs")
    parser.add_argument("--poses-key", help="the only name in that file to take")
    count = command.whole(1, 100_000)
    parser.add_argument("--num-homes", type=count, default=5, help="homes or maps at most")
    parser.add_argument("--queries", type=count, default=50, help="of a home")
    parser.add_argument(
        "--nodes",
        type=command.whole(0, 1_000_000),
        default=5000,
        help="of the roadmaps that paths are compared with; 0 for none",
    )
    add_measuring(parser, seed_help="of homes, queries and plans")


def add_measuring(parser: argparse.ArgumentParser, seed_help: str) -> None:
    """Add how often and how long plans are measured, and where rows go."""
    count = command.whole(1, 100_000)
    parser.add_argument("--runs", type=count, default=1, help="of each query")
    workers.add_arguments(parser)
    parser.add_argument(
        "--budget", type=command.real(0.01, 1e6), default=10.0, help="of each search [s]"
    )
    parser.add_argument(
        "--lanes", type=command.whole(1, 4096), default=32, help="expansions at a time"
    )
    parser.add_argument("--seed", type=command.whole(0, 100_000), default=0, help=seed_help)
    parser.add_argument("--json", help="write results here; go on from the rows beside it")


def _run_command(arguments: argparse.Namespace) -> int:
    planners = _planners(arguments.task, arguments.planners, arguments.peers)
    setting = Setting(
        homes=tuple(_homes(arguments)),
        budget_s=arguments.budget,
        **{name: getattr(arguments, name) for name in ("task", "lanes", "nodes", "seed")},
    )
    benchmark = CurveBenchmark(
        setting=setting,
        planners=planners,
        **{name: getattr(arguments, name) for name in ("runs", "jobs", "cluster")},
    )
    file = None if arguments.json is None else Path(arguments.json)
    print(to_text(run(benchmark, file)))
    return command.EXIT_SOLVED


def _planners(task: str, text: str | None, peers: bool) -> tuple[str, ...]:
    """The planners that are asked for, each once.

    Raises:
        ValueError: a name is unknown.
        ModuleNotFoundError: peers are asked for, and OMPL is not installed.
    """
    names = check_names(task, text)
    if peers:
        ompl_version()
    return names + (ompl_peers.PEERS if peers else ())


def _homes(arguments: argparse.Namespace) -> list[curve_homes.QueryHome]:
    """The homes that are asked for, with their queries.

    Raises:
        ValueError: the options do not fit together, or there are no queries.
        FileNotFoundError: there is no such folder or map.
    """
    robot, place = load_robot(arguments.task), Path(arguments.homes)
    amount = {"num": arguments.num_homes, "queries": arguments.queries, "seed": arguments.seed}
    if arguments.poses_key and not arguments.poses:
        raise ValueError("--poses-key names what to take of a file; give it with --poses")
    if arguments.homes == "test":
        if arguments.poses:
            raise ValueError("--poses are of a map; give the map, or its folder, with --homes")
        return curve_homes.unseen(robot, **amount)
    if not place.exists():
        raise FileNotFoundError(
            f"there is no '{place}'; expected test, a folder of maps, or a map with --homes"
        )
    poses = None
    if arguments.poses:
        poses = curve_homes.read_poses(Path(arguments.poses), robot, arguments.poses_key)
    return curve_homes.from_maps(robot, place, poses=poses, **amount)
