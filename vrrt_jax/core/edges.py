"""Edges: how a robot goes from one configuration to another.

A world says what its edges are, so that the kernel serves straight lines, turning joints and curves
alike. An edge is a pytree of arrays that lead with the lanes; what is in it, only the world knows.
"""

from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.boxes import box_inside_limits, half_extents
from vrrt_jax.core.precision import single_precision

Edge = Any


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
