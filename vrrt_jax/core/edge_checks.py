"""Checks of edges: how far a robot is free to go along them, with as few checks as that takes.

All edges of a batch are checked together, from coarse to fine, until nothing is left to be asked.
Letters: ``B`` lanes, ``S`` sub-steps, ``D`` joints.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.edges import Edge, Space
from vrrt_jax.core.types import pytree

# Configurations that are checked at once, of all edges together: many where most edges will have to
# be followed, few where most will be given up.
CHECKS, FEW_CHECKS = 64, 32


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
    slack: int = 0,
) -> tuple[jax.Array, jax.Array]:
    """How far one can go along edges before something is touched.

    Args:
        world: what to collide with.
        q_from: (B, D) starts, taken to be free.
        edge: of B lanes.
        num_steps: S sub-steps along each edge, checked at their far ends. Where they are finer than
            the world's resolution asks, only every second, third, ... of them is checked.
        tried: (B,) bool, which edges count; the others are not checked.
        partial: (B,) bool, of which the free part matters. Of the others only whether they are free
            is asked: if they are not, the number is some number below S.
        slack: the number may be up to so many below the true one. Next to what is touched distances
            vouch for little, so that the last sub-steps cost most.

    Returns:
        (B,) i32 number of leading sub-steps that are free, S where the whole edge is; and () i32
        how many configurations were checked for that.
    """

    def matters(checks: _Checks, step: jax.Array) -> jax.Array:
        before = jnp.where(partial, checks.first - slack, 0)
        return tried & (step < jnp.where(checks.first == num_steps, num_steps, before))

    checks = _check(world, q_from, edge, num_steps, matters)
    # Sub-steps between the last free check and the first blocked one may be either.
    vouched = jnp.maximum(checks.first - slack, 0) // checks.stride * checks.stride
    return jnp.where(checks.first == num_steps, num_steps, vouched), checks.checked


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
) -> tuple[jax.Array, jax.Array]:
    """The first of B edges along which nothing is touched, () i32; B if there is none.

    Edges after one that is known to be free cost nothing more. Also returned is () i32 how many
    configurations were checked. See :func:`free_prefix`.

    Args:
        world: what to collide with.
        q_from: (B, D) starts, taken to be free; the ends are too.
        edge: of B lanes, the most wanted first.
        num_steps: S sub-steps along each edge.
        tried: (B,) bool, which edges count.
    """
    lanes = q_from.shape[0]

    def first_free(checks: _Checks) -> jax.Array:
        is_free = jnp.all(checks.known, axis=0) & (checks.first == num_steps) & tried
        return jnp.where(jnp.any(is_free), jnp.argmax(is_free), lanes)

    def matters(checks: _Checks, step: jax.Array) -> jax.Array:
        is_open = (checks.first == num_steps) & tried
        return is_open & (jnp.arange(lanes) < first_free(checks))

    few = FEW_CHECKS
    checks = _check(world, q_from, edge, num_steps, matters, ends_known=True, batch=few)
    return first_free(checks), checks.checked


@pytree
class _Checks:
    # (S, B) bool, the coarsest sub-steps first: checked, known to be free, or not to be checked
    known: jax.Array
    stride: jax.Array  # (B,) i32 every so many sub-steps one is checked
    first: jax.Array  # (B,) i32 the first sub-step known to be blocked, S if none is
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
        matters: of the checks so far and the indices (S, 1) of sub-steps, whether a sub-step still
            has to be checked, (S, B) or alike for all sub-steps of an edge (B,).
        ends_known: the ends are taken to be free.
        batch: sub-steps that are checked at once.
    """
    lanes, step = q_from.shape[0], jnp.asarray(_coarse_to_fine(num_steps))[:, None]
    batch = min(batch, lanes * num_steps)

    def with_open(checks: _Checks) -> tuple[_Checks, jax.Array]:
        """The checks so far, and which sub-steps have to be checked, (S * B,)."""
        return checks, (~checks.known & matters(checks, step)).reshape(-1)

    def check(state: tuple[_Checks, jax.Array]) -> tuple[_Checks, jax.Array]:
        checks, is_open = state
        # The next batch: lanes and sub-steps.
        chosen = jnp.flatnonzero(is_open, size=batch, fill_value=lanes * num_steps)
        valid = chosen < lanes * num_steps
        chosen = jnp.where(valid, chosen, 0)
        lane, at = chosen % lanes, step[chosen // lanes, 0]
        # Their configurations, and how much of the edge is free around each.
        edges = jax.tree.map(lambda leaf: leaf[lane], edge)
        part = world.truncate(edges, (at + 1).astype(q_from.dtype) / num_steps)
        span = jax.vmap(world.free_span)(world.end(q_from[lane], part), edges)
        # Book what is blocked, and all sub-steps within the free spans, by a product of matrices:
        # scatters and sums along the edges take longer on a CPU.
        blocked = valid & ~(span >= 0)
        first = checks.first.at[jnp.where(blocked, lane, lanes)].min(at, mode="drop")
        reach = jnp.minimum(jnp.maximum(span, 0.0) * num_steps, num_steps).astype(jnp.int32)
        in_reach = jnp.abs(step - at) <= reach  # (S, batch)
        of_lane = valid[:, None] & (lane[:, None] == jnp.arange(lanes))  # (batch, B)
        covered = in_reach.astype(jnp.float32) @ of_lane.astype(jnp.float32) > 0
        return with_open(
            _Checks(
                known=checks.known | covered,
                stride=checks.stride,
                first=first,
                checked=checks.checked + jnp.sum(valid, dtype=jnp.int32),
            )
        )

    stride, is_end = _strides(world, edge, num_steps), step == num_steps - 1
    start = _Checks(
        known=jnp.where(is_end, ends_known, (step + 1) % stride > 0),
        stride=stride,
        first=jnp.full(lanes, num_steps, jnp.int32),
        checked=jnp.int32(0),
    )
    return jax.lax.while_loop(lambda state: jnp.any(state[1]), check, with_open(start))[0]


def _strides(world: Space, edge: Edge, num_steps: int) -> jax.Array:
    """How many of an edge's sub-steps (B,) i32 are together as long as the world's resolution."""
    longest = num_steps * world.resolution * (1 + 1e-5)  # rounding must not halve a stride
    stride = jnp.floor(longest / jnp.maximum(world.span(edge), 1e-9))
    # An edge that is not finite, or too long to be resolved, is checked at every sub-step.
    return jnp.where(stride >= 1, jnp.minimum(stride, num_steps), 1).astype(jnp.int32)


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
