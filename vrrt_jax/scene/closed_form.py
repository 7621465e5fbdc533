"""The fast engine: distances of spheres to obstacles in closed form.

Distances are exact and smooth, whereas MJX's collision functions give only a sign for boxes and
cost many times as much; :mod:`vrrt_jax.scene.mjx` checks one against the other.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.types import TraceIgnoredNames, pytree
from vrrt_jax.robots.kinematics import Spheres, lever_arms, link_poses, place, placement
from vrrt_jax.scene.held import HeldObject, HeldSpheres, gripped_distances, together
from vrrt_jax.scene.obstacles import signed_distances
from vrrt_jax.scene.world import World

ROUNDING = 0.999  # of spans: what single precision may round


@pytree
class ClosedFormWorld(World):
    """A world whose robot is two sets of spheres, those of held objects among both.

    Letters: ``n`` collision spheres, ``m`` self-collision spheres.
    """

    collision_spheres: jax.Array  # (L * 12, 3 n) their placement, see ``kinematics.placement``
    collision_radius: jax.Array  # (n,) [m]
    # Spheres of a held object may always be as near to obstacles as where it was gripped.
    gripped_distance: jax.Array  # (n, K) of their centers there, infinite for all others [m]
    self_collision_spheres: jax.Array  # (L * 12, 3 m) placement of these
    contact_distance: jax.Array  # (m, m) at which two of them touch, 0 for unchecked pairs [m]
    self_margin: jax.Array  # () clearance asked of each other, part of the contact distance [m]
    # How far a collision sphere moves, and how much the distance of two self-collision spheres
    # changes, at most while one joint moves by one, see ``kinematics.lever_arms``.
    lever_arms: jax.Array  # (D, n) [m/rad] or [m/m]
    relative_lever_arms: jax.Array  # (D, m, m) the same units

    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.is_free`."""
        poses = link_poses(self.chain, q)
        is_clear = jnp.min(self._clearances(poses, self.margin)) > 0
        return is_clear & (self._self_gap(poses) >= 0)

    def free_span(self, q: jax.Array, edge: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`: distances divided by the speeds of the spheres.

        So whole pieces of an edge are free, not only the configurations that were looked at.
        """
        if overrides_is_free(self):
            return super().free_span(q, edge)
        poses = link_poses(self.chain, q)
        clearance = self._clearances(poses, self.margin)
        # Self-collision: pairs that are not checked are infinitely far apart.
        centers = place(self.self_collision_spheres, poses)
        apart = jnp.sqrt(sum((axis[:, None] - axis[None]) ** 2 for axis in centers) + 1e-12)
        gap = jnp.where(self.contact_distance > 0, apart - self.contact_distance, jnp.inf)
        speed, relative_speed = (
            jnp.tensordot(jnp.abs(edge), arms, 1) + 1e-9
            for arms in (self.lever_arms, self.relative_lever_arms)
        )
        span = jnp.minimum(
            jnp.min(clearance / speed), jnp.min(gap / relative_speed, initial=jnp.inf)
        )
        is_free = (jnp.min(clearance) > 0) & (jnp.min(gap, initial=jnp.inf) >= 0)
        return jnp.where(is_free, ROUNDING * span, -1.0)

    def obstacle_clearance(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.obstacle_clearance`."""
        return jnp.min(self._clearances(link_poses(self.chain, q), 0.0))

    def holding(self, attached: Sequence[HeldObject]) -> Self:
        """See :meth:`vrrt_jax.scene.world.World.holding`."""
        fields = sphere_fields(self.robot.value, attached, len(self.obstacles.rounding))
        world = dataclasses.replace(self, attached=TraceIgnoredNames(attached), **fields)
        world = dataclasses.replace(world.with_margin(float(self.self_margin)), margin=self.margin)
        return dataclasses.replace(world, **world.fields_of(self.obstacle_names))

    def fields_of(self, names: Sequence[str]) -> dict[str, Any]:
        """See :meth:`vrrt_jax.scene.world.World.fields_of`."""
        if not self.attached:
            return {}
        held = gripped_distances(self.attached, names)
        num_own = len(self.collision_radius) - len(held)
        distance = self.gripped_distance.at[num_own:, : len(names)].set(held)
        return {"gripped_distance": distance.at[:, len(names) :].set(jnp.inf)}

    def with_margin(self, margin: float) -> Self:
        """See :func:`vrrt_jax.scene.world.with_margin`."""
        # A contact distance of zero marks a pair that is not checked, and must stay zero.
        wider = jnp.where(self.contact_distance > 0, self.contact_distance + margin, 0.0)
        return dataclasses.replace(
            self,
            margin=self.margin + margin,
            self_margin=self.self_margin + margin,
            contact_distance=wider,
        )

    def _clearances(self, poses: jax.Array, margin: jax.Array | float) -> jax.Array:
        """Distances (n,) of the collision spheres, larger by a margin, to obstacles [m]."""
        distances = signed_distances(self.obstacles, place(self.collision_spheres, poses))
        radius = self.collision_radius[:, None] + margin
        return jnp.min(distances - jnp.minimum(radius, self.gripped_distance), axis=1)

    def _self_gap(self, poses: jax.Array) -> jax.Array:
        """Smallest difference () of squared distance and squared contact distance [m^2]."""
        centers = place(self.self_collision_spheres, poses)
        apart = sum((axis[:, None] - axis[None]) ** 2 for axis in centers)
        # A robot of few links may have no pair to check: then nothing can touch.
        return jnp.min(apart - self.contact_distance**2, initial=jnp.inf)


def closed_form_world(robot: Any, fields: Mapping[str, Any]) -> ClosedFormWorld:
    """Give a world its robot's spheres.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        fields: of :class:`vrrt_jax.scene.world.World`.
    """
    num_slots = len(fields["obstacles"].rounding)
    return ClosedFormWorld(**sphere_fields(robot, [], num_slots), **fields)


def sphere_fields(
    robot: Any, attached: Sequence[HeldObject], num_slots: int
) -> dict[str, jax.Array]:
    """The fields of :class:`ClosedFormWorld` beside those of a world.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        attached: what it holds; spheres of these come after its own.
        num_slots: K.
    """
    # A held object is checked against all other links, and against what these hold.
    first, second = np.asarray(robot.self_collision_pairs, int).reshape(-1, 2).T
    held = together(attached, with_corners=False)
    alone = [_without_others(robot)] if attached else []
    link, center, radius = _joined(robot.self_collision_spheres, *alone, held)
    contact_distance = np.zeros((len(radius), len(radius)), np.float32)
    contact_distance[first, second] = radius[first] + radius[second]
    num_own = len(radius) - len(held.radius)
    is_other = np.triu(link[:, None] != link[num_own:], 1 - num_own)
    contact_distance[:, num_own:] = is_other * (radius[:, None] + radius[num_own:])
    # Only joints between two spheres change their distance: those that carry just one of them.
    own = lever_arms(robot.chain, link, center, robot.lower, robot.upper)
    relative = np.where(own[:, :, None] > 0, own[:, :, None], own[:, None])
    relative[(own[:, :, None] > 0) & (own[:, None] > 0)] = 0.0
    self_collision_spheres = placement(link, center, robot.chain.num_links)

    held = together(attached, with_corners=True)
    link, center, radius = _joined(robot.collision_spheres, held)
    fields = {
        "collision_spheres": placement(link, center, robot.chain.num_links),
        "collision_radius": radius,
        "gripped_distance": np.full((len(radius), num_slots), np.inf),
        "self_collision_spheres": self_collision_spheres,
        "contact_distance": contact_distance,
        "self_margin": 0.0,
        "lever_arms": lever_arms(robot.chain, link, center, robot.lower, robot.upper),
        "relative_lever_arms": relative,
    }
    return {name: jnp.asarray(value, jnp.float32) for name, value in fields.items()}


def _without_others(robot: Any) -> HeldSpheres:
    """Collision spheres of links that have no self-collision spheres.

    These links touch no other ones, but what is held may touch them.
    """
    spheres = robot.collision_spheres
    link, center, radius = (np.asarray(x) for x in (spheres.link, spheres.center, spheres.radius))
    is_alone = ~np.isin(link, np.asarray(robot.self_collision_spheres.link))
    return HeldSpheres(link=link[is_alone], center=center[is_alone], radius=radius[is_alone])


def _joined(*parts: Spheres | HeldSpheres) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Links (n,), centers (n, 3) and radii (n,) of several sets of spheres, in single precision."""
    return (
        np.concatenate([np.asarray(part.link) for part in parts]),
        np.concatenate([np.asarray(part.center, np.float32) for part in parts]),
        np.concatenate([np.asarray(part.radius, np.float32) for part in parts]),
    )
