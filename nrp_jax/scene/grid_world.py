"""A robot on a sliding base among the solid cells of a home: is this configuration free?"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.scene.field import DistanceField
from nrp_jax.scene.link_shapes import LinkShapes, axes, gaps, segment_to_cylinder
from nrp_jax.scene.near_cells import NearCells, touches
from nrp_jax.scene.robots import PlanarBoxes
from vrrt_jax.core.boxes import box_inside_limits, half_extents
from vrrt_jax.core.edges import StraightLineEdges, difference, joint_steps
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import PytreeSubclasses, pytree, static
from vrrt_jax.robots.kinematics import Chain, link_poses, place


@pytree
class RoundBase:
    """A round base among the cells that are low enough to be in its way, and below an arm."""

    near: NearCells  # planar
    radius: jax.Array  # () [m]
    height: jax.Array  # () [m]
    link: int = static()
    capsules: tuple[int, ...] = static()  # of the arm, among the shapes
    spheres: tuple[int, ...] = static()  # that cover the arm's boxes, among the collision spheres


@pytree
class GridWorld(PytreeSubclasses, StraightLineEdges):
    """What planners ask about a robot on a sliding base in a home; edges are straight.

    An edge's length is the base's length plus ``arm_weight`` times the arm's length. Its sub-steps
    move no joint by more than ``resolution``.

    Subclass it to add a constraint of your own: planners ask :meth:`is_free` only. Subclasses are
    pytree dataclasses by themselves, so that new fields may be arrays.

    Letters: ``D`` joints with the base's, ``n`` collision spheres, ``L`` links.
    """

    chain: Chain
    collision_spheres: jax.Array  # (L * 4, n) their placement, see ``kinematics.placement``
    collision_radius: jax.Array  # (n,) [m]
    floor: jax.Array  # (n,) lowest height of their centers, -inf if they may touch the floor [m]
    planar_boxes: PlanarBoxes | None  # flat links checked against each other
    shapes: LinkShapes | None  # the same for links that are not flat
    base: RoundBase | None
    near: tuple[NearCells, ...]  # for each group of spheres
    field: DistanceField  # for networks
    corner: jax.Array  # (2, 2) corner of the map in x and y: in float32, and what it lacks [m]
    lower: jax.Array  # (D,) [rad] or [m]
    upper: jax.Array  # (D,) [rad] or [m]
    is_continuous: jax.Array  # (D,) bool, joints that turn for ever
    arm_weight: jax.Array  # () meters that a radian of the arm counts for
    resolution: jax.Array  # () longest sub-step of any joint [m] or [rad]
    groups: tuple[int, ...] = static()  # sizes of groups of spheres, as many as ``near``
    first_arm: ClassVar[int] = 2  # the first joint that is not the base's

    @single_precision
    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`nrp_jax.scene.world.is_free`."""
        # The robot at the origin, and where it stands from the corner of the map: no digits are
        # lost, wherever the map lies.
        stand = (q[:2] - self.corner[0]) - self.corner[1]
        poses = link_poses(self.chain, q.at[:2].set(0.0))
        # The barrier keeps XLA's CPU fusions from placing the spheres once for every use.
        centers = jax.lax.optimization_barrier(place(self.collision_spheres, poses))
        # The home and its floor.
        free = jnp.all(centers[2] > self.floor)
        standing = centers.at[:2].add(stand[:, None])
        first = 0
        for near, size in zip(self.near, self.groups, strict=True):
            group = slice(first, first + size)
            free &= ~jnp.any(touches(near, standing[:, group], self.collision_radius[group]))
            first += size
        # The robot itself, and its parts that are not spheres.
        if self.planar_boxes is not None:
            free &= _boxes_apart(self.planar_boxes, poses)
        if self.shapes is not None:
            start, axis = axes(self.shapes, poses)
            free &= jnp.all(jnp.concatenate(gaps(self.shapes, poses, start, axis)) > 0)
            if self.base is not None:
                radius = self.collision_radius
                above = _above_base(self.base, self.shapes, poses, start, axis, centers, radius)
                free &= jnp.all(above > 0)
        if self.base is not None:
            free &= ~jnp.any(touches(self.base.near, stand[:, None], self.base.radius))
        return free

    def interpolate(self, q_a: jax.Array, q_b: jax.Array, fraction: jax.Array) -> jax.Array:
        """Configurations (..., D) at a fraction (...) of the edges between others (..., D)."""
        part = self.truncate(self.edge(q_a, q_b), jnp.asarray(fraction, jnp.asarray(q_a).dtype))
        return self.normalize(self.end(q_a, part))

    def distances(self, nodes: jax.Array, q: jax.Array, among: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        base, arm = jnp.zeros((2, q.shape[0], nodes.shape[0]), q.dtype)
        for joint in range(q.shape[1]):
            squared = joint_steps(self, nodes, q, joint) ** 2
            base, arm = (base + squared, arm) if joint < 2 else (base, arm + squared)
        return jnp.where(among, jnp.sqrt(base) + self.arm_weight * jnp.sqrt(arm), jnp.inf)

    def length(self, edge: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return norm(edge[..., :2]) + self.arm_weight * norm(edge[..., 2:])

    def span(self, edge: jax.Array) -> jax.Array:
        """The longest distance (...) that any joint moves along an edge [m] or [rad]."""
        return jnp.max(jnp.abs(edge), axis=-1)

    def steer(self, q_from: jax.Array, target: jax.Array, num_steps: int) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        inside = jnp.where(self.is_continuous, target, jnp.clip(target, self.lower, self.upper))
        edge = self.edge(q_from, inside)
        longest = num_steps * self.resolution
        return self.truncate(edge, jnp.minimum(1.0, longest / jnp.maximum(self.span(edge), 1e-9)))

    def informed_box(
        self, q_a: jax.Array, q_b: jax.Array, cost: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """See :class:`vrrt_jax.core.edges.Space`: what one of base and arm leaves to the other."""
        step = difference(self, q_a, q_b)
        base, arm = step[:2], step[self.first_arm :]
        base_half = half_extents(base, cost - self.arm_weight * norm(arm))
        # Joints that wrap keep their whole range: the others are an ellipsoid of their own.
        fixed = jnp.where(self.is_continuous[self.first_arm :], 0.0, arm)
        arm_half = half_extents(fixed, (cost - norm(base)) / self.arm_weight)
        heading = jnp.full(self.first_arm - 2, jnp.inf)
        half = jnp.concatenate([base_half, heading, arm_half])
        return box_inside_limits(self, (q_a + q_b) / 2, half)

    def is_resolved(self, edge: jax.Array, num_steps: int | jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`."""
        return self.span(edge) <= num_steps * self.resolution * (1 + 1e-5)

    def parts(self, edge: Any, most: int) -> jax.Array:
        """Fewest parts (...) of an edge that are resolved each; ``most + 1`` if it takes more."""
        enough = jax.vmap(self.is_resolved, (None, 0))(edge, jnp.arange(1, most + 1))
        return 1 + jnp.sum(~enough, axis=0)


def norm(step: jax.Array) -> jax.Array:
    """Euclidean length (...) of steps (..., D)."""
    return jnp.sqrt(jnp.sum(step**2, axis=-1))


def _boxes_apart(boxes: PlanarBoxes, poses: jax.Array) -> jax.Array:
    """Whether no two of the checked boxes overlap: some side separates them."""
    # Centers and headings of the boxes in the world.
    pose = poses[jnp.array(boxes.link)]
    cosine, sine = pose[:, 0, 0], pose[:, 1, 0]
    center = jnp.einsum("mij,mj->mi", pose[:, :2, :2], boxes.center) + pose[:, :2, 3]
    pairs = jnp.array(boxes.pairs).T
    (c_i, c_j), (s_i, s_j), (half_i, half_j) = cosine[pairs], sine[pairs], boxes.half[pairs]
    # |cos| and |sin| of the angle between the two boxes of a pair: how far one reaches along the
    # sides of the other.
    turned = jnp.abs(jnp.stack([c_i * c_j + s_i * s_j, c_i * s_j - s_i * c_j]))
    dx, dy = (center[pairs[1]] - center[pairs[0]]).T
    # Separating axes: the two directions of each box's sides.
    apart = jnp.zeros(len(boxes.pairs), bool)
    for (c, s), own, other in (((c_i, s_i), half_i, half_j), ((c_j, s_j), half_j, half_i)):
        ahead, beside = jnp.abs(c * dx + s * dy), jnp.abs(c * dy - s * dx)
        apart |= ahead > own[:, 0] + other[:, 0] * turned[0] + other[:, 1] * turned[1]
        apart |= beside > own[:, 1] + other[:, 0] * turned[1] + other[:, 1] * turned[0]
    return jnp.all(apart)


def _above_base(
    base: RoundBase,
    shapes: LinkShapes,
    poses: jax.Array,
    start: jax.Array,
    axis: jax.Array,
    centers: jax.Array,
    radius: jax.Array,
) -> jax.Array:
    """Gaps (C,) between a round base and the arm: its capsules, and the spheres of its boxes."""
    capsules, spheres = np.array(base.capsules, int), np.array(base.spheres, int)
    # Spheres are capsules of no length.
    first = jnp.concatenate([start[:, capsules], centers[:, spheres]], axis=1)
    along = jnp.pad(axis[:, capsules], [(0, 0), (0, len(spheres))])
    thick = jnp.concatenate([shapes.radius[capsules], radius[spheres]])
    local = first - poses[base.link, :3, 3:] * jnp.array([[1.0], [1.0], [0.0]])
    return segment_to_cylinder(local, along, base.radius, base.height) - thick
