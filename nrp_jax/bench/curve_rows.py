"""One query by one planner, as a row of results; and the roadmap that paths are compared with."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from nrp_jax.bench import ompl_peers
from nrp_jax.bench.curve_homes import QueryHome
from nrp_jax.learning.edge_check import check_edges
from nrp_jax.learning.roadmap import Extents, build_roadmap
from nrp_jax.planner import PlanResult, plan
from nrp_jax.scene.car_world import CarWorld
from nrp_jax.scene.exact import ExactScene
from nrp_jax.scene.execution_time import execution_time, time_along
from nrp_jax.scene.nearest import shifted, working_world
from nrp_jax.scene.odometry import odometry
from nrp_jax.scene.quicken import quicken
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import GridWorld, build_world
from vrrt_jax.core.interrupt import uninterrupted

ROADMAP = "roadmap"  # the name of what is no planner: the costs that paths are compared with
ENDLESS = 2**31 - 1  # expansions of a plan that only time ends


@dataclasses.dataclass(frozen=True, kw_only=True)
class Item:
    """What a worker does at a time."""

    planner: str  # or ROADMAP
    home: int
    query: int = 0
    run: int = 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """What all rows of a benchmark share."""

    task: str
    homes: tuple[QueryHome, ...]
    budget_s: float
    lanes: int
    nodes: int  # of a roadmap
    seed: int
    quickened: bool = False  # whether a Fetch's paths are made quicker, to be timed once more


def run_item(setting: Setting, item: Item) -> dict[str, Any]:
    """Do one thing; a row of the results.

    Returns:
        ``planner``, ``home`` (its name), ``query`` and ``run``. Of a roadmap the ``reference``:
        costs (n) of the shortest paths that it has, None where there is none. Of a planner:

        * ``solved`` (the path of the end is free by the exact check), ``status`` and ``cost`` of
          the path after it was shortened, None unless solved;
        * ``search_s``, ``expansions`` and ``checks`` that the whole search took, and
          ``refused``, the paths that the exact check refused;
        * ``steps``: a row ``[seconds, expansions, checks, cost]`` for each time that the best path
          of the search became shorter, the first path included;
        * of a Fetch's solved query ``execution_s``, see :func:`execution_time`, and ``stopping_s``,
          the same with stops at all corners;
        * if asked for, ``quickened_s`` and ``base_s`` of the path that :func:`quicken` makes of it,
          and ``planned_base_s``: what the base would take alone.
    """
    home = setting.homes[item.home]
    robot, scene, world = _built(setting.task, home)
    row = {**dataclasses.asdict(item), "home": home.name}
    if item.planner == ROADMAP:
        return row | {"reference": roadmap_costs(robot, world, home, setting.nodes, setting.seed)}
    start, goal = home.starts[item.query], home.goals[item.query]
    key = jax.random.key(setting.seed)
    for number in (item.home, item.query, item.run):
        key = jax.random.fold_in(key, number)
    with uninterrupted():
        if item.planner in ompl_peers.PEERS:
            return row | ompl_peers.solve(
                robot,
                world,
                scene,
                start,
                goal,
                name=item.planner,
                budget_s=setting.budget_s,
                key=key,
            )
        result = plan(
            robot,
            home.grid,
            start,
            goal,
            key=key,
            planner=item.planner,
            world=world,
            scene=scene,
            lanes=setting.lanes,
            max_expansions=ENDLESS,
            time_limit_s=setting.budget_s,
        )
    row |= row_of(result)
    if isinstance(world, CarWorld) and result.ok:
        row["execution_s"] = round(execution_time(world, result.path), 3)
        row["stopping_s"] = round(execution_time(world, result.path, tolerance=0.0), 3)
        if setting.quickened:
            quick = quicken(robot, home.grid, result.path, key=key, world=world, scene=scene)
            row["quickened_s"] = round(quick.duration_s, 3)
            for name, corners in (
                ("planned_base_s", odometry(world, result.path)),
                ("base_s", quick.corners),
            ):
                row[name] = round(time_along(corners * (np.arange(corners.shape[1]) < 2)), 3)
    return row


def row_of(result: PlanResult) -> dict[str, Any]:
    """What :func:`run_item` tells of a plan."""
    history = np.asarray(result.history, float)
    iterations, seconds, cost, checks = history[:, [0, 1, 4, 5]].T
    # Searches before the last one, whose paths were refused, have taken time too.
    lanes = result.expansions / max(iterations[-1], 1)
    before_s = max(result.timing["search_s"] - seconds[-1], 0.0)
    shorter = cost < np.minimum.accumulate(np.append(np.inf, cost))[:-1]
    steps = np.stack([seconds + before_s, iterations * lanes, checks, cost], axis=1)[shorter]
    return {
        "solved": result.ok,
        "status": result.status.name,
        "cost": round(result.cost, 4) if result.ok else None,
        "search_s": round(result.timing["search_s"], 4),
        "expansions": result.expansions,
        "checks": int(checks[-1]),
        "refused": result.refused,
        "steps": np.round(steps, 4).tolist(),
    }


def roadmap_costs(
    robot: MobileRobot, world: GridWorld, home: QueryHome, nodes: int, seed: int
) -> list[float | None]:
    """Costs (n) of the shortest paths through a dense roadmap, None where there is none.

    Starts and goals are joined to all nodes in their windows from which the edge is free.
    """
    world, corner = working_world(world)
    roadmap = build_roadmap(world, robot, jax.random.key(seed), nodes)
    num, ends = len(roadmap.q), np.concatenate([home.starts, home.goals])
    q = np.concatenate([roadmap.q, shifted(ends, -corner)]).astype(np.float32)
    # The edges from each end: to the nodes in its window, and to the other end of its query.
    extents, own = Extents(robot, q), num + np.arange(len(ends))
    pairs = [np.stack(np.split(own, 2), axis=1)]
    for end in own:
        near = np.flatnonzero(extents.inside(int(end), slice(num)))
        pairs.append(np.stack([np.full(len(near), end), near], axis=1))
    pairs = np.concatenate(pairs).astype(np.int32)
    length, free = check_edges(world, q, pairs)
    # The roadmap's graph with these edges too.
    a, b = pairs[free].T
    known = roadmap.lengths.tocoo()
    graph = sparse.coo_matrix(
        (
            np.concatenate([known.data, length[free]]),
            (np.concatenate([known.row, a]), np.concatenate([known.col, b])),
        ),
        shape=(len(q), len(q)),
    )
    starts, goals = np.split(own, 2)
    cost = csgraph.dijkstra(graph.tocsr(), directed=False, indices=starts)
    cost = cost[np.arange(len(starts)), goals]
    return [round(float(c), 4) if np.isfinite(c) else None for c in cost]


@functools.lru_cache(maxsize=2)
def _built(task: str, home: QueryHome) -> tuple[MobileRobot, ExactScene, GridWorld]:
    """Robot, exact scene and world of a home; a process keeps those that it used last."""
    _drop_programs_of_other_maps(home.grid.occupied.shape)
    robot = load_robot(task)
    return robot, ExactScene(robot, home.grid), build_world(robot, home.grid)


@functools.lru_cache(maxsize=1)
def _drop_programs_of_other_maps(shape: tuple[int, ...]) -> None:
    """Free what is compiled for maps of other sizes, once for a size.

    A size takes hundreds of megabytes, and homes come one after the other. What is needed again is
    in the cache on disk.
    """
    jax.clear_caches()
