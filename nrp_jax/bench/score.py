"""How good are proposed waypoints? Their optimality score on homes that no model has seen.

The score of a waypoint is the length of the expert's shortest path from start to goal over that of
the shortest path through the waypoint (Lu et al. 2024, Table II); 0 if the straight edge to it is
blocked, or no way leads on from it. From the waypoint all edges into the roadmap are tried, of
which the roadmap itself has a share only: what so gets shorter than the optimum scores 1.
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
from scipy import sparse
from scipy.sparse import csgraph

from nrp_jax import samplers
from nrp_jax.homes.grid import Grid, load_map
from nrp_jax.learning.data import VERSION, home_seed, load_dataset
from nrp_jax.learning.expert import Extents, Roadmap, build_roadmap, check_edges, make_rows
from nrp_jax.learning.models import KINDS, TASKS
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world
from vrrt_jax.core.files import replacing
from vrrt_jax.core.timing import machine

ROUND = 256  # edges from a waypoint into the roadmap that are checked before the next are looked at


@dataclasses.dataclass(frozen=True, kw_only=True)
class Queries:
    """Starts and goals among the nodes of a roadmap, and how far the nodes are from the goals."""

    start: np.ndarray  # (n,) indices of nodes
    goal: np.ndarray  # (n,) indices into ``goals``
    goals: np.ndarray  # (G,) indices of nodes
    cost: np.ndarray  # (G, N) lengths of the shortest paths


def make_queries(
    world: GridWorld, robot: MobileRobot, roadmap: Roadmap, num: int, seed: int
) -> Queries:
    """Queries as the data sets have them."""
    rng = np.random.default_rng(seed)
    rows = make_rows(world, robot, roadmap, rng, num, 1)
    node = {q.tobytes(): index for index, q in enumerate(roadmap.q)}
    goals, goal = np.unique([node[q.tobytes()] for q in rows.q_goal], return_inverse=True)
    return Queries(
        start=np.array([node[q.tobytes()] for q in rows.q_start]),
        goal=goal,
        goals=goals,
        cost=csgraph.dijkstra(roadmap.lengths, indices=goals),
    )


def optimality(
    world: GridWorld, robot: MobileRobot, roadmap: Roadmap, queries: Queries, waypoint: np.ndarray
) -> np.ndarray:
    """Scores (n,), 0 to 1, of a waypoint (n, D) for each query."""
    num = len(waypoint)
    q = np.concatenate([roadmap.q, waypoint]).astype(np.float32)
    own = len(roadmap.q) + np.arange(num)
    first, free = check_edges(world, q, np.stack([queries.start, own], axis=1))
    free &= np.asarray(batch_is_free(world, waypoint))  # of edges the ends are not looked at
    best = np.where(free, np.inf, 0.0)  # length on from the waypoint; 0 for what needs no search
    extents = Extents(robot, q)
    waiting = {}
    for k in np.flatnonzero(free):
        near = np.flatnonzero(extents.inside(own[k], slice(len(roadmap.q))))
        total = _lengths(world, q, own[k], near) + queries.cost[queries.goal[k], near]
        order = np.argsort(total)
        waiting[int(k)] = (near[order], total[order])
    while waiting:
        heads = {k: (near[:ROUND], total[:ROUND]) for k, (near, total) in waiting.items()}
        pairs = [np.stack([np.full(len(n), own[k]), n], 1) for k, (n, _) in heads.items()]
        _, ok = check_edges(world, q, np.concatenate(pairs).astype(np.int32))
        ok = np.split(ok, np.cumsum([len(pair) for pair in pairs])[:-1])
        for (k, (near, total)), passed in zip(heads.items(), ok, strict=True):
            if passed.any():
                best[k] = total[np.argmax(passed)]  # they come in order
            rest = tuple(column[ROUND:] for column in waiting[k])
            if passed.any() or len(near) < ROUND or len(rest[0]) == 0:
                del waiting[k]
            else:
                waiting[k] = rest
    optimum = queries.cost[queries.goal, queries.start]
    score = optimum / np.maximum(first + best, 1e-9)
    return np.where(free, np.minimum(score, 1.0), 0.0)


def _lengths(world: GridWorld, q: np.ndarray, own: int, near: np.ndarray) -> np.ndarray:
    """Lengths (m,) of the edges from one configuration to others, in blocks of one size."""
    size = -(-len(near) // 1024) * 1024
    index = np.resize(near, size) if len(near) else np.zeros(0, int)
    parts = [_block(world, q[own], q[part]) for part in index.reshape(-1, 1024)]
    return np.concatenate([np.asarray(part) for part in parts] or [np.zeros(0)])[: len(near)]


@jax.jit
def _block(world: GridWorld, q_from: jax.Array, q_to: jax.Array) -> jax.Array:
    return world.length(world.edge(jnp.broadcast_to(q_from, q_to.shape), q_to))


def propose_all(
    sampler: samplers.Sampler, world: GridWorld, q_from: np.ndarray, q_goal: np.ndarray, seed: int
) -> np.ndarray:
    """Waypoints (n, D), 32 at a time as a planner asks for them."""
    num, lanes = len(q_from), 32
    rows = np.resize(np.arange(num), (-(-num // lanes), lanes))
    key = jax.random.key(seed)
    made = [
        np.asarray(
            samplers.propose(sampler, world, q_from[i], q_goal[i], jax.random.fold_in(key, k))
        )
        for k, i in enumerate(rows)
    ]
    return np.concatenate(made)[:num]


def milliseconds_per_32(sampler: samplers.Sampler, world: GridWorld, q: np.ndarray) -> float:
    """Median time of 32 proposals between configurations (n, D), compiled before [ms]."""
    q_from, q_goal = (jnp.asarray(np.resize(part, (32, q.shape[1]))) for part in (q, q[::-1]))
    times = []
    for k in range(32):
        started = time.perf_counter()
        jax.block_until_ready(samplers.propose(sampler, world, q_from, q_goal, jax.random.key(k)))
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times[2:]))


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
        progress: called with a line for each home.

    Returns:
        For each sampler ``optimality_score`` (mean), ``reachable`` (share of waypoints with a free
        edge from the start and a way on), ``by_home`` (mean scores) and ``ms_per_32``.
    """
    scores: dict[str, list[np.ndarray]] = {name: [] for name in tested}
    times: dict[str, list[float]] = {name: [] for name in tested}
    for grid, seed in zip(grids, seeds, strict=True):
        world = build_world(robot, grid)
        roadmap = _roadmap(world, robot, grid, seed, nodes, cache)
        asked = make_queries(world, robot, roadmap, queries, seed)
        q_from, q_goal = roadmap.q[asked.start], roadmap.q[asked.goals[asked.goal]]
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
    """A home's roadmap, from the cache if it is there."""
    if cache is None:
        return build_roadmap(world, robot, jax.random.key(seed), nodes)
    content = np.packbits(grid.occupied).tobytes() + str(grid.origin).encode()
    which = hashlib.sha256(content).hexdigest()[:12]
    file = cache / f"roadmap_v{VERSION}_{robot.name}_{which}_{seed}_{nodes}.npz"
    if not file.exists():
        roadmap = build_roadmap(world, robot, jax.random.key(seed), nodes)
        cache.mkdir(parents=True, exist_ok=True)
        with replacing(file) as handle:
            graph = {name: getattr(roadmap.lengths, name) for name in ("data", "indices", "indptr")}
            rest = {"colliding": roadmap.colliding, "checked": roadmap.checked}
            np.savez(handle, q=roadmap.q, **graph, **rest)
        return roadmap
    with np.load(file) as saved:
        parts = (saved["data"], saved["indices"], saved["indptr"])
        return Roadmap(
            q=saved["q"],
            lengths=sparse.csr_matrix(parts, shape=(len(saved["q"]),) * 2),
            colliding=saved["colliding"],
            checked=int(saved["checked"]),
        )


def add_arguments(subparsers: Any) -> None:
    """Add the ``score`` command to a command line."""
    parser = subparsers.add_parser("score", help="measure how good proposed waypoints are")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", required=True, choices=TASKS, help="whose samplers")
    parser.add_argument("--data", required=True, help="folder that nrp data wrote: its test homes")
    parser.add_argument("--maps", help="folder of maps from elsewhere")
    parser.add_argument("--discriminator", help="what nrp train wrote; packaged weights by default")
    parser.add_argument("--cvae", help="what nrp train wrote; packaged weights by default")
    parser.add_argument(
        "--unchecked",
        action="store_true",
        help="take the networks' first choice, as the paper does, whether its edge is free or not",
    )
    parser.add_argument("--queries", type=int, default=50, help="of a home")
    parser.add_argument("--nodes", type=int, default=10_000, help="of a home's roadmap")
    parser.add_argument("--json", help="write the figures here")


def _run_command(arguments: argparse.Namespace) -> int:
    for name, value, least in (("queries", arguments.queries, 1), ("nodes", arguments.nodes, 500)):
        if value < least:
            raise ValueError(f"{name} is {value}; expected at least {least}")
    task, robot = arguments.task, load_robot(arguments.task)
    checked = {"checked": 1} if arguments.unchecked else {}
    tested = {
        kind: samplers.load_sampler(task, kind, getattr(arguments, kind), **checked)
        for kind in KINDS
    }
    dataset = load_dataset(arguments.data, "test")
    if dataset.settings.task != task:
        raise ValueError(
            f"the data set is of task '{dataset.settings.task}'; expected '{task}': give another "
            "--data, or the other --task"
        )
    maps = {} if arguments.maps is None else _maps(Path(arguments.maps), robot, tested)
    settings = {
        "queries": arguments.queries,
        "nodes": arguments.nodes,
        "cache": Path(arguments.data) / "roadmaps",
        "progress": lambda line: print(line, file=sys.stderr),
    }
    seeds = [home_seed(dataset.settings, "test", k) for k in range(len(dataset.grids))]
    figures = {
        "task": task,
        "weights": {kind: getattr(arguments, kind) or "packaged" for kind in KINDS},
        "networks": {kind: dataclasses.asdict(s.config) for kind, s in tested.items()},
        "checked": not arguments.unchecked,
        "nodes": arguments.nodes,
        "machine": machine(),
        "unseen_homes": score_homes(robot, dataset.grids, tested, seeds=seeds, **settings),
    }
    if maps:
        found = score_homes(robot, [*maps.values()], tested, seeds=range(len(maps)), **settings)
        figures["maps"] = {**found, "names": [*maps]}
    text = json.dumps(figures, indent=2)
    print(text)
    if arguments.json:
        Path(arguments.json).write_text(text + "\n")
    return 0


def _maps(
    folder: Path, robot: MobileRobot, tested: Mapping[str, samplers.Sampler]
) -> dict[str, Grid]:
    """The maps in a folder that robot and samplers can use, by path, with x and y from 0."""
    kinds = (".npz", ".yaml", ".yml", ".xml")
    grids = {}
    for file in sorted(file for file in folder.rglob("*") if file.suffix in kinds):
        try:
            grid = load_map(file)
            grid = dataclasses.replace(grid, origin=(0.0, 0.0, grid.origin[2]))
            world = build_world(robot, grid)
            for kind, sampler in tested.items():
                samplers.check_fits(sampler, robot, world, kind)
        except ValueError as error:
            print(f"map '{file}' is left out: {error}", file=sys.stderr)
            continue
        grids[file.relative_to(folder).as_posix()] = grid
    if not grids:
        raise ValueError(f"no maps for {robot.name} in '{folder}'; expected {', '.join(kinds)}")
    return grids
