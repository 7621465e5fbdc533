"""The fast engine: distances of spheres to obstacles in closed form, exact and smooth.

It agrees with :mod:`vrrt_jax.scene.mjx`, the default engine.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import Spheres, link_poses, place, placement
from vrrt_jax.scene.obstacles import Obstacles, signed_distances
from vrrt_jax.scene.world import World


@pytree
class ClosedFormWorld(World):
    """A world whose robot is two sets of spheres.

    Letters: ``n`` collision spheres, ``m`` self-collision spheres.
    """

    engine: ClassVar[str] = "closed_form"

    collision_spheres: jax.Array  # (L * 12, 3 n) their placement, see ``kinematics.placement``
    collision_radius: jax.Array  # (n,) [m]
    self_collision_spheres: jax.Array  # (L * 12, 3 m) placement of these
    contact_distance: jax.Array  # (m, m) at which two of them touch, 0 for unchecked pairs [m]

    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.is_free`."""
        poses = link_poses(self.chain, q)
        return (obstacle_distances(self, poses) > self.margin) & (self._self_gap(poses) >= 0)

    def obstacle_clearance(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.obstacle_clearance`."""
        return obstacle_distances(self, link_poses(self.chain, q))

    def with_margin(self, margin: float) -> Self:
        """See :func:`vrrt_jax.scene.world.with_margin`."""
        # A contact distance of zero marks a pair that is not checked, and must stay zero.
        wider = jnp.where(self.contact_distance > 0, self.contact_distance + margin, 0.0)
        return dataclasses.replace(self, margin=self.margin + margin, contact_distance=wider)

    def _self_gap(self, poses: jax.Array) -> jax.Array:
        """Smallest difference () of squared distance and squared contact distance [m^2]."""
        centers = place(self.self_collision_spheres, poses)
        apart = sum((axis[:, None] - axis[None]) ** 2 for axis in centers)
        # A robot of few links may have no pair to check: then nothing can touch.
        return jnp.min(apart - self.contact_distance**2, initial=jnp.inf)


class HasCollisionSpheres(Protocol):
    """A world that knows where its robot's ``n`` collision spheres are."""

    @property
    def obstacles(self) -> Obstacles:
        """K slots."""
        ...

    @property
    def collision_spheres(self) -> jax.Array:
        """(L * 12, 3 n) placement of the spheres."""
        ...

    @property
    def collision_radius(self) -> jax.Array:
        """(n,) radii [m]."""
        ...


def obstacle_distances(world: HasCollisionSpheres, poses: jax.Array) -> jax.Array:
    """Smallest distance () of collision spheres on links posed by (L, 4, 4) to obstacles [m]."""
    distances = signed_distances(world.obstacles, place(world.collision_spheres, poses))
    return jnp.min(distances - world.collision_radius[:, None])


def placed(robot: Any, spheres: Spheres) -> jax.Array:
    """The placement (L * 12, 3 n) of spheres of a robot, see ``kinematics.placement``."""
    link, center = np.asarray(spheres.link), np.asarray(spheres.center)
    return jnp.asarray(placement(link, center, robot.chain.num_links))


def closed_form_world(robot: Any, fields: Mapping[str, Any]) -> ClosedFormWorld:
    """Give a world its robot's spheres.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        fields: of :class:`vrrt_jax.scene.world.World`.
    """
    radius = np.asarray(robot.self_collision_spheres.radius)
    first, second = np.asarray(robot.self_collision_pairs, int).reshape(-1, 2).T
    contact_distance = np.zeros((len(radius), len(radius)), np.float32)
    contact_distance[first, second] = radius[first] + radius[second]

    return ClosedFormWorld(
        collision_spheres=placed(robot, robot.collision_spheres),
        collision_radius=robot.collision_spheres.radius,
        self_collision_spheres=placed(robot, robot.self_collision_spheres),
        contact_distance=jnp.asarray(contact_distance),
        **fields,
    )
