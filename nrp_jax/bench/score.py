"""The ``nrp score`` command: optimality scores of samplers on homes that no network has seen.

:mod:`nrp_jax.learning.optimality` says what the score is.
"""

import argparse
import dataclasses
import hashlib
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax import samplers
from nrp_jax.bench.maps import load_maps
from nrp_jax.homes.grid import Grid
from nrp_jax.learning.data import load_dataset
from nrp_jax.learning.models import TASKS, WAYPOINT_KINDS
from nrp_jax.learning.optimality import make_queries, optimality
from nrp_jax.learning.roadmap import Roadmap, build_roadmap, load_roadmap
from nrp_jax.learning.shards import VERSION, home_seed
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import GridWorld, build_world
from vrrt_jax.core import command
from vrrt_jax.core.files import write_text
from vrrt_jax.core.timing import machine

LANES = 32  # waypoints proposed at a time, as a planner asks for them
_REPEATS = 32  # of a timing


def propose_all(
    sampler: samplers.Sampler, world: GridWorld, q_from: np.ndarray, q_goal: np.ndarray, seed: int
) -> np.ndarray:
    """Waypoints (n, D) from starts to goals (n, D), in batches as a planner asks for them."""
    num = len(q_from)
    # The last batch is filled up with the first queries, so that all have one shape.
    rows = np.resize(np.arange(num), (-(-num // LANES), LANES))
    key = jax.random.key(seed)
    made = [
        np.asarray(
            samplers.propose(sampler, world, q_from[i], q_goal[i], jax.random.fold_in(key, k))
        )
        for k, i in enumerate(rows)
    ]
    return np.concatenate(made)[:num]


def milliseconds_per_32(sampler: samplers.Sampler, world: GridWorld, q: np.ndarray) -> float:
    """Median time of 32 proposals between configurations (n, D), without compilation [ms]."""
    q_from, q_goal = (jnp.asarray(np.resize(part, (LANES, q.shape[1]))) for part in (q, q[::-1]))
    times = []
    for k in range(_REPEATS):
        started = time.perf_counter()
        jax.block_until_ready(samplers.propose(sampler, world, q_from, q_goal, jax.random.key(k)))
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times[2:]))  # the first calls compile


def score_homes(
    robot: MobileRobot,
    grids: Sequence[Grid],
    tested: Mapping[str, samplers.Sampler],
    *,
    seeds: Sequence[int],
    queries: int,
    nodes: int,
    cache: Path | None = None,
    progress: Any = None,
) -> dict[str, dict[str, Any]]:
    """Score samplers on some homes.

    Args:
        robot: the robot.
        grids: the homes.
        tested: samplers by name.
        seeds: of each home's roadmap and queries.
        queries: of each home.
        nodes: of each roadmap.
        cache: folder where roadmaps are kept between runs.
        progress: called with a line of text for each home.

    Returns:
        For each sampler ``optimality_score`` (mean of all queries), ``reachable`` (share of
        waypoints with a score above 0), ``by_home`` (mean scores), ``ms_per_32`` (time of 32
        proposals [ms]) and ``queries`` (their number).
    """
    scores: dict[str, list[np.ndarray]] = {name: [] for name in tested}
    times: dict[str, list[float]] = {name: [] for name in tested}
    for grid, seed in zip(grids, seeds, strict=True):
        world = build_world(robot, grid)
        roadmap = _roadmap(world, robot, grid, seed, nodes, cache)
        asked = make_queries(world, robot, roadmap, queries, seed)
        q_from, q_goal = roadmap.q[asked.start], roadmap.q[asked.goals[asked.goal]]
        # All samplers get the same queries.
        for name, sampler in tested.items():
            waypoint = propose_all(sampler, world, q_from, q_goal, seed)
            scores[name].append(optimality(world, robot, roadmap, asked, waypoint))
            times[name].append(milliseconds_per_32(sampler, world, q_from))
        if progress is not None:
            means = ", ".join(f"{name} {s[-1].mean():.3f}" for name, s in scores.items())
            progress(f"home {seed}: {means}")
    return {
        name: {
            "optimality_score": round(float(np.concatenate(scores[name]).mean()), 4),
            "reachable": round(float((np.concatenate(scores[name]) > 0).mean()), 4),
            "by_home": [round(float(part.mean()), 4) for part in scores[name]],
            "ms_per_32": round(float(np.median(times[name])), 2),
            "queries": sum(map(len, scores[name])),
        }
        for name in tested
    }


def _roadmap(
    world: GridWorld, robot: MobileRobot, grid: Grid, seed: int, nodes: int, cache: Path | None
) -> Roadmap:
    """A home's roadmap, from the cache if it is there; its file is named by what it was made of."""
    if cache is None:
        return build_roadmap(world, robot, jax.random.key(seed), nodes)
    content = np.packbits(grid.occupied).tobytes() + str(grid.origin).encode()
    which = hashlib.sha256(content).hexdigest()[:12]
    file = cache / f"roadmap_v{VERSION}_{robot.name}_{which}_{seed}_{nodes}.npz"
    if file.exists():
        return load_roadmap(file)
    roadmap = build_roadmap(world, robot, jax.random.key(seed), nodes)
    cache.mkdir(parents=True, exist_ok=True)
    roadmap.save(file)
    return roadmap


def add_arguments(subparsers: Any) -> None:
    """Add the ``score`` command to a command line."""
    parser = subparsers.add_parser("score", help="measure how good proposed waypoints are")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", required=True, choices=TASKS, help="whose samplers")
    parser.add_argument("--data", required=True, help="folder that nrp data wrote")
    parser.add_argument(
        "--split", default="test", choices=("test", "train"), help="which of its homes"
    )
    parser.add_argument(
        "--num-homes", type=command.whole(1, 100_000), help="the first ones; all if not given"
    )
    parser.add_argument("--maps", help="folder of maps from elsewhere")
    parser.add_argument("--discriminator", help="what nrp train wrote; packaged weights by default")
    parser.add_argument("--cvae", help="what nrp train wrote; packaged weights by default")
    parser.add_argument(
        "--unchecked",
        action="store_true",
        help="take the networks' first choice, as the paper does, whether its edge is free or not",
    )
    parser.add_argument("--queries", type=command.whole(1, 1_000_000), default=50, help="of a home")
    parser.add_argument(
        "--nodes", type=command.whole(500, 1_000_000), default=10_000, help="of a home's roadmap"
    )
    parser.add_argument("--json", help="write the figures here")


def _run_command(arguments: argparse.Namespace) -> int:
    for name, value, least in (("queries", arguments.queries, 1), ("nodes", arguments.nodes, 500)):
        if value < least:
            raise ValueError(f"{name} is {value}; expected at least {least}")
    task, robot = arguments.task, load_robot(arguments.task)
    checked = {"num_edge_checked": 1} if arguments.unchecked else {}
    tested = {
        kind: samplers.load_sampler(task, kind, getattr(arguments, kind), **checked)
        for kind in WAYPOINT_KINDS
    }
    dataset = load_dataset(arguments.data, arguments.split)
    if dataset.settings.task != task:
        raise ValueError(
            f"the data set is of task '{dataset.settings.task}'; expected '{task}': give another "
            "--data, or the other --task"
        )
    maps = {} if arguments.maps is None else _load_maps(Path(arguments.maps), robot, tested)
    settings = {
        "queries": arguments.queries,
        "nodes": arguments.nodes,
        "cache": Path(arguments.data) / "roadmaps",
        "progress": lambda line: print(line, file=sys.stderr),
    }
    grids = dataset.grids[: arguments.num_homes]
    seeds = [home_seed(dataset.settings, arguments.split, k) for k in range(len(grids))]
    figures = {
        "task": task,
        "weights": {kind: getattr(arguments, kind) or "packaged" for kind in WAYPOINT_KINDS},
        "networks": {kind: dataclasses.asdict(s.config) for kind, s in tested.items()},
        "checked": not arguments.unchecked,
        "nodes": arguments.nodes,
        "machine": machine(),
    }
    own = [path for kind in WAYPOINT_KINDS if (path := getattr(arguments, kind))]
    with samplers.weights_of(*own):
        homes = "unseen_homes" if arguments.split == "test" else "training_homes"
        figures[homes] = score_homes(robot, grids, tested, seeds=seeds, **settings)
        if maps:
            found = score_homes(robot, [*maps.values()], tested, seeds=range(len(maps)), **settings)
            figures["maps"] = {**found, "names": [*maps]}
    text = json.dumps(figures, indent=2)
    print(text)
    if arguments.json:
        write_text(Path(arguments.json), text + "\n")
    return 0


def _load_maps(
    folder: Path, robot: MobileRobot, tested: Mapping[str, samplers.Sampler]
) -> dict[str, Grid]:
    """Load the maps in a folder that fit the robot and the samplers, by path.

    Their x and y begin at 0 then. Maps that do not fit are named on the standard error.

    Raises:
        ValueError: no map fits.
    """

    def fit(grid: Grid) -> Grid:
        grid = dataclasses.replace(grid, origin=(0.0, 0.0, grid.origin[2]))
        world = build_world(robot, grid)
        for kind, sampler in tested.items():
            samplers.check_fits(sampler, robot, world, kind)
        return grid

    return load_maps(folder, robot.name, fit)
