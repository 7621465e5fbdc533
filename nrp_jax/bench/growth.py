"""The ``nrp bench growth`` command: how much of a home a tree sees, and how near the goal it comes.

As Table I of Lu et al. 2024: what a unit of *visibility* and of *distance to the goal* take of
expansions and of time. Visibility is the number of configurations, out of a dense set, to which a
straight free edge leads from near nodes of the tree. Distance is that of the shortest path that the
dense roadmap has from the tree to the goal. Letters: ``N`` nodes of the roadmap, ``M`` nodes of a
tree, ``D`` joints.
"""

import argparse
import functools
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csgraph

from nrp_jax.bench import paper
from nrp_jax.homes.houses import CELLS, generate_house
from nrp_jax.learning.difficulty import EXPANSIONS, GOAL_BIAS, MIN_GEODESIC
from nrp_jax.learning.edge_check import check_edges, pad_rows
from nrp_jax.learning.roadmap import Roadmap, build_roadmap
from nrp_jax.learning.shards import DatasetSettings, home_seed
from nrp_jax.planner import plan
from nrp_jax.planners.by_name import BY_FLOOR, KINDS, check_names
from nrp_jax.samplers import load_sampler
from nrp_jax.scene.exact import ExactScene
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import GridWorld, build_world
from vrrt_jax.core import command
from vrrt_jax.core.files import write_text
from vrrt_jax.core.interrupt import uninterrupted
from vrrt_jax.core.markdown import table
from vrrt_jax.core.timing import machine

# Planners whose tree begins at the start, and which end with their first path.
ONE_TREE = ("rrt", "rrt-is", "cvae-rrt", "fire", "nrp-d", "nrp-g", *BY_FLOOR)
SUMS = ("plans", "solved", "expansions", "search_s", "visibility", "approach_m")
RATES: tuple[str, ...] = (
    "ms_per_visibility",
    "ms_per_m",
    "expansions_per_visibility",
    "expansions_per_m",
)
_NEAREST = 32  # nodes of a tree that a configuration is tried from
_BLOCK = 64  # configurations whose distances are computed at a time


def reach(
    world: GridWorld, roadmap: Roadmap, to_goal: np.ndarray, q_tree: np.ndarray
) -> tuple[int, float]:
    """Visibility of a tree, and its distance to the goal [m].

    Args:
        world: the robot in a home.
        roadmap: of that home, N nodes.
        to_goal: (N,) lengths of the shortest paths from its nodes to the goal.
        q_tree: (M, D) nodes of the tree.

    Returns:
        How many nodes of the roadmap a straight free edge leads to, from one of the nodes of the
        tree that are nearest to them, and the length of the shortest way to the goal that begins
        with such an edge, inf if there is none.
    """
    num = len(roadmap.q)
    q = np.concatenate([roadmap.q, q_tree]).astype(np.float32)
    near = np.asarray(_nearest(world, q[num:], q[:num]))
    pairs = np.stack([np.repeat(np.arange(num), near.shape[1]), num + near.ravel()], axis=1)
    length, free = check_edges(world, q, pairs.astype(np.int32))
    shortest = np.where(free, length, np.inf).reshape(near.shape).min(axis=1)
    return int(np.isfinite(shortest).sum()), float(np.min(shortest + to_goal))


def _nearest(world: GridWorld, nodes: np.ndarray, q: np.ndarray) -> jax.Array:
    """The nodes (n, K) of a tree (M, D) that are nearest to configurations (n, D)."""
    room = jnp.asarray(pad_rows(nodes, 1 << (len(nodes) - 1).bit_length()))  # few shapes to compile
    return _nearest_in(world, room, q, len(nodes), min(_NEAREST, len(nodes)))


@functools.partial(jax.jit, static_argnums=4)
def _nearest_in(world: GridWorld, nodes: jax.Array, q: jax.Array, size: int, num: int) -> jax.Array:
    among = jnp.arange(len(nodes)) < size

    def of_block(block: jax.Array) -> jax.Array:
        return jax.lax.top_k(-world.distances(nodes, block, among), num)[1]

    blocks = jnp.resize(q, (-(-len(q) // _BLOCK), _BLOCK, q.shape[1]))
    return jax.lax.map(of_block, blocks).reshape(-1, num)[: len(q)]


def queries_of(
    roadmap: Roadmap, num: int, seed: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Starts (D,), goals (D,) and the lengths (N,) from all nodes of a roadmap to each goal.

    Both are nodes of the roadmap. The path between them has 5 m at least, or as much as there is.
    """
    rng, found = np.random.default_rng(seed), []
    for goal in rng.integers(0, len(roadmap.q), num):
        to_goal = csgraph.dijkstra(roadmap.lengths, indices=goal)
        far = np.flatnonzero(to_goal >= MIN_GEODESIC)
        start = rng.choice(far) if len(far) else int(np.argmax(to_goal))
        found.append((roadmap.q[start], roadmap.q[goal], to_goal))
    return found


def run(
    robot: MobileRobot,
    methods: Sequence[str],
    *,
    homes: int,
    queries: int,
    nodes: int,
    seed: int,
    progress: Any = None,
    **budget: Any,
) -> dict[str, dict[str, Any]]:
    """Let planners grow trees in unseen homes, and measure what came of them.

    Args:
        robot: the robot.
        methods: names for :func:`nrp_jax.plan`, of planners with one tree.
        homes: number of homes, which no network was trained in.
        queries: of a home.
        nodes: of its roadmap.
        seed: of homes, queries and plans.
        progress: called with a line of text for each home.
        budget: ``max_expansions``, ``lanes`` and ``goal_bias`` of a plan.

    Returns:
        For each planner ``plans``, ``solved``, the sums ``expansions``, ``search_s``,
        ``visibility`` (configurations) and ``approach_m``, and the :data:`RATES`, None where there
        was no gain.
    """
    samplers = {m: load_sampler(robot.name, KINDS[m]) for m in methods if m in KINDS}
    sums = {method: np.zeros(len(SUMS)) for method in methods}
    for index in range(homes):
        own = home_seed(DatasetSettings(task=robot.name, seed=seed), "test", index)
        house = generate_house(own, robot.name)
        grid = house.plan() if robot.planar else house.grid
        world, scene = build_world(robot, grid), ExactScene(robot, grid)
        roadmap = build_roadmap(world, robot, jax.random.key(own), nodes)
        for number, (start, goal, to_goal) in enumerate(queries_of(roadmap, queries, own)):
            seen, apart = reach(world, roadmap, to_goal, start[None])
            for method in methods:
                with uninterrupted():
                    result = plan(
                        robot,
                        grid,
                        start,
                        goal,
                        key=jax.random.key(own + number),
                        planner=method,
                        sampler=samplers.get(method),
                        world=world,
                        scene=scene,
                        **budget,
                    )
                nodes_q = np.asarray(result.tree.q)[: int(result.tree.size)]
                seen_now, apart_now = reach(world, roadmap, to_goal, nodes_q)
                work = result.expansions, result.timing["search_s"]
                sums[method] += (1, result.ok, *work, seen_now - seen, apart - apart_now)
        if progress is not None:
            progress(f"home {own}: {len(roadmap.q)} configurations, {queries} queries")
    return {method: _figures(found) for method, found in sums.items()}


def _figures(found: np.ndarray) -> dict[str, Any]:
    """The sums of a planner by name, and what a unit of each gain took."""
    sums = dict(zip(SUMS, found.tolist(), strict=True))
    seen, nearer = (sums[name] or np.nan for name in SUMS[-2:])
    rates = {
        "ms_per_visibility": 1e3 * sums["search_s"] / seen,
        "ms_per_m": 1e3 * sums["search_s"] / nearer,
        "expansions_per_visibility": sums["expansions"] / seen,
        "expansions_per_m": sums["expansions"] / nearer,
    }
    return {n: None if np.isnan(v) else float(f"{v:.4g}") for n, v in (sums | rates).items()}


def to_text(figures: Mapping[str, Mapping[str, Any]], task: str) -> str:
    """A table of the rates, each with its ratio to the first planner's, and the paper's."""
    first = next(iter(figures.values()))

    def cells(own: Mapping[str, Any]) -> list[str]:
        return [
            "-" if None in (own[n], first[n]) else f"{own[n]:g} ({own[n] / first[n]:.2f})"
            for n in RATES
        ]

    rows = [[n, f"{own['solved']:g}/{own['plans']:g}", *cells(own)] for n, own in figures.items()]
    if task == "snake":
        of_paper = {name: dict(zip(RATES, row, strict=True)) for name, row in paper.GROWTH.items()}
        first = of_paper["rrt"]
        rows += [[f"paper: {name}", "", *cells(own)] for name, own in of_paper.items()]
    return table(["planner", "solved", *(name.replace("_", " ") for name in RATES)], rows)


def add_arguments(subparsers: Any) -> None:
    """Add ``growth`` to the bench command."""
    parser = subparsers.add_parser(
        "growth", help="expansions and time that a tree takes to see a home and near the goal"
    )
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", default="snake", choices=tuple(CELLS), help="whose homes")
    parser.add_argument("--methods", default="rrt,nrp-d,nrp-g", help="planners with one tree")
    parser.add_argument("--homes", type=command.whole(1, 100_000), default=5, help="unseen ones")
    parser.add_argument("--queries", type=command.whole(1, 100_000), default=10, help="of a home")
    parser.add_argument(
        "--nodes", type=command.whole(100, 100_000), default=2000, help="configurations to see"
    )
    parser.add_argument(
        "--max-expansions", type=command.whole(1, 1_000_000), default=EXPANSIONS, help="of a plan"
    )
    parser.add_argument(
        "--lanes", type=command.whole(1, 4096), default=1, help="expansions at a time"
    )
    parser.add_argument(
        "--goal-bias", type=command.real(0.0, 1.0), default=GOAL_BIAS, help="share that aims there"
    )
    parser.add_argument("--seed", type=command.whole(0, 100_000), default=0, help="of homes")
    parser.add_argument("--json", help="write the figures here")


def _run_command(arguments: argparse.Namespace) -> int:
    methods = check_names(arguments.task, arguments.methods)
    if two := [name for name in methods if name not in ONE_TREE]:
        raise ValueError(f"planner '{two[0]}' has not one tree; have: {', '.join(ONE_TREE)}")
    names = ("homes", "queries", "nodes", "seed", "max_expansions", "lanes", "goal_bias")
    settings = {name: getattr(arguments, name) for name in names}

    def tell(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    figures = run(load_robot(arguments.task), methods, progress=tell, **settings)
    print(to_text(figures, arguments.task))
    report = {"task": arguments.task, **settings, "methods": figures, "machine": machine()}
    if arguments.json:
        write_text(Path(arguments.json), json.dumps(report, indent=1) + "\n")
    return 0
