"""Polytopes of few planes that contain the bodies of a robot: tighter than spheres."""

import dataclasses
import functools
import itertools

import mujoco
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, HalfspaceIntersection

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.geom_pieces import collision_pieces, in_body, mesh_points

_MAX_PLANES = 48
_TOLERANCE = 2e-3  # [m] that a polytope may stick out, if it takes no more planes
_MAX_PARTS = 4  # of a body
_ROUNDING = 2e-5  # [m] what is lost in writing and reading
_SAME_FACE = 1e-3  # normals of faces of one plane differ by no more
_SLIVER = 1e-5  # of the surface: a smaller face comes from rounding, and is left out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Polytope:
    """A convex polytope bound to a body of a robot."""

    body: str
    link: int
    vertices: np.ndarray  # (V, 3) in the link's frame [m]

    @functools.cached_property
    def faces(self) -> tuple[np.ndarray, np.ndarray]:
        """See :func:`faces`; every world of the robot needs them."""
        return faces(self.vertices)


def outer_polytopes(model: mujoco.MjModel) -> dict[int, list[np.ndarray]]:
    """Polytopes that contain the collision geoms of a robot.

    Args:
        model: a compiled robot with its true geometry.

    Returns:
        By body the vertices (V, 3) of at most four polytopes, in the frame of the body [m].

    Raises:
        ValueError: a geom has a shape that has no convex hull here.
    """
    found = {}
    for body, pieces in collision_pieces(model).items():
        parts = [piece.vertices[np.unique(piece.triangles)] for piece in pieces]
        found[body] = [outer_polytope(part) for part in _merged(parts)]
    return found


def _merged(parts: list[np.ndarray]) -> list[np.ndarray]:
    """Points (n, 3) of so few parts, those joined whose hull fills least between them."""
    hulls = [ConvexHull(part) for part in parts]
    while len(hulls) > _MAX_PARTS:
        joined = {
            pair: ConvexHull(np.vstack([_corners(hulls[k]) for k in pair]))
            for pair in itertools.combinations(range(len(hulls)), 2)
        }
        best = min(joined, key=lambda p: joined[p].volume - sum(hulls[k].volume for k in p))
        hulls = [hull for k, hull in enumerate(hulls) if k not in best] + [joined[best]]
    return [_corners(hull) for hull in hulls]


def _corners(hull: ConvexHull) -> np.ndarray:
    return hull.points[hull.vertices]


def outer_polytope(points: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) of a polytope of few planes that contains points (n, 3) [m].

    Of a box around them, what sticks out most is cut off, again and again.
    """
    points = _corners(ConvexHull(points))
    middle = points.mean(axis=0)
    normals = _box_axes(points - middle)
    known: dict[tuple[float, ...], np.ndarray] = {}  # most vertices survive a cut
    while True:
        offsets = (points @ normals.T).max(axis=0) + _ROUNDING
        planes = np.column_stack([normals, -offsets])
        vertices = np.round(HalfspaceIntersection(planes, middle).intersections, 7)
        for vertex in {*map(tuple, vertices.tolist())} - known.keys():
            known[vertex] = vertex - _nearest(points, np.array(vertex))
        beyond = np.array([known[tuple(vertex)] for vertex in vertices.tolist()])
        distance = np.linalg.norm(beyond, axis=1)
        farthest = distance.argmax()
        if len(normals) == _MAX_PLANES or distance[farthest] < _TOLERANCE:
            return np.unique(np.round(vertices, 5), axis=0)
        normals = np.vstack([normals, beyond[farthest] / distance[farthest]])


def _box_axes(points: np.ndarray) -> np.ndarray:
    """Normals (6, 3) of the smaller box around points (n, 3): along their axes, or their spread."""
    axes = np.eye(3), np.linalg.eigh(points.T @ points)[1].T
    smaller = min(axes, key=lambda rows: np.prod(np.ptp(points @ rows.T, axis=0)))
    return np.vstack([smaller, -smaller])


def _nearest(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The point of the hull of points (n, 3) that is nearest to a place (3,)."""
    # Shares of the points that are not negative and add up to one, as a row that weighs much.
    rows = np.vstack([(points - place).T, 10.0 * np.ones(len(points))])
    shares = nnls(rows, np.array([0.0, 0.0, 0.0, 10.0]), maxiter=100 * len(points))[0]
    return shares @ points / shares.sum()


def faces(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (F, 3) and offsets (F,) [m] of the planes around vertices (V, 3)."""
    hull = ConvexHull(vertices)
    corners = vertices[hull.simplices]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # Triangles of one face have nearly the same normal: the largest stands for all.
    normals: list[np.ndarray] = []
    order = np.argsort(-area)
    for normal in hull.equations[order[area[order] > _SLIVER * area.sum()], :3]:
        if all(normal @ other < 1 - _SAME_FACE for other in normals):
            normals.append(normal)
    found = np.array(normals)
    return found, (vertices @ found.T).max(axis=0)


def read_polytopes(model: mujoco.MjModel) -> dict[int, list[np.ndarray]]:
    """The polytopes of a model that :mod:`vrrt_jax.robots.mjcf_writer` wrote.

    Returns:
        As :func:`outer_polytopes`.
    """
    found: dict[int, list[np.ndarray]] = {}
    for geom in np.flatnonzero(mjcf_writer.is_polytope(model)):
        vertices = in_body(model, int(geom), mesh_points(model, int(geom)))
        found.setdefault(int(model.geom_bodyid[geom]), []).append(np.round(vertices, 5))
    return found


def polytopes_on_links(
    model: mujoco.MjModel, body_link: np.ndarray, body_in_link: np.ndarray
) -> tuple[Polytope, ...]:
    """Bind the polytopes of a written model to links instead of bodies.

    Args:
        model: compiled.
        body_link: (nbody,) from :func:`vrrt_jax.robots.kinematics.chain_from_model`.
        body_in_link: (nbody, 4, 4) likewise.
    """
    return tuple(
        Polytope(
            body=model.body(body).name,
            link=int(body_link[body]),
            vertices=vertices @ body_in_link[body, :3, :3].T + body_in_link[body, :3, 3],
        )
        for body, parts in read_polytopes(model).items()
        for vertices in parts
    )
