"""The spheres of a robot among obstacles: distances, and how far they vouch for an edge."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.types import pytree, static
from vrrt_jax.robots.kinematics import Spheres, lever_arms, place, placement
from vrrt_jax.scene.held import HeldObject, HeldSpheres, gripped_distances, together
from vrrt_jax.scene.narrow_phase import NarrowPhase, look_again, narrow_phase
from vrrt_jax.scene.obstacles import Obstacles, signed_distances
from vrrt_jax.scene.rows import least

_ROUNDING = 0.999  # of spans: what single precision may round


@pytree
class WorldSpheres:
    """Spheres of a robot as worlds use them; those of what it holds are the last of both sets.

    Letters: ``n`` collision spheres, ``m`` self-collision spheres.
    """

    collision: jax.Array  # (L * 4, n) their placement, see ``kinematics.placement``
    radius: jax.Array  # (n,) of these [m]
    # Spheres of a held object may always be as near to obstacles as where it was gripped.
    gripped_distance: jax.Array  # (K, n) of their centers there, infinite for all others [m]
    self_collision: jax.Array  # (L * 4, m) placement of the others
    # Of the first a and the last b of them, which contain all pairs to check.
    contact_distance: jax.Array  # (a, b) at which two of them touch, 0 for unchecked pairs [m]
    # How far a collision sphere moves, and how much the distance of two self-collision spheres
    # changes, at most while one joint moves by one, see ``kinematics.lever_arms``.
    lever_arms: jax.Array  # (D, n) [m/rad] or [m/m]
    relative_lever_arms: jax.Array  # (D, a, b) the same units
    self_margin: jax.Array  # () asked between links, in the contact distances too [m]
    num_held: tuple[int, int] = static(default=(0, 0))  # how many of n, and of m
    narrow_phase: NarrowPhase | None  # None: what the spheres say stands

    def clearances(
        self, obstacles: Obstacles, centers: jax.Array, margin: jax.Array | float = 0.0
    ) -> jax.Array:
        """Distances (n,) of collision spheres at (3, n), larger by a margin, to obstacles [m]."""
        return least(signed_distances(obstacles, centers) - self.needed(margin))

    def needed(self, margin: jax.Array | float) -> jax.Array:
        """At which distances (K, n) of their centers collision spheres touch obstacles [m]."""
        return jnp.minimum(self.radius + margin, self.gripped_distance)

    def are_free(self, obstacles: Obstacles, margin: jax.Array, poses: jax.Array) -> jax.Array:
        """Whether all spheres touch nothing, () bool, on links posed by (L, 4, 4).

        Behind the barrier they are placed once, and not again for every obstacle.
        """
        outer, inner = jax.lax.optimization_barrier(
            (place(self.collision, poses), place(self.self_collision, poses))
        )
        clearance = self.clearances(obstacles, outer, margin)
        if self.narrow_phase is None:
            # A robot of few links may have no pair to check: then nothing can touch.
            return jnp.all(clearance > 0) & jnp.all(least(self.squared_gaps(inner)) >= 0)
        gaps, edge = self.gaps(inner), jnp.zeros(self.lever_arms.shape[:1], poses.dtype)
        span = jnp.where(_are_apart(clearance, gaps), 0.0, -1.0)
        return self.look_again(obstacles, margin, poses, edge, clearance, gaps, span)[0] >= 0

    def smallest_clearance(self, obstacles: Obstacles, poses: jax.Array) -> jax.Array:
        """Of all collision spheres, or polytopes where these touch, () [m]; links at (L, 4, 4)."""
        clearance = self.clearances(obstacles, place(self.collision, poses))
        edge = jnp.zeros(self.lever_arms.shape[:1], poses.dtype)
        is_free = jnp.all(clearance > 0)
        span = jnp.where(is_free, 0.0, -1.0)
        gaps = jnp.full(self.contact_distance.shape, jnp.inf)
        margin = jnp.float32(0.0)
        again = self.look_again(obstacles, margin, poses, edge, clearance, gaps, span)[1]
        return jnp.where(is_free, jnp.min(clearance), again)

    def squared_gaps(self, centers: jax.Array) -> jax.Array:
        """Squared distances less squared contact distances (a, b) [m^2] of spheres at (3, m)."""
        return self._squared_distances(centers) - self.contact_distance**2

    def _squared_distances(self, centers: jax.Array) -> jax.Array:
        """Between the first a and the last b of points (3, m), (a, b) [m^2]."""
        a, b = self.contact_distance.shape
        x, y, z = centers[:, :a, None] - centers[:, None, centers.shape[1] - b :]
        return x**2 + y**2 + z**2

    def gaps(self, centers: jax.Array) -> jax.Array:
        """Distances (a, b) of self-collision spheres at (3, m) [m], infinite if not checked."""
        apart = jnp.sqrt(self._squared_distances(centers) + 1e-12)
        return jnp.where(self.contact_distance > 0, apart - self.contact_distance, jnp.inf)

    def free_span(self, clearance: jax.Array, gaps: jax.Array, edge: jax.Array) -> jax.Array:
        """How much of an edge is free for certain: distances divided by the spheres' speeds.

        Args:
            clearance: (n,) of collision spheres to obstacles, see :meth:`clearances`.
            gaps: (a, b) of self-collision spheres, see :meth:`gaps`.
            edge: (D,) the straight way that the joints go.

        Returns:
            () the share of the edge that is free before and after; negative if something touches.
        """
        speed, relative_speed = (
            jnp.tensordot(jnp.abs(edge), arms, 1) + 1e-9
            for arms in (self.lever_arms, self.relative_lever_arms)
        )
        span = jnp.minimum(
            jnp.min(clearance / speed), jnp.min(gaps / relative_speed, initial=jnp.inf)
        )
        return jnp.where(_are_apart(clearance, gaps), _ROUNDING * span, -1.0)

    def look_again(
        self,
        obstacles: Obstacles,
        margin: jax.Array,
        poses: jax.Array,
        edge: jax.Array,
        clearance: jax.Array,
        gaps: jax.Array,
        span: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """The narrow phase, where spheres touch but not for certain what they cover.

        Args:
            obstacles: K of them.
            margin: () asked of obstacles [m].
            poses: (L, 4, 4) of links.
            edge: (D,) the straight way that the joints go.
            clearance: (n,) of collision spheres, see :meth:`clearances`.
            gaps: (a, b) of self-collision spheres, see :meth:`gaps`.
            span: () what :meth:`free_span` says.

        Returns:
            () the span, and () the least distance to obstacles [m], both of polytopes where
            spheres touch.
        """
        nearest = jnp.min(clearance)
        if self.narrow_phase is None:
            return span, nearest
        in_doubt = (span < 0) & self.narrow_phase.is_in_doubt(clearance, gaps)
        common = jax.lax.stop_gradient((self, obstacles, margin))
        rows = jax.lax.stop_gradient((poses, edge, span, nearest, in_doubt))
        span, nearest = look_again(common, jax.tree.map(lambda leaf: leaf[None], rows))
        return span[0], nearest[0]

    def with_narrow_phase(self, phase: NarrowPhase | None) -> "WorldSpheres":
        """The same spheres with another narrow phase, or none: its slack is in the distances."""
        old, new = (0.0 if p is None else p.slack for p in (self.narrow_phase, phase))
        distance = self.contact_distance
        distance = jnp.where(distance > 0, distance - old + new, 0.0)
        return dataclasses.replace(self, narrow_phase=phase, contact_distance=distance)

    def farther_apart(self, margin: float | jax.Array) -> "WorldSpheres":
        """The same spheres, which touch each other while ``margin`` [m] is still between them."""
        # A contact distance of zero marks a pair that is not checked, and must stay zero.
        wider = jnp.where(self.contact_distance > 0, self.contact_distance + margin, 0.0)
        self_margin = self.self_margin + margin
        return dataclasses.replace(self, contact_distance=wider, self_margin=self_margin)

    def among(self, attached: Sequence[HeldObject], names: Sequence[str]) -> "WorldSpheres":
        """The same spheres, of which some are of held objects, among obstacles of these names."""
        num_slots = self.gripped_distance.shape[0]
        held = gripped_distances(attached, [*names, *[""] * (num_slots - len(names))])
        distance = np.full(self.gripped_distance.shape, np.inf, np.float32)
        distance[:, distance.shape[1] - len(held) :] = held.T
        return dataclasses.replace(self, gripped_distance=jnp.asarray(distance))

    def held_clearances(
        self, obstacles: Obstacles, margin: jax.Array, poses: jax.Array
    ) -> jax.Array:
        """:meth:`clearances` (h,) of what the robot holds alone, at link poses (L, 4, 4)."""
        first = len(self.radius) - self.num_held[0]
        centers = place(self.collision[:, first:], poses)
        return least(signed_distances(obstacles, centers) - self.needed(margin)[:, first:])

    def held_are_apart(self, inner: jax.Array) -> jax.Array:
        """Whether what is held touches no link, () bool; self-collision spheres at (3, m)."""
        return jnp.all(self.squared_gaps(inner)[:, -self.num_held[1] :] >= 0)


def _are_apart(clearance: jax.Array, gaps: jax.Array) -> jax.Array:
    """Whether nothing touches, () bool; a robot of few links may have no gap to check.

    Of the many gaps XLA's CPU backend finds the minimum sooner than ``all`` of what is compared,
    but where it fuses that, it may overlook what is not a number.
    """
    return jnp.all(clearance > 0) & (jnp.min(gaps, initial=jnp.inf) >= 0)


def world_spheres(
    robot: Any, names: Sequence[str], attached: Sequence[HeldObject] = ()
) -> WorldSpheres:
    """The spheres of a robot and of what it holds.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        names: (K,) of the obstacles in their slots, '' where they are empty.
        attached: what the robot holds.
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
    # Rows before the last and columns after the first that have a pair to check.
    is_checked = contact_distance > 0
    num_rows = np.flatnonzero(is_checked.any(axis=1)).max(initial=-1) + 1
    begin = np.flatnonzero(is_checked.any(axis=0)).min(initial=len(radius))
    # Joints that carry both spheres of a pair leave their distance as it is.
    own = lever_arms(robot.chain, link, center, robot.lower, robot.upper)
    first_arm, second_arm = own[:, :num_rows, None], own[:, None, begin:]
    is_between = (first_arm > 0) != (second_arm > 0)
    outer = together(attached, with_corners=True)
    collision = _joined(robot.collision_spheres, outer)
    spheres = WorldSpheres(
        collision=jnp.asarray(placement(*collision[:2], robot.chain.num_links)),
        radius=jnp.asarray(collision[2]),
        gripped_distance=jnp.full((len(names), len(collision[2])), jnp.inf),
        self_collision=jnp.asarray(placement(link, center, robot.chain.num_links)),
        contact_distance=jnp.asarray(contact_distance[:num_rows, begin:]),
        lever_arms=jnp.asarray(
            lever_arms(robot.chain, *collision[:2], robot.lower, robot.upper), jnp.float32
        ),
        relative_lever_arms=jnp.asarray(
            np.where(is_between, first_arm + second_arm, 0.0), jnp.float32
        ),
        self_margin=jnp.float32(0.0),
        num_held=(len(outer.radius), len(held.radius)),
        narrow_phase=None,
    )
    looked_at = narrow_phase(robot, len(collision[2]), len(radius), num_rows, begin)
    spheres = spheres.with_narrow_phase(looked_at)
    return spheres.among(attached, names) if attached else spheres


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
