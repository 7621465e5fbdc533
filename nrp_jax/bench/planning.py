"""The ``nrp bench plan`` command: how often planners solve long queries in unseen homes."""

import argparse
import dataclasses
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from nrp_jax.config import PlannerConfig
from nrp_jax.homes.houses import CELLS
from nrp_jax.learning.difficulty import EXPANSIONS, MIN_GEODESIC, fair_house, long_queries
from nrp_jax.learning.shards import DatasetSettings, home_seed
from nrp_jax.planner import PlanResult, Status, plan
from nrp_jax.planners.by_name import BY_FLOOR, CONNECT, KINDS, STAR_BY_FLOOR, check_names
from nrp_jax.planners.nrp_connect import UNCHECKED
from nrp_jax.scene.exact import ExactScene
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import GridWorld, build_world
from vrrt_jax.core import command
from vrrt_jax.core.files import write_text
from vrrt_jax.core.interrupt import uninterrupted
from vrrt_jax.core.timing import machine

# Of these some expansions go straight.
WITH_WAYPOINTS = ("nrp-d", "nrp-g", *BY_FLOOR, "nrp-star-d", "nrp-star-g", *STAR_BY_FLOOR)


@dataclasses.dataclass(frozen=True)
class Home:
    """A home with the queries to solve in it."""

    seed: int
    world: GridWorld
    scene: ExactScene
    starts: np.ndarray  # (n, D)
    goals: np.ndarray  # (n, D)
    grid: Any  # planar for a planar robot


def unseen_homes(robot: MobileRobot, homes: int, queries: int, seed: int) -> list[Home]:
    """Generate the test homes of a data set, which no network was trained in, and long queries.

    Args:
        robot: the robot.
        homes: number of homes.
        queries: number of queries of a home.
        seed: of the data set.
    """
    found = []
    for index in range(homes):
        own = home_seed(DatasetSettings(task=robot.name, seed=seed), "test", index)
        house = fair_house(robot, own)
        grid = house.plan() if robot.planar else house.grid
        world = build_world(robot, grid)
        starts, goals = long_queries(robot, world, grid, queries, own)
        found.append(Home(own, world, ExactScene(robot, grid), starts, goals, grid))
    return found


def run(
    robot: MobileRobot,
    homes: Sequence[Home],
    method: str,
    sampler: Any,
    *,
    max_expansions: int,
    lanes: int,
    goal_bias: float,
    straight_rate: float = PlannerConfig.straight_rate,
    on_result: Callable[[PlanResult], Any] = lambda result: None,
) -> dict[str, Any]:
    """Solve all queries by one method; each path is checked with C MuJoCo.

    Args:
        robot: the robot.
        homes: from :func:`unseen_homes`.
        method: one of :data:`nrp_jax.planner.PLANNERS`.
        sampler: for the methods that need one.
        max_expansions: of a plan.
        lanes: expansions at a time.
        goal_bias: share of expansions that aim at the goal.
        straight_rate: share of expansions that go straight, of the planners with waypoints.
        on_result: called with each plan.

    Returns:
        ``n``, ``success`` (share), ``median_search_s``, ``median_expansions`` and ``mean_cost_m``
        (both of the solved queries), ``refused_paths`` (by C MuJoCo, in all plans) and
        ``not_verified`` (number of plans that end with one).

    Raises:
        KeyboardInterrupt: a search was interrupted.
    """
    results = []
    for home in homes:
        for index, (start, goal) in enumerate(zip(home.starts, home.goals, strict=True)):
            with uninterrupted():
                result = plan(
                    robot,
                    home.grid,
                    start,
                    goal,
                    key=jax.random.key(home.seed + index),
                    planner=method,
                    sampler=sampler,
                    world=home.world,
                    scene=home.scene,
                    goal_bias=goal_bias,
                    straight_rate=straight_rate,
                    max_expansions=max_expansions,
                    lanes=lanes,
                )
            results.append(result)
            on_result(result)
    # Costs and expansions count for solved queries alone.
    solved = [result for result in results if result.ok]
    return {
        "n": len(results),
        "success": round(len(solved) / len(results), 4),
        "median_search_s": round(float(np.median([r.timing["search_s"] for r in results])), 4),
        "median_expansions": float(np.median([r.expansions for r in solved])) if solved else None,
        "mean_cost_m": round(float(np.mean([r.cost for r in solved])), 3) if solved else None,
        "refused_paths": sum(r.refused for r in results),
        "not_verified": sum(r.status is Status.NOT_VERIFIED for r in results),
    }


def add_arguments(subparsers: Any) -> None:
    """Add ``plan`` to the bench command."""
    parser = subparsers.add_parser("plan", help="success on unseen homes at some expansions")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", default="snake", choices=tuple(CELLS), help="whose homes")
    parser.add_argument("--methods", help="names for nrp_jax.plan; all of the robot's by default")
    parser.add_argument("--homes", type=command.whole(1, 100_000), default=5, help="unseen ones")
    parser.add_argument("--queries", type=command.whole(1, 100_000), default=10, help="of a home")
    parser.add_argument(
        "--max-expansions", type=command.whole(1, 2**31 - 1), default=EXPANSIONS, help="of a plan"
    )
    parser.add_argument(
        "--lanes", type=command.whole(1, 4096), default=10, help="expansions at a time"
    )
    share = {"type": command.real(0.0, 1.0), "nargs": "+"}
    parser.add_argument(
        "--goal-bias", **share, default=[0.1], help="share that aims there; several to compare"
    )
    parser.add_argument(
        "--straight-rate",
        **share,
        default=[PlannerConfig.straight_rate],
        help="share without waypoints; several too",
    )
    parser.add_argument("--discriminator", help="what nrp train wrote; packaged by default")
    parser.add_argument("--cvae", help="what nrp train wrote; packaged by default")
    parser.add_argument("--global-cvae", help="what nrp train wrote; packaged by default")
    parser.add_argument("--next", help="what nrp train wrote; packaged by default")
    parser.add_argument("--fire", help="what nrp train wrote; packaged by default")
    parser.add_argument(
        "--seed", type=command.whole(0, 100_000), default=0, help="of the homes, as for nrp data"
    )
    parser.add_argument("--json", help="write the figures here")


def _run_command(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from nrp_jax.samplers import load_sampler

    methods = check_names(arguments.task, arguments.methods)
    robot = load_robot(arguments.task)
    samplers = {
        method: load_sampler(
            robot.name,
            KINDS[method],
            getattr(arguments, KINDS[method].replace("-", "_")),
            **(UNCHECKED if method in CONNECT else {}),
        )
        for method in methods
        if method in KINDS
    }
    homes = unseen_homes(robot, arguments.homes, arguments.queries, arguments.seed)
    budget: dict[str, Any] = {n: getattr(arguments, n) for n in ("max_expansions", "lanes")}
    shares = {name: getattr(arguments, name) for name in ("goal_bias", "straight_rate")}
    figures = {}
    for method in methods:
        rows = _settings(method, shares)
        for row in rows:
            several = [name for name in row if len({own[name] for own in rows}) > 1]
            named = "".join(f" {name}={row[name]:g}" for name in several)
            with tqdm(total=len(homes) * arguments.queries, desc=method, unit="plan") as bar:
                figures[method + named] = run(
                    robot,
                    homes,
                    method,
                    samplers.get(method),
                    **budget,
                    **row,
                    on_result=lambda _, bar=bar: bar.update(),
                )
            print(f"{method}{named}: {json.dumps(figures[method + named])}", flush=True)
    report = {
        "task": robot.name,
        "seed": arguments.seed,
        "homes": [home.seed for home in homes],
        "min_geodesic_m": MIN_GEODESIC,
        **budget,
        **{name: values if len(values) > 1 else values[0] for name, values in shares.items()},
        "methods": figures,
        "machine": machine(),
    }
    if arguments.json:
        write_text(Path(arguments.json), json.dumps(report, indent=1) + "\n")
    return 0


def _settings(method: str, shares: Mapping[str, list[float]]) -> list[dict[str, Any]]:
    """All combinations of the shares that matter to a method, the first of those that do not."""
    matters = {
        "goal_bias": method not in ("rrt-connect", "bit-star", *CONNECT),
        "straight_rate": method in WITH_WAYPOINTS,
    }
    lists = [values if matters[name] else values[:1] for name, values in shares.items()]
    return [dict(zip(shares, row, strict=True)) for row in itertools.product(*lists)]
