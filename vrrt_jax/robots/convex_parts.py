"""The convex pieces that a robot's collision geoms are made of."""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

STEP = 1e-4  # [m] centers and radii of fitted spheres are multiples of this
_MAX_FACES = 400  # hulls with more are simplified, outwards
_BLOCK = 10_000_000  # numbers in memory at once
_ROUND_SIDES = 20  # sides of the prism around a cylinder, 1.2 % wider; 2.5 % for other round shapes


@dataclasses.dataclass(frozen=True, kw_only=True)
class Piece:
    """A convex polytope in the frame of its body."""

    vertices: np.ndarray  # (V, 3) [m]
    triangles: np.ndarray  # (F, 3) int, indices into ``vertices``
    normals: np.ndarray  # (F, 3) outward unit normals
    offsets: np.ndarray  # (F,) a point is inside where normals @ x <= offsets

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) from points (n, 3) inside to the surface [m]; negative outside."""
        blocks = np.array_split(points, 1 + points.shape[0] * len(self.offsets) // _BLOCK)
        return np.concatenate(
            [np.min(self.offsets - block @ self.normals.T, axis=1) for block in blocks]
        )


def piece_of(points: np.ndarray) -> Piece:
    """The convex hull of points (n, 3) [m], or, of fine ones, a polytope just around it."""
    hull = ConvexHull(points)
    if len(hull.simplices) > _MAX_FACES:
        # The half-spaces that touch the hull in fixed directions make up a simpler polytope.
        vertices = points[hull.vertices]
        reach = np.max(vertices @ _DIRECTIONS.T, axis=0)
        planes = np.column_stack([_DIRECTIONS, -reach])
        hull = ConvexHull(HalfspaceIntersection(planes, vertices.mean(axis=0)).intersections)
    return Piece(
        vertices=hull.points,
        triangles=hull.simplices,
        normals=hull.equations[:, :3],
        offsets=-hull.equations[:, 3],
    )


def _sphere_directions(num: int) -> np.ndarray:
    """Unit vectors (num, 3), evenly spread on a spiral, and the six along the axes."""
    height = 1.0 - (2.0 * np.arange(num) + 1.0) / num
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(num)
    radius = np.sqrt(1.0 - height**2)
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return np.vstack([spiral, np.eye(3), -np.eye(3)])


_DIRECTIONS = _sphere_directions(200)


def collision_pieces(model: mujoco.MjModel) -> dict[int, list[Piece]]:
    """Convex pieces of every body with collision geoms.

    Args:
        model: a compiled robot.

    Returns:
        Pieces by body index, in the frame of the body.

    Raises:
        ValueError: a geom has a shape that has no convex hull here.
    """
    pieces: dict[int, list[Piece]] = {}
    for geom in range(model.ngeom):
        if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        points = _geom_points(model, geom) @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        pieces.setdefault(int(model.geom_bodyid[geom]), []).append(piece_of(points))
    return pieces


def _geom_points(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Points (n, 3) whose convex hull contains the geom, in the geom's frame [m]."""
    kinds = mujoco.mjtGeom
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], np.float64)
    if kind == kinds.mjGEOM_BOX:
        return _corners() * size
    if kind == kinds.mjGEOM_CYLINDER:
        return np.vstack([_circle(size[0], z) for z in (-size[1], size[1])])
    if kind == kinds.mjGEOM_SPHERE:
        return _ball() * size[0]
    if kind == kinds.mjGEOM_ELLIPSOID:
        return _ball() * size
    if kind == kinds.mjGEOM_CAPSULE:
        ball = _ball() * size[0]
        return np.vstack([ball + [0, 0, z] for z in (-size[1], size[1])])
    name = model.body(model.geom_bodyid[geom]).name
    raise ValueError(
        f"a collision geom of body '{name}' is a {kinds(kind).name[7:].lower()}; expected sphere, "
        "box, capsule, cylinder, ellipsoid or mesh: replace it"
    )


def _corners() -> np.ndarray:
    return np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3).astype(float)


def _circle(radius: float, z: float) -> np.ndarray:
    angle = np.arange(_ROUND_SIDES) * (2 * np.pi / _ROUND_SIDES)
    radius = radius / np.cos(np.pi / _ROUND_SIDES)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(_ROUND_SIDES, z)], -1)


def _ball() -> np.ndarray:
    """Vertices (n, 3) of a polytope around the unit sphere."""
    rings = np.linspace(-np.pi / 2, np.pi / 2, _ROUND_SIDES // 2 + 1)
    points = np.vstack([_circle(np.cos(a), np.sin(a)) for a in rings])
    return points / np.cos(np.pi / _ROUND_SIDES)


def surface_samples(pieces: list[Piece], spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Points on the surface of a union of pieces.

    Args:
        pieces: of one body.
        spacing: mean distance between points [m].
        rng: source of randomness.

    Returns:
        (n, 3) points [m], the vertices among them.
    """
    found = []
    for index, piece in enumerate(pieces):
        # Triangles are drawn by their area, so that the points are spread evenly.
        corners = piece.vertices[piece.triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1) / 2
        count = int(np.ceil(area.sum() / spacing**2)) + 50
        face = rng.choice(len(area), count, p=area / area.sum())
        # Uniform in a triangle, by barycentric weights.
        u, v = np.sqrt(rng.random(count)), rng.random(count)
        weight = np.stack([1 - u, u * (1 - v), u * v], -1)
        points = np.einsum("nk,nkd->nd", weight, corners[face])
        points = np.vstack([points, piece.vertices[np.unique(piece.triangles)]])
        # What lies inside another piece is not surface of the union.
        others = [other for k, other in enumerate(pieces) if k != index]
        found.append(points[union_depth(others, points) < 1e-6] if others else points)
    return np.vstack(found)


def union_depth(pieces: list[Piece], points: np.ndarray) -> np.ndarray:
    """Depth (n,) of points (n, 3) below the surface of the deepest piece [m]; negative outside."""
    return np.max([piece.depth(points) for piece in pieces], axis=0)


def contain_surface(
    pieces: list[Piece], centers: np.ndarray, radii: np.ndarray, *, leaf: float
) -> tuple[np.ndarray, np.ndarray]:
    """Round spheres to steps of ``STEP`` and grow them until they provably contain a surface.

    A triangle whose corners lie in one sphere lies in it as a whole. Triangles are split until
    that is so, or until they are tiny; then the nearest sphere grows to take them in.

    Args:
        pieces: of one body.
        centers: (n, 3) [m].
        radii: (n,) [m].
        leaf: size below which triangles are not split any further [m]; where two spheres meet,
            they grow by up to half of it.

    Returns:
        Centers (n, 3) and radii (n,) [m].
    """
    centers = np.round(centers / STEP) * STEP
    for piece in pieces:
        triangles = piece.vertices[piece.triangles]
        others = [other for other in pieces if other is not piece]
        while len(triangles):
            # A triangle is bare if no sphere holds all of its corners.
            corner_distance = np.linalg.norm(triangles[:, :, None] - centers, axis=-1)
            # Without other pieces all corners are surface: close gaps before triangles are split.
            if not others:
                radii = grow(corner_distance.reshape(-1, len(radii)), radii)
            distance = corner_distance.max(1)
            is_bare = (distance > radii).all(1)
            # What lies inside another piece is not surface, and may stay bare.
            for other in others:
                corners = triangles[is_bare].reshape(-1, 3)
                is_bare[is_bare] = other.depth(corners).reshape(-1, 3).min(1) < 0
            triangles, distance = triangles[is_bare], distance[is_bare]
            # Leaves are taken in by growing spheres; larger triangles are split in four.
            edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1)
            is_leaf = edges.max(1, initial=0) < leaf
            radii = grow(distance[is_leaf], radii)
            triangles = _split(triangles[~is_leaf])
    return centers, np.ceil(radii / STEP - 1e-9) * STEP


def grow(distance: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Enlarge radii, each time as little as possible, until every point is in a sphere.

    Args:
        distance: (p, n) from points to centers [m].
        radii: (n,) [m].

    Returns:
        (n,) radii [m].
    """
    radii = radii.copy()
    while len(distance):
        # The farthest point outside is taken in by the sphere that it is nearest to.
        gap = distance - radii
        nearest = gap.min(1)
        worst = nearest.argmax()
        if nearest[worst] <= 0:
            break
        sphere = gap[worst].argmin()
        radii[sphere] = distance[worst, sphere]
        distance = distance[nearest > 0]
    return radii


def _split(triangles: np.ndarray) -> np.ndarray:
    """Four triangles (4 n, 3, 3) for each of (n, 3, 3)."""
    a, b, c = (triangles[:, k] for k in range(3))
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(corner, axis=1) for corner in corners])
