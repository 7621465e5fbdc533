"""Edge checks that stop early: of a roadmap's many edges, and of a lane's ranked waypoints.

Planners check edges with :func:`vrrt_jax.core.edge_checks.free_prefix` inside their programs, from
coarse to fine. :func:`first_free` uses it too. :func:`check_edges` need not run inside a program: a
roadmap has a million edges of very different lengths, only wants to know whether a whole edge is
free, and most edges are blocked. So each edge gets the fewest sub-steps that its length needs, all
of one size, these are checked from the middle outwards, and the host drops an edge as soon as one
configuration collides. Letters: ``N`` nodes, ``M`` edges, ``B`` lanes, ``K`` waypoints of a lane,
``D`` joints.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edge_checks import free_prefix

# Edges prepared by one compiled call. Data sets depend on it: with batches of another size, lengths
# differ in their last bits.
EDGE_BATCH = 1 << 16
POINT_BATCH = 1 << 12  # configurations checked by one compiled call
SMALL_POINT_BATCH = 1 << 9  # the same where so few are to check
_MAX_DEPTH = 7  # an edge has 2**7 parts at most


def check_edges(
    world: GridWorld, q: np.ndarray, pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Tell the lengths of edges between nodes, and whether the edges are free.

    Both nodes of an edge are taken to be free and are not checked.

    Args:
        world: the robot in a home.
        q: (N, D) nodes.
        pairs: (M, 2) indices of each edge's nodes.

    Returns:
        Lengths (M,) in the world's metric, and which edges are free (M,) bool.

    Raises:
        ValueError: the world's resolution asks for more than 128 parts of an edge.
    """
    lengths, free = [], []
    nodes = jnp.asarray(q)
    for first in range(0, len(pairs), EDGE_BATCH):
        block = pairs[first : first + EDGE_BATCH]
        batch = pad_rows(block, EDGE_BATCH)
        q_from, edge, length, parts = _prepare(world, nodes, batch[:, 0], batch[:, 1])
        parts = np.asarray(parts)[: len(block)]
        if parts.max() > 2**_MAX_DEPTH:
            raise ValueError(f"resolution is {float(world.resolution):g}: too fine for roadmaps")
        block_free = np.zeros(len(block), bool)
        alive = np.arange(len(block))  # edges without a collision so far
        for numerator, depth in _halvings():
            # Edges whose parts were all checked at the depths before are free.
            block_free[alive[parts[alive] <= 2 ** (depth - 1)]] = True
            alive = alive[~block_free[alive]]
            if len(alive) == 0:
                break
            alive = _survivors(world, q_from, edge, parts, alive, numerator, depth)
        lengths.append(np.asarray(length)[: len(block)])
        free.append(block_free)
    if not lengths:
        return np.zeros(0, np.float32), np.zeros(0, bool)
    return np.concatenate(lengths), np.concatenate(free)


def pad_rows(rows: np.ndarray, size: int) -> np.ndarray:
    """Rows followed by zeros up to a size, so that compiled functions see one shape."""
    padded = np.zeros((size, *rows.shape[1:]), rows.dtype)
    padded[: len(rows)] = rows
    return padded


def _halvings():
    """The middle, the quarters, the eighths, ...: numerators of 2**depth, each with its depth.

    The last depth has nothing to check: it is there to mark the edges that are left as free.
    """
    for depth in range(1, _MAX_DEPTH + 1):
        for numerator in range(1, 2**depth, 2):
            yield numerator, depth
    yield 0, _MAX_DEPTH + 1


@jax.jit
def _prepare(world: GridWorld, nodes: jax.Array, a: jax.Array, b: jax.Array):
    """Starts, edges, lengths and numbers of parts of the edges from nodes ``a`` to ``b`` (m,)."""
    q_from = nodes[a]
    edge = world.edge(q_from, nodes[b])
    return q_from, edge, world.length(edge), world.parts(edge, 2**_MAX_DEPTH)


def _survivors(
    world: GridWorld,
    q_from: jax.Array,
    edge: Any,
    parts: np.ndarray,
    alive: np.ndarray,
    numerator: int,
    depth: int,
) -> np.ndarray:
    """Check one configuration on each edge, near a fraction of it; return the edges still free.

    Args:
        world: the robot in a home.
        q_from: (M, D) starts of all edges.
        edge: all edges.
        parts: (M,) number of parts of each edge.
        alive: (m,) indices of the edges to check.
        numerator: of the fraction.
        depth: the denominator is ``2**depth``.
    """
    # An edge is checked where its parts end. Which end is nearest to the fraction? And was it
    # the nearest to one of the neighboring fractions too, which have been checked before?
    num = parts[alive]
    before, at, after = (np.floor(num * (numerator + k) / 2**depth + 0.5) for k in (-1, 0, 1))
    new = (at != before) & (at != after)
    asked, fraction = alive[new], (at[new] / num[new]).astype(np.float32)
    results = [np.zeros(0, bool)]
    size = SMALL_POINT_BATCH if len(asked) <= SMALL_POINT_BATCH else POINT_BATCH
    for first in range(0, len(asked), size):
        index = pad_rows(asked[first : first + size], size)
        where = pad_rows(fraction[first : first + size], size)
        results.append(np.asarray(_points_free(world, q_from, edge, index, where)))
    kept = ~new
    kept[new] = np.concatenate(results)[: len(asked)]
    return alive[kept]


@jax.jit
def _points_free(world: GridWorld, q_from, edge, index: jax.Array, fraction: jax.Array):
    """Whether the configurations at fractions (m,) of the edges ``index`` (m,) are free, (m,)."""
    edge = jax.tree.map(lambda leaf: leaf[index], edge)
    q = world.end(q_from[index], world.truncate(edge, fraction))
    # Without the barrier the points are computed once for every use of a joint.
    return jax.vmap(world.is_free)(jax.lax.optimization_barrier(q))


def first_free(
    world: GridWorld, q_from: jax.Array, q: jax.Array, num_checks: int
) -> tuple[jax.Array, jax.Array]:
    """The first waypoint of each lane whose edge is free; the best if none is.

    Args:
        world: the robot in a home.
        q_from: (B, D) starts of the edges.
        q: (B, K, D) waypoints, the best first.
        num_checks: configurations checked along each edge, the last of them the waypoint.

    Returns:
        (B, D) waypoints, and () i32 how many configurations were checked.
    """
    lanes, many, joints = q.shape
    if many == 1:
        return q[:, 0], jnp.int32(0)
    # A round checks B edges, of the lanes that have found no free one. Most lanes are done after
    # the first round, so that the others get several edges of the next. ``turn`` orders the edges:
    # the best of all lanes, then the second best, and so on.
    turn = jnp.arange(many)[None] * lanes + jnp.arange(lanes)[:, None]

    def check_round(state):
        pending, free, checked = state  # (B, K) edges still to check, and those found free
        _, index = jax.lax.top_k(-jnp.where(pending, turn, many * lanes).reshape(-1), lanes)
        lane = index // many
        edge = world.edge(q_from[lane], q.reshape(-1, joints)[index])
        num_free, more = free_prefix(world, q_from[lane], edge, num_checks)
        free = free.at[lane, index % many].max(num_free == num_checks)
        pending = pending.at[lane, index % many].set(False)
        # A lane with a free edge has no more edges to check.
        return pending & ~jnp.any(free, axis=1, keepdims=True), free, checked + more

    untried = jnp.ones((lanes, many), bool)
    start = (untried, ~untried, jnp.int32(0))
    _, free, checked = jax.lax.while_loop(lambda s: jnp.any(s[0]), check_round, start)
    first = jnp.argmax(free, axis=1)[:, None, None]
    return jnp.take_along_axis(q, first, axis=1)[:, 0], checked
