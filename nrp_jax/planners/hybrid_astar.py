"""Hybrid A*: the way of a base that drives like a car, with the arm as it is.

The search is over poses, not over cells: a node keeps the exact pose that a motion led to, and its
cell only tells which poses are as good as one another (Dolgov, Thrun, Montemerlo and Diebel 2010).
A motion turns on the smallest circle and then goes straight, 0.5 m in all, forwards or in reverse.
Each node also tries the shortest Reeds-Shepp curve to the goal. The base is a disc of 0.3 m among
the obstacles below 1.1 m (Lu et al. 2024). Letters: ``B`` nodes at a time, ``M`` motions, ``D``
joints, ``S`` places along an edge.
"""

import dataclasses
import heapq
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph

from nrp_jax.homes.grid import Grid
from nrp_jax.learning.difficulty import floor_graph
from nrp_jax.learning.edge_check import pad_rows
from nrp_jax.scene import reeds_shepp
from nrp_jax.scene.car_world import CarWorld
from nrp_jax.scene.near_cells import NearCells, make_near_cells, touches
from vrrt_jax.core.edge_checks import is_edge_free
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.types import pytree

STEP = 0.5  # length of a motion [m]
RADIUS, HEIGHT = 0.3, 1.1  # of the disc that stands for the base, and of what is in its way [m]
TURNS = (0.0, 0.25, 0.5, 1.0, 1.5)  # of a motion, to either side [rad]
BATCH = 16  # nodes that are looked at together
_HEADINGS = 24  # of a turn, that count as different
_CHECKS = 128  # sub-steps along an edge, at most
_SPARE = 1e-3  # [m] of room at the start and the goal, that the disc leaves


@pytree
class Floor:
    """What is in the way of the base."""

    near: NearCells  # planar
    corner: jax.Array  # (2,) of the map [m]
    radius: jax.Array  # () of the disc [m]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """What Hybrid A* found."""

    path: np.ndarray | None  # (P, D), None if there is no way, or the search was ended
    is_over: bool  # all is searched: there is no such way
    looked: int  # nodes
    checked: int  # configurations checked for collision
    compile_s: float
    search_s: float


def drive(
    world: CarWorld,
    grid: Grid,
    q_start: np.ndarray,
    q_goal: np.ndarray,
    *,
    time_limit_s: float = float("inf"),
) -> Drive:
    """Drive from one pose of the base to another.

    The disc is smaller where the start or the goal has less room than its radius. The robot itself
    is checked too, by ``world.is_free``, as finely as the world asks.

    Args:
        world: the robot in a home, with a base that drives like a car.
        grid: the home, where the world has it.
        q_start: (D,) free configuration.
        q_goal: (D,) free configuration with the same arm.
        time_limit_s: wall time without compilation [s].
    """
    low = grid.flatten(grid.origin[2], HEIGHT)
    room = min(_room(low, q[:2]) for q in (q_start, q_goal))
    radius = min(RADIUS, room - _SPARE)
    way = Floor(
        near=make_near_cells(low, RADIUS),
        corner=jnp.asarray(low.origin[:2], jnp.float32),
        radius=jnp.float32(max(radius, 0.0)),
    )
    to_goal = _lengths_to_goal(low, radius, q_start, q_goal)
    begun = time.perf_counter()
    jax.block_until_ready(_look(world, way, *_rows([(q_start, q_start)]), jnp.asarray(q_goal)))
    search = _Search(world, low, way, to_goal, q_start, q_goal)
    started = time.perf_counter()
    with interruptible() as interrupted:
        while search.heap and search.path is None and not interrupted.is_set():
            if time.perf_counter() - started >= time_limit_s:
                break
            search.look()
    return Drive(
        path=search.path,
        is_over=search.path is None and not search.heap,
        looked=len(search.nodes),
        checked=search.checked,
        compile_s=started - begun,
        search_s=time.perf_counter() - started,
    )


class _Search:
    """The nodes so far, and the edges to look at next, the most promising first.

    An edge is checked only when its turn comes, so that most are never checked.
    """

    def __init__(self, world, low: Grid, way: Floor, to_goal: np.ndarray, q_start, q_goal):
        self.world, self.low, self.way, self.to_goal = world, low, way, to_goal
        self.q_goal = np.asarray(q_goal, np.float32)
        # Of each node: its configuration, its parent and the length of the way to it.
        self.nodes: list[tuple[np.ndarray, int, float]] = []
        self.closed: set[tuple[int, int, int]] = set()
        self.path, self.checked, self.pushed = None, 0, 0
        self.heap: list[tuple[float, int, int, np.ndarray, float, bool]] = []
        self._push(0.0, -1, np.asarray(q_start, np.float32), 0.0, False)

    def _push(self, promise: float, parent: int, q: np.ndarray, cost: float, is_goal: bool) -> None:
        # Of edges that promise the same the one goes first that was thought of first.
        self.pushed += 1
        heapq.heappush(self.heap, (promise, self.pushed, parent, q, cost, is_goal))

    def look(self) -> None:
        """Look at the best edges: those that are free make nodes, which make edges."""
        chosen = []
        while self.heap and len(chosen) < BATCH:
            _, _, parent, q, cost, is_goal = heapq.heappop(self.heap)
            if is_goal or self._cell(q) not in self.closed:
                chosen.append((parent, q, cost, is_goal))
        if not chosen:
            return
        ends = [(self.nodes[p][0] if p >= 0 else q, q) for p, q, _, _ in chosen]
        found = _look(self.world, self.way, *_rows(ends), jnp.asarray(self.q_goal))
        free, children, costs, straight, checked = jax.device_get(found)
        self.checked += int(checked)
        for row, (parent, q, cost, is_goal) in enumerate(chosen):
            # Of two ways to a cell in one batch the first is the shorter one.
            if not free[row] or (not is_goal and self._cell(q) in self.closed):
                continue
            self.closed.add(self._cell(q))
            self.nodes.append((q, parent, cost))
            if is_goal:
                self.path = self._way_back()
                return
            node, direct = len(self.nodes) - 1, float(straight[row, -1])
            self._push(cost + direct, node, self.q_goal, cost + direct, True)
            for child, length, left in zip(children[row], costs, straight[row, :-1], strict=True):
                self._reach(node, child, cost + float(length), float(left))

    def _reach(self, node: int, child: np.ndarray, cost: float, left: float) -> None:
        """Keep an edge in mind, unless it leads nowhere."""
        x, y, _ = self._cell(child)
        shape = self.to_goal.shape
        if not (0 <= x < shape[0] and 0 <= y < shape[1]):
            return
        promise = cost + max(left, float(self.to_goal[x, y]))
        if np.isfinite(promise) and self._cell(child) not in self.closed:
            self._push(promise, node, child, cost, False)

    def _cell(self, q: np.ndarray) -> tuple[int, int, int]:
        x, y = np.floor((q[:2] - self.low.origin[:2]) / self.low.resolution).astype(int)
        return int(x), int(y), int(np.round(q[2] / (2 * np.pi) * _HEADINGS)) % _HEADINGS

    def _way_back(self) -> np.ndarray:
        path, node = [], len(self.nodes) - 1
        while node >= 0:
            q, node, _ = self.nodes[node]
            path.append(q)
        return np.stack(path[::-1])


@jax.jit
def _look(world: Any, way: Floor, q_from: jax.Array, q: jax.Array, goal: jax.Array):
    """Whether edges (B,) are free, and where motions lead to from their ends.

    Returns:
        (B,) bool; (B, M, D) configurations; (M,) lengths of the motions; (B, M + 1) lengths of the
        curves from there to the goal, and last from the end itself; () how many were checked.
    """
    edge = world.edge(q_from, q)
    share = jnp.linspace(0.0, 1.0, _CHECKS)[:, None] * jnp.ones(len(q))
    along = world.end(q_from, world.truncate(edge, share))[..., :2].reshape(-1, 2)
    standing = (along - way.corner).T
    hits = touches(way.near, standing, jnp.broadcast_to(way.radius, len(along)))
    clear = ~jnp.any(hits.reshape(_CHECKS, -1), axis=0)
    clear &= world.is_resolved(edge, _CHECKS)
    free, checked = is_edge_free(world, q_from, edge, _CHECKS, clear)
    motions = _motions(world.radius)
    base = reeds_shepp.follow(q[:, None, :3], motions, world.radius)
    children = jnp.concatenate(
        [base, jnp.broadcast_to(q[:, None, 3:], (*base.shape[:2], q.shape[1] - 3))], axis=-1
    )
    children = world.normalize(children)
    ends = jnp.concatenate([children, q[:, None]], axis=1)[..., :3]
    left = reeds_shepp.length(ends, jnp.broadcast_to(goal[:3], ends.shape), world.radius)
    lengths = reeds_shepp.curve_length(motions) * world.radius
    return free, children, lengths, left, checked


def _motions(radius: jax.Array) -> reeds_shepp.Curve:
    """The motions (M,): turns to both sides and then straight on, forwards and in reverse."""
    turns = np.array([*TURNS, *(-turn for turn in TURNS[1:])], np.float32)
    turns, gear = np.tile(turns, 2), np.repeat([1.0, -1.0], len(turns)).astype(np.float32)
    drives = (gear * np.abs(turns), gear * (STEP / radius - np.abs(turns)))
    still = jnp.zeros(len(turns))
    return reeds_shepp.Curve(
        drive=(jnp.asarray(drives[0]), jnp.asarray(drives[1]), still, still, still),
        turn=(jnp.sign(jnp.asarray(turns)), still, still, still, still),
    )


def _rows(ends: list[tuple[np.ndarray, np.ndarray]]) -> tuple[jax.Array, jax.Array]:
    """Starts and ends (BATCH, D) of edges, of which the last ones stay where they are."""
    both = pad_rows(np.array(ends, np.float32), BATCH)
    both[len(ends) :] = both[0, 0]
    return jnp.asarray(both[:, 0]), jnp.asarray(both[:, 1])


def _room(low: Grid, place: np.ndarray) -> float:
    """Distance of a place (2,) to the nearest solid cell, or to the end of the map [m]."""
    local = np.asarray(place, float) - low.origin[:2]
    first = np.argwhere(low.occupied[..., 0]) * low.resolution
    gap = np.maximum(np.maximum(first - local, local - first - low.resolution), 0.0)
    beside = np.min([local, low.size[:2] - local])
    return float(np.min(np.linalg.norm(gap, axis=1), initial=beside))


def _lengths_to_goal(low: Grid, radius: float, q_start, q_goal) -> np.ndarray:
    """Lengths (X, Y) of the shortest ways from cells to the goal's cell, inf where there is none.

    They go from cell to cell, and pass only where there is nearly room for the disc.
    """
    solid = np.pad(low.occupied[..., 0], 1, constant_values=True)
    # From centers of cells to edges of solid ones; half a diagonal is what a cell may be off.
    apart = (np.asarray(ndimage.distance_transform_edt(~solid))[1:-1, 1:-1] - 0.5) * low.resolution
    passed = apart + low.resolution * np.sqrt(0.5) > radius
    cells = [
        tuple(np.floor((np.asarray(q[:2]) - low.origin[:2]) / low.resolution).astype(int))
        for q in (q_start, q_goal)
    ]
    for cell in cells:
        passed[cell] = True
    index = np.full(passed.shape, -1)
    index[passed] = np.arange(passed.sum())
    lengths = np.full(passed.shape, np.inf)
    graph = floor_graph(index, low.resolution)
    lengths[passed] = csgraph.dijkstra(graph, directed=False, indices=index[cells[1]])
    return lengths
