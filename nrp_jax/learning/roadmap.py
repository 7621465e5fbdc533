"""Roadmaps: a dense graph of free edges in a home, on which shortest paths are nearly optimal.

Nodes are free configurations. An edge joins two nodes that fit into each other's local windows, as
the waypoints of the Neural Randomized Planner do (Lu et al. 2024). Of all such pairs only those are
checked that shortest paths are likely to use. As the edges are long, a shortest path has few of
them and stays close to the true optimum. Letters: ``N`` nodes, ``M`` pairs, ``D`` joints.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from nrp_jax.learning.edge_check import EDGE_BATCH, POINT_BATCH, check_edges, pad_rows
from nrp_jax.scene.robots import MobileRobot, batch_link_features
from nrp_jax.scene.world import GridWorld, batch_is_free
from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.data_file import of_file
from vrrt_jax.core.files import replacing
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.precision import single_precision

# A local window reaches 2 m from its center, which is rounded to cells: half a cell less is safe.
HALF_WINDOW = 1.95  # [m]
BODY_RADIUS = {"snake": 0.11, "fetch": 0.3}  # of the base [m]
CANDIDATES = 200  # edges checked for a node, on average
_DRAWS = 500  # batches of samples drawn, at most


@dataclasses.dataclass(frozen=True, kw_only=True)
class Roadmap:
    """Free configurations of a home and the free edges between them; the graph is connected."""

    q: np.ndarray  # (N, D) nodes
    lengths: sparse.csr_matrix  # (N, N) of the edges, symmetric, in the metric of the world
    colliding: np.ndarray  # (m, D) samples that were not free

    def save(self, path: Path) -> None:
        """Write an ``.npz`` that :func:`load_roadmap` reads."""
        graph = {name: getattr(self.lengths, name) for name in ("data", "indices", "indptr")}
        with replacing(path) as handle:
            np.savez(handle, q=self.q, colliding=self.colliding, **graph)


@single_precision
def load_roadmap(path: Path) -> Roadmap:
    """Read a roadmap that :meth:`Roadmap.save` wrote.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is damaged, or of another kind.
    """
    names = ("data", "indices", "indptr", "q", "colliding")
    arrays = read_arrays(path, *names)
    *parts, q, colliding = (arrays[name] for name in names)
    with of_file(path):
        lengths = sparse.csr_matrix(tuple(parts), shape=(len(q),) * 2)
        lengths.check_format(full_check=True)
    return Roadmap(q=q, lengths=lengths, colliding=colliding)


@single_precision
def build_roadmap(
    world: GridWorld,
    robot: MobileRobot,
    key: jax.Array,
    num_nodes: int = 10_000,
) -> Roadmap:
    """Sample free configurations and check the edges between those in each other's window.

    A node gets ``CANDIDATES`` edges on average, see :func:`_neighbors`.

    Args:
        world: the robot in a home.
        robot: the robot.
        key: random key.
        num_nodes: free samples to draw; those outside the largest connected part are dropped.

    Raises:
        ValueError: hardly any configuration in this home is free.
    """
    q, colliding = _sample(world, key, num_nodes)
    pairs = _neighbors(world, robot, q)
    length, free = check_edges(world, q, pairs)
    # The graph of free edges, in both directions.
    a, b = pairs[free].T
    shape = (num_nodes, num_nodes)
    half = sparse.coo_matrix((length[free], (a, b)), shape)
    graph = (half + half.T).tocsr()
    # Its largest connected part, so that every goal can be reached from every start.
    _, part = csgraph.connected_components(graph, directed=False)
    kept = np.flatnonzero(part == np.bincount(part).argmax())
    return Roadmap(q=q[kept], lengths=graph[kept][:, kept], colliding=colliding)


def _sample(world: GridWorld, key: jax.Array, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Random free configurations (num, D), and random ones that collide, ``num`` at most."""
    free, colliding, found = [], [], 0
    for draw in range(1, _DRAWS + 1):
        q = sample_configurations(world, jax.random.fold_in(key, draw), POINT_BATCH)
        ok, q = np.asarray(batch_is_free(world, q)), np.asarray(q)
        free.append(q[ok])
        colliding.append(q[~ok])
        found += int(ok.sum())
        if found >= num:
            return np.concatenate(free)[:num], np.concatenate(colliding)[:num]
        # Give up early if all draws together would not find enough.
        if draw >= _DRAWS // 20 and found * _DRAWS < num * draw:
            break
    raise ValueError(
        f"only {found} of {draw * POINT_BATCH} configurations in this home are free, too few to "
        f"find {num}: check the map's resolution and which cells are solid"
    )


class Extents:
    """How far robots reach beyond their bases, to tell which robots are inside which windows."""

    def __init__(self, robot: MobileRobot, q: np.ndarray):
        """Measure the robot in configurations ``q`` (N, D)."""
        points = np.asarray(batch_link_features(robot, jnp.asarray(q)))[..., :2] - q[:, None, :2]
        radius = BODY_RADIUS[robot.name]
        self.base = q[:, :2]  # (N, 2) [m]
        self.low = np.minimum(points.min(1), -radius)  # (N, 2) from the base [m]
        self.high = np.maximum(points.max(1), radius)  # (N, 2) from the base [m]

    def inside(self, centers: np.ndarray | int, robots: np.ndarray | slice) -> np.ndarray:
        """Whether robots are wholly inside the windows around others, (...) bool.

        Args:
            centers: indices of the configurations whose windows are meant.
            robots: indices of the configurations that may be inside.
        """
        step = self.base[robots] - self.base[centers]
        far = np.maximum(step + self.high[robots], -step - self.low[robots])
        return (far < HALF_WINDOW).all(-1)


def _neighbors(world: GridWorld, robot: MobileRobot, q: np.ndarray) -> np.ndarray:
    """Pairs (M, 2) of nodes inside each other's windows, those worth checking.

    If there are too many pairs, those are kept whose posture changes least. Driving a distance
    costs the same in one edge or in several, but every change of posture in between is lost.
    Measured on homes for the snake: with an eighth of the pairs, shortest paths are 3 % longer than
    with all pairs; with an eighth taken at random they are 20 % longer.
    """
    extents = Extents(robot, q)
    pairs = cKDTree(q[:, :2]).query_pairs(HALF_WINDOW, p=np.inf, output_type="ndarray")
    a, b = pairs.T.astype(np.int32)
    mutual = extents.inside(a, b) & extents.inside(b, a)
    pairs = np.stack([a[mutual], b[mutual]], axis=1)
    wanted = CANDIDATES * len(q) // 2
    if len(pairs) <= wanted:
        return pairs
    nodes, change = jnp.asarray(q), []
    for first in range(0, len(pairs), EDGE_BATCH):
        batch = pad_rows(pairs[first : first + EDGE_BATCH], EDGE_BATCH)
        change.append(np.asarray(_posture_change(world, nodes, batch[:, 0], batch[:, 1])))
    change = np.concatenate(change)[: len(pairs)]
    return pairs[np.argpartition(change, wanted)[:wanted]]


@jax.jit
def _posture_change(world: GridWorld, nodes: jax.Array, a: jax.Array, b: jax.Array) -> jax.Array:
    """Lengths (n,) of edges less the straight distance of their bases [m]."""
    step = nodes[b, :2] - nodes[a, :2]
    return world.distance(nodes[a], nodes[b]) - jnp.sqrt(jnp.sum(step**2, -1))
