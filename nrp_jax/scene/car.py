"""Edges of a base that drives like a car: Reeds-Shepp curves, while the arm moves straight."""

import jax
import jax.numpy as jnp

from nrp_jax.scene import reeds_shepp
from vrrt_jax.core.edges import StraightLineEdges, difference, joint_steps
from vrrt_jax.core.types import pytree

SHORTLIST = 16  # nodes of a lane to which the length of a curve is computed


@pytree
class CarEdge:
    """A drive of the base, while the arm goes straight."""

    curve: reeds_shepp.Curve
    arm: jax.Array  # (..., D - 3) step of the arm's joints
    target: jax.Array  # (..., D) where the whole edge leads
    done: jax.Array  # (...) share of the edge that is left after truncation, 1 for the whole edge


class CarEdges(StraightLineEdges):
    """The part of a world that knows car edges; see :class:`vrrt_jax.core.edges.Space`.

    The first three joints are x, y [m] and heading [rad] of the base. For dataclasses with the
    fields below; mixed in before :class:`nrp_jax.scene.world.GridWorld`.
    """

    arm_weight: jax.Array  # () meters that a radian of the arm counts for
    radius: jax.Array  # () smallest turning radius [m]

    def distance(self, q_a: jax.Array, q_b: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        drive = reeds_shepp.length(q_a[..., :3], q_b[..., :3], self.radius)
        arm = difference(self, q_a, q_b)[..., 3:]
        return drive + self.arm_weight * norm(arm)

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`; +inf beyond a shortlist of nearest nodes.

        The shortlist is ordered by a lower bound: no drive is shorter than the straight line, nor
        than its turn at the smallest radius. The nearest node is nearly always on the shortlist.
        """
        # The lower bound, joint by joint as in StraightLineEdges.
        line, arm = jnp.zeros((2, q.shape[0], nodes.shape[0]), q.dtype)
        for joint in range(q.shape[1]):
            step = joint_steps(self, nodes, q, joint)
            if joint == 2:
                turn = self.radius * jnp.abs(step)
                continue
            line, arm = (line + step**2, arm) if joint < 2 else (line, arm + step**2)
        bound = jnp.maximum(jnp.sqrt(line), turn) + self.arm_weight * jnp.sqrt(arm)
        bound = jnp.where(among, bound, jnp.inf)
        # The exact distance to the nodes on the shortlist.
        nearest, index = _shortlist(bound)
        exact = self.distance(q[:, None], nodes[index])
        exact = jnp.where(jnp.isfinite(nearest), exact, jnp.inf)
        row = jnp.arange(q.shape[0])[:, None]
        return jnp.full(bound.shape, jnp.inf, q.dtype).at[row, index].set(exact)

    def edge(self, q_from: jax.Array, q_to: jax.Array) -> CarEdge:
        """See :class:`vrrt_jax.core.edges.Space`."""
        step = difference(self, q_from, q_to)
        return CarEdge(
            curve=reeds_shepp.shortest(q_from[..., :3], q_to[..., :3], self.radius),
            arm=step[..., 3:],
            target=jnp.broadcast_to(q_to, step.shape),
            done=jnp.ones(step.shape[:-1], step.dtype),
        )

    def truncate(self, edge: CarEdge, fraction: jax.Array) -> CarEdge:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return CarEdge(
            curve=reeds_shepp.truncate(edge.curve, fraction, self.radius),
            arm=edge.arm * fraction[..., None],
            target=edge.target,
            done=edge.done * fraction,
        )

    def length(self, edge: CarEdge) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        drive = reeds_shepp.curve_length(edge.curve) * self.radius
        return drive + self.arm_weight * norm(edge.arm)

    def span(self, edge: CarEdge) -> jax.Array:
        """The largest step (...) along an edge: of the base, turns included, or of any joint.

        In [m] or [rad].
        """
        base = reeds_shepp.extent(edge.curve, self.radius)
        return jnp.maximum(base, jnp.max(jnp.abs(edge.arm), axis=-1))

    def end(self, q_from: jax.Array, edge: CarEdge) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`; the whole edge ends at its target exactly."""
        base = reeds_shepp.follow(q_from[..., :3], edge.curve, self.radius)
        q = jnp.concatenate([base, q_from[..., 3:] + edge.arm], axis=-1)
        return jnp.where((edge.done >= 1)[..., None], edge.target, q)


def norm(step: jax.Array) -> jax.Array:
    """Lengths (...) of steps (..., k)."""
    return jnp.sqrt(jnp.sum(step**2, axis=-1))


def _shortlist(bound: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The smallest bounds (B, k) of (B, N), and their indices."""
    smallest, index = jax.lax.top_k(-bound, min(SHORTLIST, bound.shape[1]))
    return -smallest, index
