"""Convex polytopes, and unions of them: depths, surfaces, and spheres that contain these."""

import dataclasses
import functools

import numpy as np
from scipy.spatial import ConvexHull

STEP = 1e-4  # [m] centers and radii of fitted spheres are multiples of this
_MAX_FACES = 1000  # for depths, hulls with more are simplified, inwards
_INWARDS = (1e-3, 5e-3)  # by so much at most: [m], and of the size
_NUM_EXTREMES = 400  # directions in which a hull that is simplified keeps its farthest point
_BLOCK = 2_000_000  # numbers in memory at once


@dataclasses.dataclass(frozen=True, kw_only=True)
class Piece:
    """A convex polytope in the frame of its body."""

    vertices: np.ndarray  # (V, 3) [m]
    triangles: np.ndarray  # (F, 3) int, indices into ``vertices``
    # A point is inside where normals @ x <= offsets. For the hull of a fine mesh, these are the
    # faces of a simpler polytope just inside.
    normals: np.ndarray  # (f, 3) outward unit normals
    offsets: np.ndarray  # (f,) [m]
    excess: float = 0.0  # how far the polytope sticks out of the true shape at most [m]

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (3,) and (3,) of the box around it [m]."""
        corners = self.vertices[np.unique(self.triangles)]
        return corners.min(axis=0), corners.max(axis=0)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance (n,) from points (n, 3) inside to the surface [m]; negative outside."""
        blocks = _blocks(points, len(self.offsets))
        return np.concatenate(
            [np.min(self.offsets - block @ self.normals.T, axis=1) for block in blocks]
        )


def piece_of(points: np.ndarray, excess: float = 0.0) -> Piece:
    """The convex hull of points (n, 3) [m].

    Args:
        points: of one shape.
        excess: how far their hull sticks out of the true shape at most [m].
    """
    hull = ConvexHull(points)
    inner = _simpler(points[hull.vertices]) if len(hull.simplices) > _MAX_FACES else hull
    planes = np.unique(np.round(inner.equations, 12), axis=0)
    return Piece(
        vertices=hull.points,
        triangles=hull.simplices,
        normals=planes[:, :3],
        offsets=-planes[:, 3],
        excess=excess,
    )


def _simpler(vertices: np.ndarray) -> ConvexHull:
    """The hull of some vertices (n, 3) of a hull, which contains all of them but for a little."""
    size = np.ptp(vertices, axis=0).max()
    tolerance = min(_INWARDS[0], _INWARDS[1] * size)
    # Extremes in all directions, of the shape made round: a long one would lose its sides.
    middle = vertices - vertices.mean(axis=0)
    spread, axes = np.linalg.eigh(middle.T @ middle / len(middle))
    round_shape = middle @ axes / np.sqrt(np.maximum(spread, 1e-12 * spread.max()))
    directions = _blocks(sphere_directions(_NUM_EXTREMES), len(vertices))
    kept = np.unique(np.concatenate([(d @ round_shape.T).argmax(axis=1) for d in directions]))
    inner = ConvexHull(vertices[kept])
    while True:
        # Take in what sticks out most of each face.
        missed = [_farthest(vertices, block) for block in _blocks(inner.equations, len(vertices))]
        farthest, beyond = (np.concatenate(part) for part in zip(*missed, strict=True))
        more = np.setdiff1d(farthest[beyond > tolerance], kept)
        if not len(more):
            return inner
        kept = np.union1d(kept, more)
        inner = ConvexHull(vertices[kept])


def _farthest(vertices: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each plane (p, 4) the vertex (p,) that is farthest outside, and how far (p,) [m]."""
    beyond = planes[:, :3] @ vertices.T
    farthest = beyond.argmax(axis=1)
    return farthest, beyond[np.arange(len(planes)), farthest] + planes[:, 3]


def _blocks(rows: np.ndarray, width: int) -> list[np.ndarray]:
    """Rows in blocks, so that so many numbers for each row fit into memory."""
    return np.array_split(rows, 1 + len(rows) * width // _BLOCK)


def sphere_directions(num: int) -> np.ndarray:
    """Unit vectors (num + 6, 3), evenly spread on a spiral, and the six along the axes."""
    height = 1.0 - (2.0 * np.arange(num) + 1.0) / num
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(num)
    radius = np.sqrt(1.0 - height**2)
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return np.vstack([spiral, np.eye(3), -np.eye(3)])


def surface_area(pieces: list[Piece]) -> float:
    """Sum of the surfaces of all pieces [m^2]."""
    return float(sum(_areas(piece).sum() for piece in pieces))


def _areas(piece: Piece) -> np.ndarray:
    corners = piece.vertices[piece.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.linalg.norm(cross, axis=1) / 2


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
        area = _areas(piece)
        count = int(np.ceil(area.sum() / spacing**2)) + 50
        face = rng.choice(len(area), count, p=area / area.sum())
        # Uniform in a triangle, by barycentric weights.
        u, v = np.sqrt(rng.random(count)), rng.random(count)
        weight = np.stack([1 - u, u * (1 - v), u * v], -1)
        points = np.einsum("nk,nkd->nd", weight, corners[face])
        points = np.vstack([points, piece.vertices[np.unique(piece.triangles)]])
        # What lies inside another piece is not surface of the union.
        others = [other for k, other in enumerate(pieces) if k != index]
        found.append(points[~is_inside(others, points[:, None], 1e-6)])
    return np.vstack(found)


def union_depth(pieces: list[Piece], points: np.ndarray) -> np.ndarray:
    """Depth (n,) of points (n, 3) below the surface of the deepest piece [m]; negative outside."""
    return np.max([piece.depth(points) for piece in pieces], axis=0)


def is_inside(pieces: list[Piece], groups: np.ndarray, depth: float = 0.0) -> np.ndarray:
    """Which groups (n, k, 3) of k points lie in one of some pieces as a whole, (n,) bool.

    Args:
        pieces: none or more.
        groups: [m].
        depth: how deep they must be [m].
    """
    inside = np.zeros(len(groups), bool)
    for piece in pieces:
        # Few points are anywhere near a piece.
        low, high = piece.bounds
        near = np.flatnonzero(~inside & ((groups >= low) & (groups <= high)).all(axis=(1, 2)))
        depths = piece.depth(groups[near].reshape(-1, 3)).reshape(groups[near].shape[:2])
        inside[near] = depths.min(axis=1, initial=np.inf) >= depth
    return inside


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
    size = 1 + _BLOCK // (9 * len(radii))
    for piece in pieces:
        others = [other for other in pieces if other is not piece]
        stack = [piece.vertices[piece.triangles]]
        while stack:
            # A block at a time, the smallest triangles first, so that memory is bounded.
            triangles = stack.pop()
            if len(triangles) > size:
                stack.append(triangles[size:])
                triangles = triangles[:size]
            # A triangle is bare if no sphere holds all of its corners.
            corner_distance = np.linalg.norm(triangles[:, :, None] - centers, axis=-1)
            # Close gaps before triangles are split. What lies inside another piece is not surface.
            to_corners = corner_distance.reshape(-1, len(radii))
            radii = grow(to_corners[~is_inside(others, triangles.reshape(-1, 1, 3))], radii)
            distance = corner_distance.max(1)
            is_bare = (distance > radii).all(1)
            is_bare[is_bare] = ~is_inside(others, triangles[is_bare])
            triangles, distance = triangles[is_bare], distance[is_bare]
            # Leaves are taken in by growing spheres; larger triangles are split in two.
            edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1)
            is_leaf = edges.max(1, initial=0) < leaf
            radii = grow(distance[is_leaf], radii)
            if not is_leaf.all():
                stack.append(split_triangles(triangles[~is_leaf]))
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


def split_triangles(triangles: np.ndarray) -> np.ndarray:
    """Triangles (n, 3, 3) cut in two at the middle of their longest edge, (2 n, 3, 3)."""
    edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=-1)
    # Corners in the order that begins with the longest edge: from a to b.
    order = (edges.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = (triangles[np.arange(len(triangles)), order[:, k]] for k in range(3))
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
