"""The expert: a dense roadmap of a home, the shortest paths on it, and what they teach.

A roadmap joins nodes that fit into each other's local windows by free edges, as the Neural
Randomized Planner's does: of all such pairs the share that shortest paths are likely to use. Edges
that long are few on a shortest path, which so stays close to the true optimum. Letters: ``N``
nodes, ``M`` edges, ``D`` joints, ``n`` rows.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from nrp_jax.scene.robots import MobileRobot, batch_link_features
from nrp_jax.scene.world import GridWorld, batch_is_free
from vrrt_jax.core.planners.rrt import sample_configurations

HALF_WINDOW = 1.95  # [m] what is surely inside a window, whose center is rounded to cells
BODY_RADIUS = {"snake": 0.11, "fetch": 0.3}  # of the base [m]
POSITIVE = 1.1  # path through a waypoint over the optimum, up to which the waypoint is good
CANDIDATES = 200  # pairs checked for a node, on average
STARTS_PER_GOAL = 10
NEAR_GOALS = 0.25  # share of queries whose goal lies inside the window
CRITICAL = 0.5  # share of starts in the places that most shortest paths pass ...
NUM_CRITICAL = 100  # ... which are these nodes, as in the authors' code
_BLOCK, _CHUNK, _LEVELS = 1 << 16, 1 << 12, 7  # 2**levels parts of an edge at most
_DRAWS = 500  # chunks of samples


@dataclasses.dataclass(frozen=True, kw_only=True)
class Roadmap:
    """Free configurations of a home and the free edges between them, all in one piece."""

    q: np.ndarray  # (N, D)
    lengths: sparse.csr_matrix  # (N, N) symmetric, metric of the world
    colliding: np.ndarray  # (m, D) samples that were not free
    checked: int  # pairs of nodes looked at


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rows:
    """What the expert says about waypoints; see :class:`nrp_jax.learning.data.Dataset`."""

    q_start: np.ndarray  # (n, D)
    q_goal: np.ndarray  # (n, D)
    waypoint: np.ndarray  # (n, D)
    optimal: np.ndarray  # (n, D)
    ratio: np.ndarray  # (n,) length through the waypoint over the optimum; inf: not reachable
    length: np.ndarray  # (n,) of the optimum
    query: np.ndarray  # (n,) i32, rows of one query follow each other


def build_roadmap(
    world: GridWorld,
    robot: MobileRobot,
    key: jax.Array,
    num_nodes: int = 10_000,
    on_progress: Callable[[float], Any] | None = None,
) -> Roadmap:
    """Sample free configurations and check the edges between those in each other's window.

    Of each node ``CANDIDATES`` edges on average, see :func:`_neighbours`.

    Args:
        world: the robot in a home.
        robot: the robot.
        key: random key.
        num_nodes: free samples to draw; those outside the largest piece are dropped.
        on_progress: called with the share of edges that is done.

    Raises:
        ValueError: hardly any configuration in this home is free.
    """
    q, colliding = _sample(world, key, num_nodes)
    pairs = _neighbours(world, robot, q)
    length, free = check_edges(world, q, pairs, on_progress)
    a, b = pairs[free].T
    shape = (num_nodes, num_nodes)
    half = sparse.coo_matrix((length[free], (a, b)), shape)
    graph = (half + half.T).tocsr()
    _, piece = csgraph.connected_components(graph, directed=False)
    kept = np.flatnonzero(piece == np.bincount(piece).argmax())
    return Roadmap(q=q[kept], lengths=graph[kept][:, kept], colliding=colliding, checked=len(pairs))


def _sample(world: GridWorld, key: jax.Array, num: int) -> tuple[np.ndarray, np.ndarray]:
    free, colliding, found = [], [], 0
    for draw in range(1, _DRAWS + 1):
        q = sample_configurations(world, jax.random.fold_in(key, draw), _CHUNK)
        ok, q = np.asarray(batch_is_free(world, q)), np.asarray(q)
        free.append(q[ok])
        colliding.append(q[~ok])
        found += int(ok.sum())
        if found >= num:
            return np.concatenate(free)[:num], np.concatenate(colliding)[:num]
        if draw >= _DRAWS // 20 and found * _DRAWS < num * draw:
            break
    raise ValueError(
        f"only {found} of {draw * _CHUNK} configurations in this home are free, too few to find "
        f"{num}: check the map's resolution and which cells are solid"
    )


class Extents:
    """How far robots reach beyond their bases, to tell who is inside whose window."""

    def __init__(self, robot: MobileRobot, q: np.ndarray):
        """Of configurations ``q`` (N, D)."""
        points = np.asarray(batch_link_features(robot, jnp.asarray(q)))[..., :2] - q[:, None, :2]
        radius = BODY_RADIUS[robot.name]
        self.base = q[:, :2]
        self.low = np.minimum(points.min(1), -radius)  # (N, 2) [m]
        self.high = np.maximum(points.max(1), radius)  # (N, 2) [m]

    def inside(self, whose: np.ndarray | int, who: np.ndarray | slice) -> np.ndarray:
        """Whether robots ``who`` are wholly inside the windows around robots ``whose``, (...)."""
        step = self.base[who] - self.base[whose]
        far = np.maximum(step + self.high[who], -step - self.low[who])
        return (far < HALF_WINDOW).all(-1)


def _neighbours(world: GridWorld, robot: MobileRobot, q: np.ndarray) -> np.ndarray:
    """Pairs (M, 2) of nodes inside each other's windows, those worth checking.

    These are the ones whose arms have the least to do: a long way of the base costs the same in one
    edge or in several, but every change of posture on the way is lost. Measured on homes for the
    snake, paths with an eighth of the pairs are 3 % longer than with all, with an eighth taken at
    random 20 %.
    """
    extents = Extents(robot, q)
    pairs = cKDTree(q[:, :2]).query_pairs(HALF_WINDOW, p=np.inf, output_type="ndarray")
    a, b = pairs.T.astype(np.int32)
    mutual = extents.inside(a, b) & extents.inside(b, a)
    pairs = np.stack([a[mutual], b[mutual]], axis=1)
    wanted = CANDIDATES * len(q) // 2
    if len(pairs) <= wanted:
        return pairs
    nodes, lost = jnp.asarray(q), []
    for first in range(0, len(pairs), _BLOCK):
        block = _padded(pairs[first : first + _BLOCK], _BLOCK)
        lost.append(np.asarray(_posture_change(world, nodes, block[:, 0], block[:, 1])))
    lost = np.concatenate(lost)[: len(pairs)]
    return pairs[np.argpartition(lost, wanted)[:wanted]]


@jax.jit
def _posture_change(world: GridWorld, nodes: jax.Array, a: jax.Array, b: jax.Array) -> jax.Array:
    """Lengths (n,) of edges beyond the straight way of the base."""
    step = nodes[b, :2] - nodes[a, :2]
    return world.distance(nodes[a], nodes[b]) - jnp.sqrt(jnp.sum(step**2, -1))


def _padded(rows: np.ndarray, size: int) -> np.ndarray:
    """Rows followed by zeros, so that compiled functions see one shape."""
    padded = np.zeros((size, *rows.shape[1:]), rows.dtype)
    padded[: len(rows)] = rows
    return padded


def check_edges(
    world: GridWorld,
    q: np.ndarray,
    pairs: np.ndarray,
    on_progress: Callable[[float], Any] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (M,) of the edges between nodes ``pairs`` (M, 2) of ``q`` (N, D), which are free.

    Every edge is cut into as many parts as the world's resolution asks for. Their ends are checked
    from the middle outwards, as most blocked edges are out after their middle has been checked.

    Returns:
        Lengths (M,) and a mask (M,).

    Raises:
        ValueError: the world's resolution asks for more than 128 parts of an edge.
    """
    lengths, free = [], []
    nodes = jnp.asarray(q)
    for first in range(0, len(pairs), _BLOCK):
        block = pairs[first : first + _BLOCK]
        padded = _padded(block, _BLOCK)
        q_from, edge, length, parts = _prepare(world, nodes, padded[:, 0], padded[:, 1])
        parts = np.asarray(parts)[: len(block)]
        if parts.max() > 2**_LEVELS:
            raise ValueError(f"resolution is {float(world.resolution):g}: too fine for roadmaps")
        ok = np.zeros(len(block), bool)
        alive = np.arange(len(block))
        for numerator, depth in _halvings():
            ok[alive[parts[alive] <= 2 ** (depth - 1)]] = True
            alive = alive[~ok[alive]]
            if len(alive) == 0:
                break
            alive = _survivors(world, q_from, edge, parts, alive, numerator, depth)
        lengths.append(np.asarray(length)[: len(block)])
        free.append(ok)
        if on_progress is not None:
            on_progress((first + len(block)) / len(pairs))
    if not lengths:
        return np.zeros(0, np.float32), np.zeros(0, bool)
    return np.concatenate(lengths), np.concatenate(free)


def _halvings():
    """The middle, the quarters, the eighths ... as numerators, each with its depth."""
    for depth in range(1, _LEVELS + 1):
        for numerator in range(1, 2**depth, 2):
            yield numerator, depth
    yield 0, _LEVELS + 1


@jax.jit
def _prepare(world: GridWorld, nodes: jax.Array, a: jax.Array, b: jax.Array):
    q_from = nodes[a]
    edge = world.edge(q_from, nodes[b])
    return q_from, edge, world.length(edge), world.parts(edge, 2**_LEVELS)


def _survivors(
    world: GridWorld,
    q_from: jax.Array,
    edge: Any,
    parts: np.ndarray,
    alive: np.ndarray,
    numerator: int,
    depth: int,
) -> np.ndarray:
    """Those of the edges ``alive`` (m,) that are free where their part nearest a fraction ends."""
    num = parts[alive]
    before, at, after = (np.floor(num * (numerator + k) / 2**depth + 0.5) for k in (-1, 0, 1))
    new = (at != before) & (at != after)  # the others have been checked at a lower depth
    asked, fraction = alive[new], (at[new] / num[new]).astype(np.float32)
    results = [np.zeros(0, bool)]
    for first in range(0, len(asked), _CHUNK):
        index = _padded(asked[first : first + _CHUNK], _CHUNK)
        where = _padded(fraction[first : first + _CHUNK], _CHUNK)
        results.append(np.asarray(_chunk_free(world, q_from, edge, index, where)))
    kept = ~new
    kept[new] = np.concatenate(results)[: len(asked)]
    return alive[kept]


@jax.jit
def _chunk_free(world: GridWorld, q_from, edge, index: jax.Array, fraction: jax.Array):
    edge = jax.tree.map(lambda leaf: leaf[index], edge)
    q = world.end(q_from[index], world.truncate(edge, fraction))
    # Without the barrier the points are computed once for every use of a joint.
    return jax.vmap(world.is_free)(jax.lax.optimization_barrier(q))


def make_rows(
    world: GridWorld,
    robot: MobileRobot,
    roadmap: Roadmap,
    rng: np.random.Generator,
    num_queries: int,
    num_waypoints: int,
) -> Rows:
    """Ask the expert for waypoints.

    The optimal waypoint is the second node of the shortest path from start to goal. A query's rows
    are that, other good ones, detours, and places that cannot be reached, see :func:`_choose`.

    Args:
        world: the robot in a home.
        robot: the robot.
        roadmap: of that home.
        rng: where the choices come from.
        num_queries: starts with a goal each.
        num_waypoints: rows of a query.
    """
    goals = rng.choice(len(roadmap.q), -(-num_queries // STARTS_PER_GOAL), replace=False)
    cost, step = csgraph.dijkstra(roadmap.lengths, indices=goals, return_predecessors=True)
    critical = np.zeros(len(roadmap.q), bool)
    critical[np.argsort(-betweenness(cost, step))[:NUM_CRITICAL]] = True
    num_nodes = len(roadmap.q)
    q = np.concatenate([roadmap.q, roadmap.colliding])
    extents = Extents(robot, q)
    rows = []
    for query in range(num_queries):
        g = query // STARTS_PER_GOAL
        start = _choose_start(rng, extents.inside(goals[g], slice(num_nodes)), critical, goals[g])
        window = extents.inside(start, slice(None))
        chosen = _choose(rng, roadmap, start, cost[g], step[g, start], window, num_waypoints)
        rows += [(start, goals[g], g, node, step[g, start], query) for node in chosen]
    start, goal, g, node, optimal, query = np.array(rows, np.int32).T
    length = np.full(len(rows), np.inf)
    free = node < num_nodes
    length[free] = np.asarray(roadmap.lengths[start[free], node[free]]).ravel()
    length[length == 0] = np.inf
    unknown = np.flatnonzero(free & np.isinf(length))  # the roadmap may not have looked at them
    edge, ok = check_edges(world, q, np.stack([start, node], 1)[unknown])
    length[unknown[ok]] = edge[ok]
    best = cost[g, start]
    through = length + cost[g, np.where(free, node, 0)]
    return Rows(
        q_start=q[start],
        q_goal=q[goal],
        waypoint=q[node],
        optimal=q[optimal],
        ratio=(through / best).astype(np.float32),
        length=best.astype(np.float32),
        query=query,
    )


def _choose_start(
    rng: np.random.Generator, near_goal: np.ndarray, critical: np.ndarray, goal: int
) -> int:
    """A start, sometimes near the goal, often in a critical place."""
    wanted = near_goal.copy() if rng.random() < NEAR_GOALS else ~near_goal
    wanted[goal] = False
    if rng.random() < CRITICAL and (wanted & critical).any():
        wanted &= critical
    if not wanted.any():
        wanted = np.arange(len(critical)) != goal
    return int(rng.choice(np.flatnonzero(wanted)))


def _choose(
    rng: np.random.Generator,
    roadmap: Roadmap,
    start: int,
    cost: np.ndarray,
    optimal: int,
    window: np.ndarray,
    num: int,
) -> np.ndarray:
    """Waypoints (num,) for one query: nodes, or N + colliding samples.

    One is the optimum; of the others a quarter is nearly as good, a quarter leads astray, a quarter
    is free but behind something, and the rest collides.
    """
    row = slice(*roadmap.lengths.indptr[start : start + 2])
    joined = roadmap.lengths.indices[row]
    ratio = (roadmap.lengths.data[row] + cost[joined]) / cost[start]
    inside, num_nodes = np.flatnonzero(window), len(roadmap.q)
    apart = np.setdiff1d(inside[inside < num_nodes], [*joined, start])
    good = joined[(ratio <= POSITIVE) & (joined != optimal)]
    groups = [good, joined[ratio > POSITIVE], apart, inside[inside >= num_nodes]]
    groups = [rng.permutation(group) for group in groups]
    quota = -(-(num - 1) // 4)
    first = np.concatenate([[optimal], *(group[:quota] for group in groups)])
    rest = np.concatenate([group[quota:] for group in groups])
    return np.concatenate([first, rest])[:num]


def betweenness(cost: np.ndarray, step: np.ndarray) -> np.ndarray:
    """How many shortest paths pass each node (N,), of those from all nodes to some goals.

    Args:
        cost: (G, N) lengths of the shortest paths to each goal.
        step: (G, N) next node on them, negative at the goals.
    """
    total = np.zeros(cost.shape[1])
    for far_to_near, following in zip(np.argsort(-cost, axis=1), step.tolist(), strict=True):
        passing = [1] * len(following)
        for node in far_to_near.tolist():
            if following[node] >= 0:
                passing[following[node]] += passing[node]
        total += passing
    return total - len(cost)
