"""The fast engine: distances of spheres to obstacles in closed form, exact and smooth.

It agrees with :mod:`vrrt_jax.scene.mjx`, the default engine.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import jax

from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import TraceIgnoredNames, pytree
from vrrt_jax.robots.kinematics import link_poses, place
from vrrt_jax.scene.held import HeldObject
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.spheres import WorldSpheres, world_spheres
from vrrt_jax.scene.world import World


@pytree
class ClosedFormWorld(World):
    """A world whose robot is two sets of spheres."""

    engine: ClassVar[str] = "closed_form"

    spheres: WorldSpheres

    @single_precision
    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.is_free`."""
        return self.spheres.are_free(self.obstacles, self.margin, link_poses(self.chain, q))

    def free_span(self, q: jax.Array, edge: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`: distances divided by the speeds of the spheres.

        So whole pieces of an edge are free, not only the configurations that were looked at.
        """
        if overrides_is_free(self):
            return super().free_span(q, edge)
        poses, spheres = link_poses(self.chain, q), self.spheres
        # Behind a barrier the centers are computed once, and not again for every obstacle.
        outer, inner = jax.lax.optimization_barrier(
            (place(spheres.collision, poses), place(spheres.self_collision, poses))
        )
        clearance = spheres.clearances(self.obstacles, outer, self.margin)
        gaps = spheres.gaps(inner)
        span = spheres.free_span(clearance, gaps, edge)
        found = spheres.look_again(self.obstacles, self.margin, poses, edge, clearance, gaps, span)
        return found[0]

    @single_precision
    def obstacle_clearance(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.obstacle_clearance`."""
        return self.spheres.smallest_clearance(self.obstacles, link_poses(self.chain, q))

    def holding(self, attached: Sequence[HeldObject]) -> Self:
        """See :meth:`vrrt_jax.scene.world.World.holding`."""
        spheres = world_spheres(self.robot.value, self.obstacle_names, attached)
        return dataclasses.replace(
            self,
            attached=TraceIgnoredNames(attached),
            spheres=spheres.farther_apart(float(self.spheres.self_margin)),
        )

    def fields_of(self, obstacles: Sequence[Obstacle]) -> dict[str, Any]:
        """See :meth:`vrrt_jax.scene.world.World.fields_of`."""
        if not self.attached:
            return {}
        return {"spheres": self.spheres.among(self.attached, [o.name for o in obstacles])}

    def by_spheres_alone(self) -> Self:
        """See :meth:`vrrt_jax.scene.world.World.by_spheres_alone`."""
        return dataclasses.replace(self, spheres=self.spheres.with_narrow_phase(None))

    def with_margin(self, margin: float | jax.Array) -> Self:
        """See :func:`vrrt_jax.scene.world.with_margin`."""
        spheres = self.spheres.farther_apart(margin)
        return dataclasses.replace(self, margin=self.margin + margin, spheres=spheres)


def closed_form_world(robot: Any, fields: Mapping[str, Any]) -> ClosedFormWorld:
    """Give a world its robot's spheres.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        fields: of :class:`vrrt_jax.scene.world.World`.
    """
    return ClosedFormWorld(spheres=world_spheres(robot, fields["obstacle_names"]), **fields)
