"""The spheres of a robot among obstacles: distances, and how far they vouch for an edge."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import Spheres, lever_arms, placement
from vrrt_jax.scene.obstacles import Obstacles, signed_distances

_ROUNDING = 0.999  # of spans: what single precision may round


@pytree
class WorldSpheres:
    """Spheres of a robot as worlds use them.

    Letters: ``n`` collision spheres, ``m`` self-collision spheres.
    """

    collision: jax.Array  # (L * 12, 3 n) their placement, see ``kinematics.placement``
    radius: jax.Array  # (n,) of these [m]
    self_collision: jax.Array  # (L * 12, 3 m) placement of the others
    contact_distance: jax.Array  # (m, m) at which two of them touch, 0 for unchecked pairs [m]
    # How far a collision sphere moves, and how much the distance of two self-collision spheres
    # changes, at most while one joint moves by one, see ``kinematics.lever_arms``.
    lever_arms: jax.Array  # (D, n) [m/rad] or [m/m]
    relative_lever_arms: jax.Array  # (D, m, m) the same units

    def clearances(self, obstacles: Obstacles, centers: jax.Array) -> jax.Array:
        """Distances (n,) of collision spheres at (3, n) to the nearest obstacle [m]."""
        return jnp.min(signed_distances(obstacles, centers), axis=1) - self.radius

    def squared_gaps(self, centers: jax.Array) -> jax.Array:
        """Squared distances less squared contact distances (m, m) [m^2] of spheres at (3, m)."""
        return _squared_distances(centers) - self.contact_distance**2

    def free_span(
        self,
        obstacles: Obstacles,
        margin: jax.Array,
        centers: tuple[jax.Array, jax.Array],
        edge: jax.Array,
    ) -> jax.Array:
        """How much of an edge is free for certain: distances divided by the spheres' speeds.

        Args:
            obstacles: K slots.
            margin: () asked of them [m].
            centers: (3, n) of collision spheres and (3, m) of self-collision spheres.
            edge: (D,) the straight way that the joints go.

        Returns:
            () the share of the edge that is free before and after; negative if something touches.
        """
        clearance = self.clearances(obstacles, centers[0]) - margin
        # Pairs that are not checked are infinitely far apart.
        apart = jnp.sqrt(_squared_distances(centers[1]) + 1e-12)
        gap = jnp.where(self.contact_distance > 0, apart - self.contact_distance, jnp.inf)
        speed, relative_speed = (
            jnp.tensordot(jnp.abs(edge), arms, 1) + 1e-9
            for arms in (self.lever_arms, self.relative_lever_arms)
        )
        span = jnp.minimum(
            jnp.min(clearance / speed), jnp.min(gap / relative_speed, initial=jnp.inf)
        )
        is_free = (jnp.min(clearance) > 0) & (jnp.min(gap, initial=jnp.inf) >= 0)
        return jnp.where(is_free, _ROUNDING * span, -1.0)

    def farther_apart(self, margin: float) -> "WorldSpheres":
        """The same spheres, which touch each other while ``margin`` [m] is still between them."""
        # A contact distance of zero marks a pair that is not checked, and must stay zero.
        wider = jnp.where(self.contact_distance > 0, self.contact_distance + margin, 0.0)
        return dataclasses.replace(self, contact_distance=wider)


def world_spheres(robot: Any) -> WorldSpheres:
    """The spheres of a robot from :func:`vrrt_jax.load_robot`."""
    radius = np.asarray(robot.self_collision_spheres.radius)
    first, second = np.asarray(robot.self_collision_pairs, int).reshape(-1, 2).T
    contact_distance = np.zeros((len(radius), len(radius)), np.float32)
    contact_distance[first, second] = radius[first] + radius[second]

    def arms(spheres: Spheres) -> np.ndarray:
        link, center = np.asarray(spheres.link), np.asarray(spheres.center)
        return lever_arms(robot.chain, link, center, robot.lower, robot.upper)

    def placed(spheres: Spheres) -> jax.Array:
        link, center = np.asarray(spheres.link), np.asarray(spheres.center)
        return jnp.asarray(placement(link, center, robot.chain.num_links))

    # Joints that carry both spheres of a pair leave their distance as it is.
    own = arms(robot.self_collision_spheres)
    first_arm, second_arm = own[:, :, None], own[:, None]
    is_between = (first_arm > 0) != (second_arm > 0)
    return WorldSpheres(
        collision=placed(robot.collision_spheres),
        radius=robot.collision_spheres.radius,
        self_collision=placed(robot.self_collision_spheres),
        contact_distance=jnp.asarray(contact_distance),
        lever_arms=jnp.asarray(arms(robot.collision_spheres), jnp.float32),
        relative_lever_arms=jnp.asarray(
            np.where(is_between, first_arm + second_arm, 0.0), jnp.float32
        ),
    )


def _squared_distances(centers: jax.Array) -> jax.Array:
    """Between all pairs (m, m) of points (3, m)."""
    x, y, z = ((axis[:, None] - axis[None]) ** 2 for axis in centers)
    return x + y + z
