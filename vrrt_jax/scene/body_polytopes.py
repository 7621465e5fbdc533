"""Bodies as polytopes on the device: planes with a body on one side, and something on the other.

Any such plane proves that the two are apart. Those that are tried are the faces of both, and the
one across the way between two near points of theirs. For two polytopes planes along an edge of each
may be needed too (the separating axis theorem), which are not tried.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import Spheres
from vrrt_jax.robots.polytopes import Polytope
from vrrt_jax.scene.obstacles import Obstacles

_SAME = 1e-5  # [m] two points that are nearer to each other have no way between them


@pytree
class BodyPolytopes:
    """Bodies as polytopes. Letters: ``P`` bodies, ``M`` parts of each, ``F`` faces, ``V`` vertices.

    Parts, faces and vertices are filled up to their largest numbers.
    """

    link: jax.Array  # (P,) i32
    has_part: jax.Array  # (P, M) bool
    normals: jax.Array  # (P, 3, M, F) outward, in the link's frame
    offsets: jax.Array  # (P, M, F) [m]
    vertices: jax.Array  # (P, V, 3, M) in the link's frame [m]

    def obstacle_gap(
        self,
        body: jax.Array,
        point: jax.Array,
        poses: jax.Array,
        obstacles: Obstacles,
        index: jax.Array,
    ) -> jax.Array:
        """A lower bound () of the distance between a body and an obstacle [m].

        Args:
            body: () i32 index of the body; one without polytopes has the index P.
            point: (3,) of the body, near to the obstacle.
            poses: (L, 4, 4) of links.
            obstacles: K of them.
            index: () i32 which of them.

        Returns:
            Negative where no plane separates them.
        """
        pose = poses[self.link[body]]
        # All is told in the link's frame: the obstacle's axes and center, and the way to the point.
        axes = pose[:3, :3].T @ obstacles.rotation[index]
        center = pose[:3, :3].T @ (obstacles.position[index] - pose[:3, 3])
        is_round = obstacles.is_round[index]
        half = obstacles.half[index]
        half = half.at[1].set(jnp.where(is_round, half[0], half[1]))
        rounding = obstacles.rounding[index]

        def reach(x: jax.Array, y: jax.Array, z: jax.Array) -> jax.Array:
            """How far the obstacle reaches from its center along directions in its frame."""
            flat = half[0] * jnp.abs(x) + half[1] * jnp.abs(y)
            section = jnp.where(is_round, half[0] * jnp.sqrt(x * x + y * y), flat)
            return section + half[2] * jnp.abs(z) + rounding

        # Faces of the body: how far the obstacle reaches towards each.
        normals = self.normals[body]
        towards = reach(*(_along(normals, axes[:, axis]) for axis in range(3)))
        gap = jnp.max(_along(normals, center) - towards - self.offsets[body], axis=-1)
        # Faces of the obstacle, and the way to the point: how far the body reaches towards each.
        vertices = jnp.moveaxis(self.vertices[body] - center[:, None], 1, 0)
        for axis in range(3):
            along = _along(vertices, axes[:, axis])
            beyond = jnp.maximum(jnp.min(along, axis=0), -jnp.max(along, axis=0))
            gap = jnp.maximum(gap, beyond - half[axis] - rounding)
        away = _from_box(
            obstacles.rotation[index].T @ (point - obstacles.position[index]), half, is_round
        )
        beyond = jnp.min(_along(vertices, axes @ away), axis=0) - reach(*away)
        gap = jnp.maximum(gap, jnp.where(jnp.any(away != 0), beyond, -jnp.inf))
        return self._least(body, jnp.where(self.has_part[body], gap, jnp.inf))

    def body_gap(
        self,
        first: jax.Array,
        second: jax.Array,
        points: tuple[jax.Array, jax.Array],
        poses: jax.Array,
    ) -> jax.Array:
        """A lower bound () of the distance between two bodies [m], as :meth:`obstacle_gap`.

        Args:
            first: () i32 index of a body.
            second: () i32 of the other.
            points: (3,) of both, near to the other.
            poses: (L, 4, 4) of links.
        """
        # Both ways: faces of one against vertices of the other, (M, M).
        gap = jnp.maximum(
            self._faces_to_vertices(first, second, poses),
            self._faces_to_vertices(second, first, poses).T,
        )
        # The way from one point to the other, if they differ.
        away = points[1] - points[0]
        length = jnp.linalg.norm(away)
        away /= length + 1e-9
        far, near = -self._nearest(first, poses, -away), self._nearest(second, poses, away)
        gap = jnp.maximum(gap, jnp.where(length > _SAME, near - far[:, None], -jnp.inf))
        is_pair = self.has_part[first][:, None] & self.has_part[second]
        return self._least(jnp.maximum(first, second), jnp.where(is_pair, gap, jnp.inf))

    def _faces_to_vertices(
        self, first: jax.Array, second: jax.Array, poses: jax.Array
    ) -> jax.Array:
        """How far (M, M) parts of the second body are beyond a face of parts of the first [m]."""
        pose, other = poses[self.link[first]], poses[self.link[second]]
        turn = pose[:3, :3].T @ other[:3, :3]
        shift = pose[:3, :3].T @ (other[:3, 3] - pose[:3, 3])
        vertices = self.vertices[second]  # (V, 3, M)
        moved = [
            sum(turn[axis, i] * vertices[:, i] for i in range(3)) + shift[axis] for axis in range(3)
        ]
        normals = self.normals[first]  # (3, M, F)
        along = sum(normals[i][:, None] * moved[i][:, None, :, None] for i in range(3))
        nearest = jnp.min(along, axis=0)  # (M, M, F) of the vertices
        return jnp.max(nearest - self.offsets[first][:, None], axis=-1)

    def _nearest(self, body: jax.Array, poses: jax.Array, direction: jax.Array) -> jax.Array:
        """The least (M,) that parts of a body reach along a direction (3,) [m]."""
        pose = poses[self.link[body]]
        along = _along(jnp.moveaxis(self.vertices[body], 1, 0), pose[:3, :3].T @ direction)
        return jnp.min(along, axis=0) + pose[:3, 3] @ direction

    def _least(self, body: jax.Array, gaps: jax.Array) -> jax.Array:
        return jnp.where(body < len(self.link), jnp.min(gaps), -jnp.inf)


def _along(vectors: jax.Array, direction: jax.Array) -> jax.Array:
    """Products (...) of vectors (3, ...) with a vector (3,)."""
    return vectors[0] * direction[0] + vectors[1] * direction[1] + vectors[2] * direction[2]


def _from_box(point: jax.Array, half: jax.Array, is_round: jax.Array) -> jax.Array:
    """The direction (3,) from a box, or a round bar along z, to a point (3,); 0 inside."""
    radius = jnp.sqrt(point[0] ** 2 + point[1] ** 2)
    size = jnp.where(is_round & (jnp.arange(3) < 2), radius, jnp.abs(point))
    beyond = point * jnp.maximum(1.0 - half / jnp.maximum(size, 1e-9), 0.0)
    length = jnp.linalg.norm(beyond)
    return jnp.where(length > _SAME, beyond / (length + 1e-9), 0.0)


def body_polytopes(polytopes: Sequence[Polytope]) -> tuple[BodyPolytopes, list[str]]:
    """Polytopes as arrays, and the names (P,) of their bodies."""
    names = list(dict.fromkeys(polytope.body for polytope in polytopes))
    of_body = [[part for part in polytopes if part.body == name] for name in names]
    most = max(len(parts) for parts in of_body)
    num_faces = max(len(part.faces[1]) for part in polytopes)
    num_vertices = max(len(part.vertices) for part in polytopes)
    shape = len(names), most
    has_part = np.zeros(shape, bool)
    # A face that is filled in is the first one again, and so is a vertex.
    normals, offsets = np.zeros((*shape, num_faces, 3)), np.zeros((*shape, num_faces))
    vertices = np.zeros((*shape, num_vertices, 3))
    for p, parts in enumerate(of_body):
        for m, part in enumerate(parts):
            has_part[p, m] = True
            for array, rows in (
                (normals, part.faces[0]),
                (offsets, part.faces[1]),
                (vertices, part.vertices),
            ):
                array[p, m] = rows[0]
                array[p, m, : len(rows)] = rows
    arrays = BodyPolytopes(
        link=jnp.asarray([parts[0].link for parts in of_body], jnp.int32),
        has_part=jnp.asarray(has_part),
        normals=jnp.asarray(normals.transpose(0, 3, 1, 2), jnp.float32),
        offsets=jnp.asarray(offsets, jnp.float32),
        vertices=jnp.asarray(vertices.transpose(0, 2, 3, 1), jnp.float32),
    )
    return arrays, names


def bulges(polytopes: Sequence[Polytope], bodies: Sequence[str], spheres: Spheres) -> np.ndarray:
    """How far spheres stick out of what they stand for: what is deeper in them touches it.

    Args:
        polytopes: of the robot.
        bodies: (n,) that each sphere stands for.
        spheres: n.

    Returns:
        (n,) the radius less that of the largest ball around the center inside a polytope [m].
    """
    planes: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for polytope in polytopes:
        planes.setdefault(polytope.body, []).append(polytope.faces)
    inside = [
        max((np.min(far - normals @ center) for normals, far in planes.get(body, ())), default=0.0)
        for body, center in zip(bodies, np.asarray(spheres.center, float), strict=True)
    ]
    return np.asarray(spheres.radius, float) - np.array(inside).reshape(-1)
