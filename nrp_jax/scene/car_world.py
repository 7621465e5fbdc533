"""A base that drives like a car: edges are Reeds-Shepp curves, while the arm goes straight."""

from typing import ClassVar

import jax
import jax.numpy as jnp

from nrp_jax.scene import reeds_shepp
from nrp_jax.scene.grid_world import GridWorld, norm
from vrrt_jax.core.edges import StraightLineEdges, joint_steps
from vrrt_jax.core.types import pytree

SHORTLIST = 16  # nodes for which the length of a curve is computed


@pytree
class CarEdge:
    """A drive of the base, while the arm goes straight."""

    curve: reeds_shepp.Curve
    arm: jax.Array  # (..., D - 3) step
    target: jax.Array  # (..., D) where the whole edge leads
    done: jax.Array  # (...) 1 while nothing has been cut off


@pytree
class CarWorld(GridWorld):
    """The same with a base that turns and drives like a car, forwards and in reverse."""

    radius: jax.Array  # () smallest turning radius [m]
    node_block: ClassVar[int] = 1 << 20  # one shortlist for all nodes
    first_arm: ClassVar[int] = 3

    def distance(self, q_a: jax.Array, q_b: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        drive = reeds_shepp.length(q_a[..., :3], q_b[..., :3], self.radius)
        arm = StraightLineEdges.edge(self, q_a, q_b)[..., 3:]
        return drive + self.arm_weight * norm(arm)

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`; +inf beyond a shortlist of nearest nodes.

        The shortlist goes by a bound: no drive is shorter than the straight line, nor than its turn
        at the smallest radius. The nearest is nearly always in it.
        """
        # Bounds for all nodes, joint by joint: a straight line, or a turn on the smallest circle.
        line, arm = jnp.zeros((2, q.shape[0], nodes.shape[0]), q.dtype)
        for joint in range(q.shape[1]):
            step = joint_steps(self, nodes, q, joint)
            if joint == 2:
                turn = self.radius * jnp.abs(step)
                continue
            line, arm = (line + step**2, arm) if joint < 2 else (line, arm + step**2)
        bound = jnp.maximum(jnp.sqrt(line), turn) + self.arm_weight * jnp.sqrt(arm)
        bound = jnp.where(among, bound, jnp.inf)
        # Exact lengths for the shortlist only: a curve costs far more than a bound.
        nearest, index = _shortlist(bound)
        exact = self.distance(q[:, None], nodes[index])
        exact = jnp.where(jnp.isfinite(nearest), exact, jnp.inf)
        row = jnp.arange(q.shape[0])[:, None]
        return jnp.full(bound.shape, jnp.inf, q.dtype).at[row, index].set(exact)

    def edge(self, q_from: jax.Array, q_to: jax.Array) -> CarEdge:
        """See :class:`vrrt_jax.core.edges.Space`."""
        step = StraightLineEdges.edge(self, q_from, q_to)
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
        return self._drive(edge) + self.arm_weight * norm(edge.arm)

    def span(self, edge: CarEdge) -> jax.Array:
        """The longest distance (...) that any joint moves, the base with its turns [m] or [rad]."""
        base = reeds_shepp.extent(edge.curve, self.radius)
        return jnp.maximum(base, jnp.max(jnp.abs(edge.arm), axis=-1))

    def end(self, q_from: jax.Array, edge: CarEdge) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`; the whole edge ends at its target exactly."""
        base = reeds_shepp.follow(q_from[..., :3], edge.curve, self.radius)
        q = jnp.concatenate([base, q_from[..., 3:] + edge.arm], axis=-1)
        return jnp.where((edge.done >= 1)[..., None], edge.target, q)

    def _drive(self, edge: CarEdge) -> jax.Array:
        return reeds_shepp.curve_length(edge.curve) * self.radius


def _shortlist(bound: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Smallest bounds (B, k) of (B, N) and where they are."""
    smallest, index = jax.lax.top_k(-bound, min(SHORTLIST, bound.shape[1]))
    return -smallest, index
