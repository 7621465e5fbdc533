"""The optimality score: how good is a proposed waypoint?

The score of a waypoint is the length of the expert's shortest path from start to goal, divided by
the length of the shortest path through the waypoint (Lu et al. 2024, Table II). So 1 is best, and 0
is a waypoint that cannot be reached by a straight edge, or from which no path leads to the goal.
From the waypoint, edges to all nodes of the roadmap in its window are tried. The roadmap itself has
only a share of such edges. So a path through the waypoint may even be shorter than the expert's;
its score is 1 too. Letters: ``N`` nodes, ``G`` goals, ``D`` joints, ``n`` queries.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csgraph

from nrp_jax.learning.edge_check import check_edges
from nrp_jax.learning.expert import make_rows
from nrp_jax.learning.roadmap import Extents, Roadmap
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, batch_is_free

ROUND = 64  # edges from a waypoint into the roadmap that are checked in one round
_BATCH = 1024  # edges whose lengths one compiled call computes


@dataclasses.dataclass(frozen=True, kw_only=True)
class Queries:
    """n starts and goals among the nodes of a roadmap, and how far all nodes are from the goals."""

    start: np.ndarray  # (n,) indices of nodes
    goal: np.ndarray  # (n,) indices into ``goals``
    goals: np.ndarray  # (G,) indices of nodes
    cost: np.ndarray  # (G, N) lengths of the shortest paths from each node to each goal

    def take(self, index: np.ndarray) -> "Queries":
        """Some of the queries (m,), perhaps several times."""
        return dataclasses.replace(self, start=self.start[index], goal=self.goal[index])


def make_queries(
    world: GridWorld,
    robot: MobileRobot,
    roadmap: Roadmap,
    num: int,
    seed: int | np.random.Generator,
) -> Queries:
    """Draw starts and goals as the data sets have them; fewer than ``num`` goals, shared."""
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
    """Optimality scores (n,), 0 to 1, of one waypoint for each query.

    Args:
        world: the robot in a home.
        robot: the robot.
        roadmap: of that home.
        queries: n starts and goals.
        waypoint: (n, D).
    """
    num = len(waypoint)
    q = np.concatenate([roadmap.q, waypoint]).astype(np.float32)
    own = len(roadmap.q) + np.arange(num)  # indices of the waypoints
    # The edges from the starts. An edge check leaves out the ends: waypoints are checked here.
    first, free = check_edges(world, q, np.stack([queries.start, own], axis=1))
    free &= np.asarray(batch_is_free(world, waypoint))
    # For each waypoint that can be reached: all nodes in its window, and the length of the path
    # through each to the goal, the shortest first.
    best = np.where(free, np.inf, 0.0)  # length from the waypoint to the goal
    extents = Extents(robot, q)
    waiting = {}
    for k in np.flatnonzero(free):
        near = np.flatnonzero(extents.inside(own[k], slice(len(roadmap.q))))
        total = _lengths(world, q, own[k], near) + queries.cost[queries.goal[k], near]
        order = np.argsort(total)
        waiting[int(k)] = (near[order], total[order])
    # Rounds of edge checks, until each waypoint has a free edge or no more nodes.
    while waiting:
        heads = {k: (near[:ROUND], total[:ROUND]) for k, (near, total) in waiting.items()}
        pairs = [np.stack([np.full(len(n), own[k]), n], 1) for k, (n, _) in heads.items()]
        _, ok = check_edges(world, q, np.concatenate(pairs).astype(np.int32))
        ok = np.split(ok, np.cumsum([len(pair) for pair in pairs])[:-1])
        for (k, (near, total)), passed in zip(heads.items(), ok, strict=True):
            if passed.any():
                best[k] = total[np.argmax(passed)]  # the first is the shortest
            rest = tuple(column[ROUND:] for column in waiting[k])
            if passed.any() or len(near) < ROUND or len(rest[0]) == 0:
                del waiting[k]
            else:
                waiting[k] = rest
    shortest = queries.cost[queries.goal, queries.start]
    score = shortest / np.maximum(first + best, 1e-9)
    return np.where(free, np.minimum(score, 1.0), 0.0)


def progress(world: GridWorld, rows: Mapping[str, np.ndarray]) -> np.ndarray:
    """How much nearer to the goal (n,) the waypoints of rows are than their starts [m].

    It is 0 for waypoints that cannot be reached, or that are farther from it.
    """
    edge = np.asarray(_batch_lengths(world, rows["q_start"], rows["waypoint"]))
    return np.maximum(edge - (rows["ratio"] - 1.0) * rows["length"], 0.0)


def _lengths(world: GridWorld, q: np.ndarray, own: int, near: np.ndarray) -> np.ndarray:
    """Lengths (m,) of the edges from node ``own`` to others ``near`` (m,), in batches."""
    size = -(-len(near) // _BATCH) * _BATCH
    index = np.resize(near, size) if len(near) else np.zeros(0, int)
    parts = [_batch_lengths(world, q[own], q[part]) for part in index.reshape(-1, _BATCH)]
    return np.concatenate([np.asarray(part) for part in parts] or [np.zeros(0)])[: len(near)]


@jax.jit
def _batch_lengths(world: GridWorld, q_from: jax.Array, q_to: jax.Array) -> jax.Array:
    return world.length(world.edge(jnp.broadcast_to(q_from, q_to.shape), q_to))
