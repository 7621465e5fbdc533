"""The ``nrp bench execution`` command: how long a Fetch takes along the paths of planners.

The protocol of the paper's table III: legs from one named pose of a home to the next, each planned
within a budget (Lu et al. 2024, section VII). Rows are those of ``nrp bench curves``, written as
they come, so that a run that was stopped goes on.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nrp_jax.bench import curve_homes
from nrp_jax.bench.curve_rows import Setting
from nrp_jax.bench.curves import CurveBenchmark, add_measuring, measure
from nrp_jax.planners.by_name import DECOMPOSED, check_names
from nrp_jax.scene.robots import load_robot
from vrrt_jax.core import command
from vrrt_jax.core.markdown import table
from vrrt_jax.core.results_file import write

DEFAULT = ("nrp-star-connect", "nrp-star-d", DECOMPOSED)
TIMES = ("quickened_s", "execution_s", "stopping_s")  # of rows
NOTE = (
    "seconds from rest to rest: the base up to 1 m/s and 1.5 rad/s with 0.35 m/s^2 and 0.8 "
    "rad/s^2, torso and arm as their maker sets them; corners are rounded by 0.01 at most; first "
    "the quickened path, then the path as planned, in brackets with stops at all corners instead"
)


def times(
    rows: Sequence[Mapping[str, Any]], planners: Sequence[str], legs: Sequence[str], name: str
) -> np.ndarray:
    """Mean execution times (legs, planners) over runs [s]; NaN where no run is solved.

    Args:
        rows: of the plans.
        planners: columns.
        legs: their labels.
        name: ``quickened_s``, ``execution_s`` or ``stopping_s``.
    """
    found = np.full((len(legs), len(planners)), np.nan)
    for leg in range(len(legs)):
        for column, planner in enumerate(planners):
            own = [
                row[name]
                for row in rows
                if (row["planner"], row["query"]) == (planner, leg) and row["solved"]
            ]
            if own:
                found[leg, column] = np.mean(own)
    return found


def ratios(found: np.ndarray, planners: Sequence[str]) -> dict[str, float | None]:
    """Of each planner but the last one: its time over the last one's, of legs that both have.

    Args:
        found: (legs, planners) from :func:`times`.
        planners: columns; the last one is what the others are compared with.
    """
    last, told = found[:, -1], {}
    for column, planner in enumerate(planners[:-1]):
        both = np.isfinite(found[:, column]) & np.isfinite(last)
        share = found[both, column].sum() / last[both].sum() if both.any() else None
        told[f"{planner} / {planners[-1]}"] = None if share is None else round(float(share), 3)
    return told


def add_arguments(subparsers: Any) -> None:
    """Add ``execution`` to the bench command."""
    parser = subparsers.add_parser("execution", help="how long a Fetch takes along its paths")
    parser.set_defaults(run=_run_command)
    parser.add_argument(
        "--homes", required=True, help="a map, or a folder whose first one is taken"
    )
    parser.add_argument(
        "--poses", required=True, help="JSON or .npz of named configurations: from each to the next"
    )
    parser.add_argument("--poses-key", help="the only name in that file to take")
    parser.add_argument(
        "--planners",
        default=",".join(DEFAULT),
        help="names for nrp_jax.plan; ratios are to the last one",
    )
    add_measuring(parser, seed_help="of the plans")


def _run_command(arguments: argparse.Namespace) -> int:
    robot, place = load_robot("fetch"), Path(arguments.homes)
    planners = check_names(robot.name, arguments.planners)
    if not place.exists():
        raise FileNotFoundError(f"there is no '{place}'; expected a map, or a folder, with --homes")
    poses = curve_homes.read_poses(Path(arguments.poses), robot, arguments.poses_key)
    (home,) = curve_homes.from_maps(
        robot, place, num=1, queries=len(poses), seed=arguments.seed, poses=poses, legs=True
    )
    setting = Setting(
        task=robot.name,
        homes=(home,),
        budget_s=arguments.budget,
        nodes=0,
        lanes=arguments.lanes,
        seed=arguments.seed,
        quickened=True,
    )
    benchmark = CurveBenchmark(
        setting=setting,
        planners=planners,
        **{name: getattr(arguments, name) for name in ("runs", "jobs", "cluster")},
    )
    file = None if arguments.json is None else Path(arguments.json)
    header, rows = measure(benchmark, file)
    found = {name: times(rows, planners, home.labels, name) for name in TIMES}
    told = {name: ratios(found[name], planners) for name in TIMES[:2]}
    if file is not None:
        write(
            file,
            {
                **header,
                "runs": benchmark.runs,
                "legs": home.labels,
                "poses": home.notes,
                "planners": planners,
                **{name: _plain(seconds) for name, seconds in found.items()},
                "ratios": told,
                "note": NOTE,
            },
        )
    print(_text(home.labels, planners, list(found.values())))
    for what, shares in zip(("quickened", "as planned"), told.values(), strict=True):
        for name, share in shares.items():
            ratio = "no leg is solved by both" if share is None else f"{share:.2f}"
            print(f"{name}, {what}: {ratio}")
    print(NOTE)
    return command.EXIT_SOLVED


def _text(legs: Sequence[str], planners: Sequence[str], found: Sequence[np.ndarray]) -> str:
    """A table of the times; the last line adds up the legs that all have."""
    lines = [
        [leg, *map(_cell, *each)]
        for leg, *each in zip(legs, *(seconds.tolist() for seconds in found), strict=True)
    ]
    all_have = np.isfinite(found[0]).all(axis=1)
    sums = (seconds[all_have].sum(axis=0).tolist() for seconds in found)
    lines.append([f"{all_have.sum()} legs that all have", *map(_cell, *sums)])
    return table(["execution [s]", *planners], lines)


def _cell(quick: float, rounded: float, stopping: float) -> str:
    return f"{quick:.1f}; {rounded:.1f} ({stopping:.1f})" if np.isfinite(quick) else "not solved"


def _plain(found: np.ndarray) -> list[list[float | None]]:
    """Numbers for JSON, which knows no NaN."""
    return [[round(v, 3) if np.isfinite(v) else None for v in row] for row in found.tolist()]
