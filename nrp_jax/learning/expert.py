"""The expert: shortest paths on a home's roadmap, and what they teach about waypoints.

A *query* is a start and a goal. The expert knows the shortest path from every node of the roadmap
to the goal. So it can tell for any waypoint near the start how much longer the path through the
waypoint is than the shortest path. Each such answer is one row of *expert data*, from which the
samplers learn. Letters: ``N`` nodes, ``G`` goals, ``D`` joints, ``n`` rows.
"""

import dataclasses

import numpy as np
from scipy.sparse import csgraph

from nrp_jax.learning.edge_check import check_edges
from nrp_jax.learning.roadmap import Extents, Roadmap
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.precision import single_precision

GOOD_RATIO = 1.1  # a waypoint is good if the path through it is at most this times the shortest
STARTS_PER_GOAL = 10
NEAR_GOAL_SHARE = 0.25  # of queries: the start lies inside the goal's window
CRITICAL_SHARE = 0.5  # of starts: drawn among the critical nodes
NUM_CRITICAL = 100  # critical nodes: those that most shortest paths pass, as in the authors' code


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rows:
    """Expert data: what the expert says about n waypoints."""

    q_start: np.ndarray  # (n, D)
    q_goal: np.ndarray  # (n, D)
    waypoint: np.ndarray  # (n, D) in the start's window
    optimal: np.ndarray  # (n, D) the waypoint that the expert would take
    # (n,) length of the path through the waypoint over that of the shortest path; inf where the
    # edge to the waypoint is blocked, or the waypoint collides
    ratio: np.ndarray
    length: np.ndarray  # (n,) of the shortest path [m]
    query: np.ndarray  # (n,) i32, rows of one query follow each other


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShortestPaths:
    """Shortest paths from all nodes of a roadmap to G of them."""

    goals: np.ndarray  # (G,) nodes; each serves ``STARTS_PER_GOAL`` queries, one after the other
    cost: np.ndarray  # (G, N) lengths
    step: np.ndarray  # (G, N) next nodes, negative at the goals
    critical: np.ndarray  # (N,) bool

    def index_of(self, query: int) -> int:
        """Which of the goals a query has."""
        return query // STARTS_PER_GOAL


def shortest_paths(rng: np.random.Generator, roadmap: Roadmap, num_queries: int) -> ShortestPaths:
    """Draw the goals of some queries, and find the shortest paths to them."""
    goals = rng.choice(len(roadmap.q), -(-num_queries // STARTS_PER_GOAL), replace=False)
    cost, step = csgraph.dijkstra(roadmap.lengths, indices=goals, return_predecessors=True)
    critical = np.zeros(len(roadmap.q), bool)
    critical[np.argsort(-betweenness(cost, step))[:NUM_CRITICAL]] = True
    return ShortestPaths(goals=goals, cost=cost, step=step, critical=critical)


@single_precision
def make_rows(
    world: GridWorld,
    robot: MobileRobot,
    roadmap: Roadmap,
    rng: np.random.Generator,
    num_queries: int,
    num_waypoints: int,
) -> Rows:
    """Ask the expert for waypoints.

    The optimal waypoint is the second node of the shortest path from start to goal. The rows of a
    query are the optimal waypoint, other good ones, detours, and places that cannot be reached;
    :func:`_choose_waypoints` chooses them.

    Args:
        world: the robot in a home.
        robot: the robot.
        roadmap: of that home.
        rng: where the choices come from.
        num_queries: starts with a goal each.
        num_waypoints: rows of a query, at most.
    """
    paths = shortest_paths(rng, roadmap, num_queries)
    goals, cost, step, critical = paths.goals, paths.cost, paths.step, paths.critical
    # Waypoints are nodes or, from index N on, samples that collide.
    num_nodes = len(roadmap.q)
    q = np.concatenate([roadmap.q, roadmap.colliding])
    extents = Extents(robot, q)
    rows = []
    for query in range(num_queries):
        g = paths.index_of(query)
        start = choose_start(rng, extents.inside(goals[g], slice(num_nodes)), critical, goals[g])
        window = extents.inside(start, slice(None))
        chosen = _choose_waypoints(
            rng, roadmap, start, cost[g], step[g, start], window, num_waypoints
        )
        rows += [(start, goals[g], g, node, step[g, start], query) for node in chosen]
    start, goal, g, node, optimal, query = np.array(rows, np.int32).T
    # Lengths of the edges from the starts to the waypoints: the roadmap knows some. It has not
    # checked the others, so they are checked now. Blocked ones keep an infinite length.
    length = np.full(len(rows), np.inf)
    free = node < num_nodes
    length[free] = np.asarray(roadmap.lengths[start[free], node[free]]).ravel()
    length[length == 0] = np.inf
    unknown = np.flatnonzero(free & np.isinf(length))
    edge, ok = check_edges(world, q, np.stack([start, node], 1)[unknown])
    length[unknown[ok]] = edge[ok]
    # Through the waypoint: the edge to it, and the shortest path from there.
    shortest = cost[g, start]
    through = length + cost[g, np.where(free, node, 0)]
    return Rows(
        q_start=q[start],
        q_goal=q[goal],
        waypoint=q[node],
        optimal=q[optimal],
        ratio=(through / shortest).astype(np.float32),
        length=shortest.astype(np.float32),
        query=query,
    )


def choose_start(
    rng: np.random.Generator, near_goal: np.ndarray, critical: np.ndarray, goal: int
) -> int:
    """Draw a start: sometimes near the goal, often a critical node.

    Args:
        rng: where the choices come from.
        near_goal: (N,) which nodes are inside the goal's window.
        critical: (N,) which nodes are critical.
        goal: index of the goal.
    """
    wanted = near_goal.copy() if rng.random() < NEAR_GOAL_SHARE else ~near_goal
    wanted[goal] = False
    if rng.random() < CRITICAL_SHARE and (wanted & critical).any():
        wanted &= critical
    if not wanted.any():
        wanted = np.arange(len(critical)) != goal
    return int(rng.choice(np.flatnonzero(wanted)))


def _choose_waypoints(
    rng: np.random.Generator,
    roadmap: Roadmap,
    start: int,
    cost: np.ndarray,
    optimal: int,
    window: np.ndarray,
    num: int,
) -> np.ndarray:
    """Choose the waypoints (num,) of one query: indices of nodes, or N + those of samples.

    The first is the optimal waypoint. Of the others a quarter is nearly as good, a quarter are
    detours, a quarter is free but not joined to the start by an edge, and the rest collides. Where
    a kind is too rare, the other kinds fill up.

    Args:
        rng: where the choices come from.
        roadmap: of the home.
        start: index of the start.
        cost: (N,) lengths of the shortest paths to the goal.
        optimal: index of the optimal waypoint.
        window: (N + m,) which nodes and colliding samples are inside the start's window.
        num: waypoints wanted.
    """
    # Nodes that the roadmap joins to the start, and the ratio of the path through each.
    row = slice(*roadmap.lengths.indptr[start : start + 2])
    joined = roadmap.lengths.indices[row]
    ratio = (roadmap.lengths.data[row] + cost[joined]) / cost[start]
    # The four kinds in random order, each with its quota first.
    inside, num_nodes = np.flatnonzero(window), len(roadmap.q)
    apart = np.setdiff1d(inside[inside < num_nodes], [*joined, start])
    good = joined[(ratio <= GOOD_RATIO) & (joined != optimal)]
    groups = [good, joined[ratio > GOOD_RATIO], apart, inside[inside >= num_nodes]]
    groups = [rng.permutation(group) for group in groups]
    quota = -(-(num - 1) // 4)
    first = np.concatenate([[optimal], *(group[:quota] for group in groups)])
    rest = np.concatenate([group[quota:] for group in groups])
    return np.concatenate([first, rest])[:num]


def betweenness(cost: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Count the shortest paths that pass each node (N,), of those from all nodes to some goals.

    Args:
        cost: (G, N) lengths of the shortest paths to each goal.
        step: (G, N) next node on them, negative at the goals.
    """
    total = np.zeros(cost.shape[1])
    for far_to_near, following in zip(np.argsort(-cost, axis=1), step.tolist(), strict=True):
        # From the far nodes to the goal, each node hands on its own path and those through it.
        passing = [1] * len(following)
        for node in far_to_near.tolist():
            if following[node] >= 0:
                passing[following[node]] += passing[node]
        total += passing
    return total - len(cost)
