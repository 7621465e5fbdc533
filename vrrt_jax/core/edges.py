"""Edges: how a robot goes from one configuration to another, and how far it is free to.

A world says what its edges are, so that the kernel serves straight lines, turning joints and curves
alike. An edge is a pytree of arrays that lead with the lanes; what is in it, only the world knows.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.boxes import box_inside_limits, half_extents
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import pytree

Edge = Any

# Configurations that are checked at once, of all edges together: many where most edges will have to
# be followed, few where most will be given up.
CHECKS, FEW_CHECKS = 64, 32


class Space(Protocol):
    """What the kernel asks a world. Configurations are (..., D), edges lead with (...)."""

    @property
    def lower(self) -> jax.Array:
        """(D,) limits that samples keep."""
        ...

    @property
    def upper(self) -> jax.Array:
        """(D,) limits that samples keep."""
        ...

    @property
    def resolution(self) -> jax.Array:
        """() longest sub-step between two collision checks, in the units of distances."""
        ...

    node_block: ClassVar[int]  # how many nodes are best handed to :meth:`distances` at once

    def is_free(self, q: jax.Array) -> jax.Array:
        """Whether ``q`` (D,) touches nothing, () bool."""
        ...

    def free_span(self, q: jax.Array, edge: Edge) -> jax.Array:
        """How much of an edge is free around ``q`` (D,) for certain, () as a share of the edge.

        0 if only ``q`` is known to be free; negative if it is not.
        """
        ...

    def distance(self, q_a: jax.Array, q_b: jax.Array) -> jax.Array:
        """Length (...) of the edge between two configurations."""
        ...

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """Distances (B, N) from ``q`` (B, D) to ``nodes`` (N, D), +inf where ``among`` is False.

        A world with a costly metric may also answer +inf for nodes that are far.
        """
        ...

    def edge(self, q_from: jax.Array, q_to: jax.Array) -> Edge:
        """The shortest edge from one configuration to another."""
        ...

    def steer(self, q_from: jax.Array, target: jax.Array, num_steps: int) -> Edge:
        """The edge towards a target inside the limits, cut to what ``num_steps`` can check."""
        ...

    def span(self, edge: Edge) -> jax.Array:
        """How far (...) an edge goes, in the units of ``resolution``."""
        ...

    def is_resolved(self, edge: Edge, num_steps: int | jax.Array) -> jax.Array:
        """Whether (...) ``num_steps`` sub-steps are fine enough for an edge."""
        ...

    def truncate(self, edge: Edge, fraction: jax.Array) -> Edge:
        """The first fraction (...) of an edge."""
        ...

    def length(self, edge: Edge) -> jax.Array:
        """Length (...) of an edge."""
        ...

    def end(self, q_from: jax.Array, edge: Edge) -> jax.Array:
        """Where an edge leads to; wrapping joints may have passed pi."""
        ...

    def normalize(self, q: jax.Array) -> jax.Array:
        """The same configuration, wrapping joints in [-pi, pi)."""
        ...

    def informed_box(
        self, q_a: jax.Array, q_b: jax.Array, cost: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Bounds (D,) and (D,) of all ``q`` whose distances to two others sum up to ``cost``."""
        ...


class StraightLineEdges:
    """Straight edges, the short way round for joints that wrap; the edge is the step (..., D).

    For dataclasses with ``lower``, ``upper``, ``is_continuous`` (D,) and ``resolution`` ().
    """

    lower: jax.Array
    upper: jax.Array
    is_continuous: jax.Array
    resolution: jax.Array
    node_block: ClassVar[int] = 512

    def is_free(self, q: jax.Array) -> jax.Array:
        """See :class:`Space`; for worlds to answer."""
        raise NotImplementedError

    def free_span(self, q: jax.Array, edge: jax.Array) -> jax.Array:
        """See :class:`Space`; worlds that know distances can say more than this."""
        return jnp.where(self.is_free(q), 0.0, -1.0)

    def distance(self, q_a: jax.Array, q_b: jax.Array) -> jax.Array:
        """See :class:`Space`."""
        return self.length(self.edge(q_a, q_b))

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """See :class:`Space`."""
        # Joint by joint: XLA's CPU loops for a sum over the last, short axis are many times slower.
        squared = jnp.zeros((q.shape[0], nodes.shape[0]), q.dtype)
        for joint in range(q.shape[1]):
            squared += joint_steps(self, nodes, q, joint) ** 2
        return jnp.where(among, jnp.sqrt(squared), jnp.inf)

    def edge(self, q_from: jax.Array, q_to: jax.Array) -> jax.Array:
        """See :class:`Space`."""
        return difference(self, q_from, q_to)

    def steer(self, q_from: jax.Array, target: jax.Array, num_steps: int) -> jax.Array:
        """See :class:`Space`."""
        return steer(self, q_from, target, num_steps * self.resolution)

    def span(self, edge: jax.Array) -> jax.Array:
        """See :class:`Space`; the length of a straight edge."""
        return self.length(edge)

    def is_resolved(self, edge: jax.Array, num_steps: int | jax.Array) -> jax.Array:
        """See :class:`Space`."""
        return self.span(edge) <= num_steps * self.resolution

    def truncate(self, edge: jax.Array, fraction: jax.Array) -> jax.Array:
        """See :class:`Space`."""
        return edge * fraction[..., None]

    def length(self, edge: jax.Array) -> jax.Array:
        """See :class:`Space`."""
        return jnp.sqrt(jnp.sum(edge**2, axis=-1))

    def end(self, q_from: jax.Array, edge: jax.Array) -> jax.Array:
        """See :class:`Space`."""
        return q_from + edge

    def normalize(self, q: jax.Array) -> jax.Array:
        """See :class:`Space`."""
        return normalize(self, q)

    def informed_box(
        self, q_a: jax.Array, q_b: jax.Array, cost: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """See :class:`Space`; joints that wrap keep their whole range."""
        half = half_extents(jnp.where(self.is_continuous, 0.0, q_b - q_a), cost)
        return box_inside_limits(self, (q_a + q_b) / 2, half)


def joint_steps(space: StraightLineEdges, nodes: jax.Array, q: jax.Array, joint: int) -> jax.Array:
    """Steps (B, N) of one joint from ``q`` (B, D) to ``nodes`` (N, D)."""
    return short_way(nodes[:, joint] - q[:, joint, None], space.is_continuous[joint])


def short_way(step: jax.Array, is_continuous: jax.Array) -> jax.Array:
    """The same steps (...), of joints that wrap the short way round."""
    turns = jnp.where(is_continuous, jnp.round(step / (2 * jnp.pi)), 0.0)
    return step - 2 * jnp.pi * turns


@single_precision
def difference(world: StraightLineEdges, q_from: jax.Array, q_to: jax.Array) -> jax.Array:
    """The step (..., D) from one configuration to another, the short way round."""
    return short_way(q_to - q_from, world.is_continuous)


def steps_between(world: StraightLineEdges, q_from: np.ndarray, q_to: np.ndarray) -> np.ndarray:
    """Steps (..., D) from configurations to others, the short way round; on the host."""
    step = q_to - q_from
    return step - 2 * np.pi * np.round(step / (2 * np.pi)) * np.asarray(world.is_continuous)


def joint_error(world: StraightLineEdges, q: np.ndarray, q_goal: np.ndarray) -> np.ndarray:
    """Distance (D,) of each joint from a goal, the short way round [rad] or [m]; on the host."""
    return np.abs(np.asarray(difference(world, jnp.asarray(q), jnp.asarray(q_goal))))


def unwrapped(world: StraightLineEdges, path: np.ndarray) -> np.ndarray:
    """The path (P, D) from where it starts, with joints that wrap going on from there.

    A controller may interpolate it, also beyond a turn.
    """
    path, is_continuous = np.array(path), np.asarray(world.is_continuous)
    path[:, is_continuous] = np.unwrap(path[:, is_continuous], axis=0)
    return path


@single_precision
def distance(world: Space, q_a: jax.Array, q_b: jax.Array) -> jax.Array:
    """Length (...) of the edge between configurations (..., D)."""
    return world.distance(q_a, q_b)


def normalize(world: StraightLineEdges, q: jax.Array) -> jax.Array:
    """Bring wrapping joints of (..., D) back to [-pi, pi)."""
    turns = jnp.where(world.is_continuous, jnp.floor((q + jnp.pi) / (2 * jnp.pi)), 0.0)
    return q - 2 * jnp.pi * turns


def nearest_turn(world: StraightLineEdges, q: np.ndarray, q_near: np.ndarray) -> np.ndarray:
    """The same configurations (..., D), whole turns nearer to others (..., D); on the host."""
    turns = np.round((np.asarray(q_near, float) - q) / (2 * np.pi))
    return np.asarray(q + 2 * np.pi * turns * np.asarray(world.is_continuous), np.float32)


def enforce_bounds(world: StraightLineEdges, q: jax.Array) -> jax.Array:
    """The nearest configurations (..., D) inside the limits."""
    return jnp.where(
        world.is_continuous, normalize(world, q), jnp.clip(q, world.lower, world.upper)
    )


def steer(
    world: StraightLineEdges, q_from: jax.Array, target: jax.Array, max_length: jax.Array
) -> jax.Array:
    """The step (..., D) towards a target, inside the limits and no longer than ``max_length``.

    Limits clip each joint by itself, so that a step into a limit slides along it.
    """
    step = difference(world, q_from, target)
    inside = jnp.clip(q_from + step, world.lower, world.upper) - q_from
    step = jnp.where(world.is_continuous, step, inside)
    length = jnp.sqrt(jnp.sum(step**2, axis=-1, keepdims=True))
    return step * jnp.minimum(1.0, max_length / jnp.maximum(length, 1e-12))


def num_checks(world: Space, max_step: float) -> int:
    """How many sub-steps, each no longer than the world's resolution, an edge needs; on the host.

    Args:
        world: whose resolution it is.
        max_step: longest edge, in the units of the resolution.
    """
    return max(1, math.ceil(max_step / float(world.resolution) - 1e-3))


def free_prefix(
    world: Space,
    q_from: jax.Array,
    edge: Edge,
    num_steps: int,
    tried: jax.Array | bool = True,
    partial: jax.Array | bool = True,
) -> tuple[jax.Array, jax.Array]:
    """How far one can go along edges before something is touched.

    Args:
        world: what to collide with.
        q_from: (B, D) starts, taken to be free.
        edge: of B lanes.
        num_steps: S sub-steps along each edge, checked at their far ends.
        tried: (B,) bool, which edges count; the others are not checked.
        partial: (B,) bool, of which the free part matters. Of the others only whether they are free
            is asked: if they are not, the number is some number below S.

    Returns:
        (B,) i32 number of leading sub-steps that are free, S where the whole edge is; and () i32
        how many configurations were checked for that.
    """
    tried, partial = (jnp.reshape(mask, (-1, 1)) for mask in (tried, partial))

    def matters(checks: _Checks, step: jax.Array) -> jax.Array:
        return tried & (step < jnp.where(partial | (checks.first == num_steps), checks.first, 0))

    checks = _check(world, q_from, edge, num_steps, matters)
    return checks.first[:, 0], checks.checked


def is_edge_free(
    world: Space, q_from: jax.Array, edge: Edge, num_steps: int, tried: jax.Array | bool = True
) -> tuple[jax.Array, jax.Array]:
    """Whether (B,) nothing is touched along whole edges, and () i32 how many checks that took.

    An edge costs nothing more once something is found on it, and nothing at all if it is not
    ``tried`` (B,). See :func:`free_prefix`.
    """
    num_free, checked = free_prefix(world, q_from, edge, num_steps, tried, partial=False)
    return (num_free == num_steps) & tried, checked


def first_free_edge(
    world: Space, q_from: jax.Array, edge: Edge, num_steps: int, tried: jax.Array
) -> jax.Array:
    """The first of B edges along which nothing is touched, () i32; B if there is none.

    Edges after one that is known to be free cost nothing more.

    Args:
        world: what to collide with.
        q_from: (B, D) starts, taken to be free; the ends are too.
        edge: of B lanes, the most wanted first.
        num_steps: S sub-steps along each edge.
        tried: (B,) bool, which edges count.
    """
    lanes = q_from.shape[0]
    lane = jnp.arange(lanes)[:, None]

    def first_free(checks: _Checks) -> jax.Array:
        is_free = jnp.all(checks.known, axis=1) & (checks.first[:, 0] == num_steps) & tried
        return jnp.where(jnp.any(is_free), jnp.argmax(is_free), lanes)

    def matters(checks: _Checks, step: jax.Array) -> jax.Array:
        is_open = (checks.first == num_steps) & tried[:, None]
        return is_open & (lane < first_free(checks)) & (step < num_steps - 1)

    few = FEW_CHECKS
    checks = _check(world, q_from, edge, num_steps, matters, ends_known=True, batch=few)
    return first_free(checks)


@pytree
class _Checks:
    known: jax.Array  # (B, S) bool, checked or known to be free
    first: jax.Array  # (B, 1) i32 the first sub-step known to be blocked, S if none is
    checked: jax.Array  # () i32 configurations checked


def _check(
    world: Space,
    q_from: jax.Array,
    edge: Edge,
    num_steps: int,
    matters: Callable[[_Checks, jax.Array], jax.Array],
    ends_known: bool = False,
    batch: int = CHECKS,
) -> _Checks:
    """Check sub-steps of B edges until none that matters is left.

    Ends and middles come first: what is found there spares the checks between. A batch of checks is
    what is left of the coarsest levels, of all edges together.

    Args:
        world: what to collide with.
        q_from: (B, D).
        edge: of B lanes.
        num_steps: S.
        matters: of the checks so far and the indices (S,) of sub-steps, whether (B, S) a sub-step
            still has to be checked.
        ends_known: the ends are taken to be free.
        batch: sub-steps that are checked at once.
    """
    lanes, step = q_from.shape[0], jnp.arange(num_steps)
    order = jnp.asarray(_coarse_to_fine(num_steps))
    batch = min(batch, lanes * num_steps)

    def open_checks(checks: _Checks) -> jax.Array:
        """Which sub-steps have to be checked, (S * B,) the coarsest first."""
        needed = ~checks.known & matters(checks, step)
        return needed[:, order].T.reshape(-1)

    def check(checks: _Checks) -> _Checks:
        # The next batch: lanes and sub-steps.
        needed = open_checks(checks)
        chosen = jnp.flatnonzero(needed, size=batch, fill_value=lanes * num_steps)
        valid = chosen < lanes * num_steps
        lane = jnp.where(valid, chosen % lanes, 0)
        at = jnp.where(valid, order[jnp.where(valid, chosen // lanes, 0)], 0)
        # Their configurations, and how much of the edge is free around each.
        edges = jax.tree.map(lambda leaf: leaf[lane], edge)
        part = world.truncate(edges, (at + 1).astype(q_from.dtype) / num_steps)
        span = jax.vmap(world.free_span)(world.end(q_from[lane], part), edges)
        # Book what is blocked, and all sub-steps within the free spans.
        blocked = valid & ~(span >= 0)
        first = checks.first.at[jnp.where(blocked, lane, lanes), 0].min(at, mode="drop")
        reach = jnp.minimum(jnp.maximum(span, 0.0) * num_steps, num_steps).astype(jnp.int32)
        lane = jnp.where(valid, lane, lanes)
        change = jnp.zeros((lanes, num_steps + 1), jnp.int32)
        change = change.at[lane, jnp.maximum(at - reach, 0)].add(1, mode="drop")
        change = change.at[lane, jnp.minimum(at + reach, num_steps - 1) + 1].add(-1, mode="drop")
        covered = jnp.cumsum(change, axis=1)[:, :num_steps] > 0
        checked = checks.checked + jnp.sum(valid, dtype=jnp.int32)
        return _Checks(known=checks.known | covered, first=first, checked=checked)

    start = _Checks(
        known=jnp.broadcast_to(ends_known & (step == num_steps - 1), (lanes, num_steps)),
        first=jnp.full((lanes, 1), num_steps, jnp.int32),
        checked=jnp.int32(0),
    )
    return jax.lax.while_loop(lambda checks: jnp.any(open_checks(checks)), check, start)


def _coarse_to_fine(num: int) -> np.ndarray:
    """Indices 0 to num - 1, the last one first, then the middle, the quarters and so on."""
    order, gaps = [num - 1], [(-1, num - 1)]
    while gaps:
        low, high = gaps.pop(0)
        if high - low > 1:
            middle = (low + high) // 2
            order.append(middle)
            gaps += [(low, middle), (middle, high)]
    return np.array(order, np.int32)
