"""By drive: the arm is folded, the base drives along the floor, the arm unfolds at the goal.

With its arm folded a robot is little more than a disc, and the shortest way of a disc is found
at once. So what is left of a query are two short searches: from the start to that drive, and from
the goal to it. Letters: ``A`` joints of the arm, ``K`` configurations of a drive, ``n`` postures.
"""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csgraph

from nrp_jax.homes.grid import RESOLUTION, Grid
from nrp_jax.learning.difficulty import floor_graph
from nrp_jax.scene.field import FINE, floor_clearance
from nrp_jax.scene.robots import load_robot
from nrp_jax.scene.world import GridWorld, build_world, corner_of
from vrrt_jax.core.compiling import compile_together, host_jit
from vrrt_jax.core.edge_checks import is_edge_free
from vrrt_jax.core.edges import steps_between
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import link_poses, place

LENGTH = 64  # K, configurations along a drive
DRAWN = 1 << 16  # random postures, of which the folded ones are kept
FOLDED = 0.05  # how much farther than the most compact ones they may reach [m]
NARROW = 20.0  # how many times as long a way counts where the robot hardly passes
COMFORT = 0.6  # from here on, more clearance makes no way shorter [m]
SPARSE = 2  # the way of a base that slides leads over every second cell, along each axis
TURN = 3  # the heading is that from so many configurations before to so many after


@pytree
class Folded:
    """Postures that keep the arm close to the base and do not touch the robot itself."""

    arm: Any  # (n, A) [rad] or [m]
    reach: Any  # (n,) from the axis of the base to the farthest point [m]
    top: Any  # (n,) height of the highest point [m]


@single_precision
@functools.cache
def folded_postures(name: str) -> Folded:
    """Postures that a robot may drive in; drawn once, always the same.

    Args:
        name: of :func:`nrp_jax.scene.robots.load_robot`.
    """
    robot = load_robot(name)
    cells = np.zeros((30, 30, 1 if robot.planar else 20), bool)
    empty = build_world(robot, Grid(occupied=cells, resolution=RESOLUTION, origin=(-1.5, -1.5, 0)))
    q = jax.random.uniform(
        jax.random.key(0), (DRAWN, robot.num_joints), minval=empty.lower, maxval=empty.upper
    )
    q = q.at[:, : robot.base_dim].set(0.0)
    reach, top, free = map(np.asarray, _extents(empty, q))
    kept = np.flatnonzero(free & (reach <= np.min(reach[free]) + FOLDED))
    return Folded(arm=np.asarray(q)[kept, robot.base_dim :], reach=reach[kept], top=top[kept])


@host_jit
def _extents(world: GridWorld, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Reaches (n,) and tops (n,) [m] of configurations (n, D) at the origin; which are free."""

    def of_one(q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        center = place(world.collision_spheres, link_poses(world.chain, q))
        reach = jnp.max(jnp.hypot(center[0], center[1]) + world.collision_radius)
        return reach, jnp.max(center[2] + world.collision_radius), world.is_free(q)

    return jax.lax.map(of_one, q, batch_size=1024)


def find_drive(
    world: GridWorld, folded: Folded, q_start: np.ndarray, q_goal: np.ndarray, rank: int = 0
) -> np.ndarray | None:
    """The longest free stretch of the drive from a start to a goal, (K, D); on the host.

    The base goes the shortest way, where centimeters with little clearance count more. The arm has
    a folded posture that is near to both ends.

    Args:
        world: the robot in a home.
        folded: from :func:`folded_postures`.
        q_start: (D,) where the path begins.
        q_goal: (D,) where it ends.
        rank: so many postures are nearer to both ends than the one that is taken.

    Returns:
        (K, D) configurations, some of them twice where the stretch is short. The edges from each to
        the next are free. None where the floor does not join the ends, or nothing is free.
    """
    first, postures = world.first_arm, np.pad(folded.arm, [(0, 0), (world.first_arm, 0)])
    steps = steps_between(world, np.stack([q_start, q_goal]), postures[:, None])[..., first:]
    nearest = np.argsort(np.linalg.norm(steps, axis=-1).sum(axis=1))
    chosen = nearest[min(rank, len(nearest) - 1)]
    base = _base_drive(world, q_start, q_goal, folded.reach[chosen], folded.top[chosen])
    if base is None:
        return None
    arm = np.broadcast_to(folded.arm[chosen], (LENGTH, folded.arm.shape[1]))
    q = np.concatenate([base, arm], axis=1).astype(np.float32)
    stands, joined = map(np.asarray, _checked(world, q))
    # The longest stretch, begun anew wherever an edge is not free.
    begins = np.flatnonzero(np.concatenate([[True], ~joined]))
    length = np.diff(np.append(begins, LENGTH)) * stands[begins]
    longest = int(np.argmax(length))
    if length[longest] == 0:
        return None
    kept = begins[longest] + np.linspace(0, length[longest] - 1, LENGTH)
    return q[np.round(kept).astype(int)]


def compile_drive(world: GridWorld) -> float:
    """Compile what :func:`find_drive` runs, unless it was done before; seconds."""
    started = time.perf_counter()
    q = np.zeros((LENGTH, world.lower.shape[0]), np.float32)
    compile_together((world, q), lambda: jax.block_until_ready(_checked(world, q)))
    return time.perf_counter() - started


@host_jit
def _checked(world: GridWorld, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Which configurations (K, D) are free, (K,), and which edges to the next, (K - 1,)."""
    # An edge without length is free where its end is: so there is one program of checks.
    q_from, q_to = jnp.concatenate([q, q[:-1]]), jnp.concatenate([q, q[1:]])
    edge = world.edge(q_from, q_to)
    free, _ = is_edge_free(world, q_from, edge, LENGTH)
    free &= world.is_resolved(edge, LENGTH)
    stands, joined = free[: len(q)], free[len(q) :]
    return stands, joined & stands[:-1]


def _base_drive(
    world: GridWorld, q_start: np.ndarray, q_goal: np.ndarray, reach: float, top: float
) -> np.ndarray | None:
    """Places (K, 2) of the base, with the headings (K, 3) of one that drives.

    None where the floor does not join the ends.
    """
    # The clearance of the cells' centers, from all that is as low as the robot is high.
    step, corner = float(world.field.step), corner_of(world)
    every = 1 if world.first_arm > 2 else SPARSE
    cell, first = FINE * every * step, corner + FINE * step / 2  # apart; the first of them
    clearance = floor_clearance(world.field, top, every)
    ends = np.round((np.stack([q_start, q_goal])[:, :2] - first) / cell).astype(int)
    a, b = map(tuple, np.clip(ends, 0, np.array(clearance.shape) - 1))
    passable = clearance > 0
    passable[a] = passable[b] = True
    # The shortest way over the cells, each counted by its clearance.
    index = np.full(clearance.shape, -1)
    index[passable] = np.arange(passable.sum())
    tight = 1 + np.maximum(COMFORT - clearance, 0)
    weight = np.where(clearance < reach, NARROW, tight)[passable]
    graph = floor_graph(index, cell)
    graph.data *= (np.repeat(weight, np.diff(graph.indptr)) + weight[graph.indices]) / 2
    _, before = csgraph.dijkstra(graph, indices=index[a], return_predecessors=True)
    way = [int(index[b])]
    while way[-1] != index[a]:
        if before[way[-1]] < 0:
            return None
        way.append(int(before[way[-1]]))
    places = np.argwhere(passable)[way[::-1]] * cell + first
    places = np.concatenate([[q_start[:2]], places[1:-1], [q_goal[:2]]])
    # Evenly spaced; a base that drives heads where it goes, and at the ends as they are.
    gone = np.append(0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    at = np.linspace(0, gone[-1], LENGTH)
    places = np.stack([np.interp(at, gone, column) for column in places.T], axis=1)
    if world.first_arm == 2:
        return places
    k = np.arange(LENGTH)
    ahead = places[np.minimum(k + TURN, LENGTH - 1)] - places[np.maximum(k - TURN, 0)]
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    heading[[0, -1]] = q_start[2], q_goal[2]
    return np.concatenate([places, heading[:, None]], axis=1)
