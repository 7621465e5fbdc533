"""Prove that spheres contain a surface, and let them grow or add some where they do not.

A triangle whose corners lie in one sphere lies in it as a whole. So the surface is split into ever
smaller triangles until each lies in a sphere, or is so small that a sphere must take it in.
"""

import numpy as np
from scipy.spatial import KDTree

from vrrt_jax.robots.convex_parts import Piece, grow, is_inside, split_triangles
from vrrt_jax.robots.widest_sphere import MARGIN, best_sphere

_GROUP = 10  # of the bound: side of the cubes in which a cover is proven
_BLOCK = 2_000_000  # numbers in memory at once
_Growing = tuple[np.ndarray, ...]  # centers (n, 3), radii (n,), and (n,) what they may grow to [m]


def prove_cover(
    pieces: list[Piece],
    spheres: _Growing,
    bulge: float,
    rng: np.random.Generator,
    most: int,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Spheres that contain every triangle of the surface.

    Args:
        pieces: of the body.
        spheres: centers (n, 3), radii (n,), and radii (n,) that they may grow to. Those of radius
            zero are not used.
        bulge: of spheres that are added.
        rng: source of randomness.
        most: number of spheres to give up at.
    """
    for piece in pieces:
        others = [other for other in pieces if other is not piece]
        for triangles in _local_groups(piece.vertices[piece.triangles], _GROUP * bulge):
            # Spheres that may reach a triangle of the group.
            low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
            away = spheres[0] - np.clip(spheres[0], low, high)
            is_near = (np.linalg.norm(away, axis=1) <= spheres[2]) & (spheres[1] > 0)
            local = tuple(part[is_near] for part in spheres)
            centers, radii, widest = _prove_locally(pieces, others, triangles, local, bulge, rng)
            spheres[1][is_near] = radii[: is_near.sum()]
            new = slice(int(is_near.sum()), None)
            spheres = tuple(
                np.concatenate([part, more[new]])
                for part, more in zip(spheres, (centers, radii, widest), strict=True)
            )
            if np.sum(spheres[1] > 0) > most:
                return None
    is_used = spheres[1] > 0
    return spheres[0][is_used], spheres[1][is_used]


def _local_groups(triangles: np.ndarray, side: float) -> list[np.ndarray]:
    """Triangles (t, 3, 3), the large ones split, in groups that lie in a cube each."""
    done = []
    while len(triangles):
        is_small = np.ptp(triangles, axis=1).max(axis=1) <= side
        done.append(triangles[is_small])
        triangles = split_triangles(triangles[~is_small])
    triangles = np.concatenate(done)
    cell = np.floor(triangles.mean(axis=1) / side).astype(int)
    group = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(group, kind="stable")
    return np.split(triangles[order], np.flatnonzero(np.diff(group[order])) + 1)


def _prove_locally(
    pieces: list[Piece],
    others: list[Piece],
    triangles: np.ndarray,
    spheres: _Growing,
    bulge: float,
    rng: np.random.Generator,
) -> _Growing:
    """Spheres that contain triangles (t, 3, 3), but for those in ``others``."""
    centers, radii, widest = spheres
    stack = [triangles]
    while stack:
        # A block at a time, the smallest triangles first, so that memory is bounded.
        triangles, size = stack.pop(), 1 + _BLOCK // (9 * max(len(radii), 1))
        if len(triangles) > size:
            stack.append(triangles[size:])
            triangles = triangles[:size]
        distance = np.linalg.norm(triangles[:, :, None] - centers, axis=-1)
        is_bare = (distance.max(axis=1) > radii).all(axis=1)
        is_bare[is_bare] = ~is_inside(others, triangles[is_bare])
        triangles, distance = triangles[is_bare], distance[is_bare]
        # Corners first: a sphere that takes them in often takes in all between.
        is_surface = ~is_inside(others, triangles.reshape(-1, 1, 3))
        to_corners = distance.reshape(-1, len(radii))[is_surface]
        radii, is_left = _grown(to_corners, radii, widest)
        added = _added(pieces, triangles.reshape(-1, 3)[is_surface][is_left], bulge, rng)
        # What is small enough must be taken in now; the rest is split.
        to_triangles = distance.max(axis=1)
        is_bare = (to_triangles > radii).all(axis=1)
        triangles, to_triangles = triangles[is_bare], to_triangles[is_bare]
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1)
        is_leaf = edges.max(axis=1, initial=0) < MARGIN * bulge
        radii, is_left = _grown(to_triangles[is_leaf], radii, widest)
        added += _added(pieces, triangles[is_leaf][is_left].mean(axis=1), bulge, rng)
        if not is_leaf.all():
            stack.append(split_triangles(triangles[~is_leaf]))
        for center, radius in added:
            centers = np.vstack([centers, center])
            radii, widest = np.append(radii, radius), np.append(widest, radius)
    return centers, radii, widest


def _grown(
    distance: np.ndarray, radii: np.ndarray, widest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Radii (n,) that reach as many of p things as they may, and which (p,) they do not reach.

    Args:
        distance: (p, n) that a radius must have to reach a thing [m].
        radii: (n,) [m].
        widest: (n,) [m] no radius may get larger.
    """
    distance = np.where(distance <= widest, distance, np.inf)
    is_out_of_reach = np.asarray(np.isinf(distance).all(axis=1))
    return grow(distance[~is_out_of_reach], radii), is_out_of_reach


def _added(
    pieces: list[Piece], points: np.ndarray, bulge: float, rng: np.random.Generator
) -> list[tuple[np.ndarray, float]]:
    """Spheres that contain points (p, 3) and what is a margin around each of them."""
    found, is_bare = [], np.ones(len(points), bool)
    tree = KDTree(points) if len(points) else None
    for k, point in enumerate(points):
        if tree is not None and is_bare[k]:
            center, radius = best_sphere(pieces, point, points, tree, is_bare, bulge, rng)
            is_bare[tree.query_ball_point(center, radius - MARGIN * bulge)] = False
            is_bare[k] = False
            found.append((center, radius))
    return found
