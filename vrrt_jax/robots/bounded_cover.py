"""Cover the surface of a body with spheres that stick out of it by no more than a bound.

Any point of a surface lies in a sphere that sticks out by the bound: one of that radius around the
point, to begin with. So there is always a cover, and what remains is to need few spheres.

1. Points are sampled on the surface, and taken in their order along the body. For each bare one,
   the spheres through it that stick out by the bound are tried in many directions. The one that
   takes in most bare points is chosen.
2. Spheres that the others can do without are dropped, and those that are left shrink around the
   points that are their own.
3. Samples prove nothing between them. So the surface is split into ever smaller triangles until
   each lies in a sphere. Where one does not, a sphere grows again, at most to what it was, and
   where that does not help, one is added.
"""

import numpy as np
from scipy.spatial import KDTree

from vrrt_jax.robots.convex_parts import Piece, surface_area, surface_samples
from vrrt_jax.robots.cover_proof import prove_cover
from vrrt_jax.robots.widest_sphere import MARGIN, bare_around, best_sphere

_SPACING = 0.3  # of the bound, between samples of the surface
_MAX_SAMPLES = 200_000
_MAX_CANDIDATES = 400  # centers tried for one sphere
_NUM_INNER = (600, 20_000)  # points inside the body where the center of a sphere is tried
_NUM_STEPS = 25  # of a random walk to each of them
_MOST_DEPTHS = 4_000_000  # distances from such points to faces that are computed in a step


def cover_within(
    pieces: list[Piece], bulge: float, rng: np.random.Generator, *, most: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Spheres that contain the surface of a body.

    Args:
        pieces: convex pieces of the body; they stick out of the true shape by less than half of
            ``bulge``.
        bulge: how far spheres stick out of the body at most [m].
        rng: source of randomness.
        most: number of spheres to give up at.

    Returns:
        Centers (n, 3) and radii (n,) [m]; None if so many spheres are not enough.
    """
    spacing = max(_SPACING * bulge, np.sqrt(surface_area(pieces) / _MAX_SAMPLES))
    samples = surface_samples(pieces, spacing, rng)
    if len(samples) > 2 * _MAX_SAMPLES:
        samples = samples[rng.choice(len(samples), 2 * _MAX_SAMPLES, replace=False)]
    # Some slack is for what lies between the samples.
    slack = MARGIN * bulge
    found = _sweep(pieces, samples, bulge - slack, rng, most)
    if found is None:
        return None
    centers, radii = _few_and_small(samples, *found)
    return prove_cover(pieces, (centers, radii, found[1] + slack), bulge, rng, most)


def _sweep(
    pieces: list[Piece], samples: np.ndarray, bulge: float, rng: np.random.Generator, most: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Spheres that contain all samples (n, 3), one after another along the body."""
    middle = samples - samples.mean(axis=0)
    axis = np.linalg.svd(middle.T @ middle)[0][:, 0]
    samples = samples[np.argsort(samples @ axis, kind="stable")]
    tree, is_bare = KDTree(samples), np.ones(len(samples), bool)
    # Most spheres lie on the medial axis, where they are largest.
    inner, depth = _inner_points(pieces, samples, bulge, rng)
    width = depth + bulge
    inner_tree = KDTree(inner)
    centers, radii = [], []
    for first, point in enumerate(samples):
        if not is_bare[first]:
            continue
        if len(radii) == most:
            return None
        around = np.array(inner_tree.query_ball_point(point, width.max()), int)
        around = around[np.linalg.norm(inner[around] - point, axis=1) <= width[around]]
        around = around[:: 1 + len(around) // _MAX_CANDIDATES]
        if len(around):
            targets = bare_around(point, 2 * width[around].max(), samples, tree, is_bare)
            inside = np.linalg.norm(targets[:, None] - inner[around], axis=-1) <= width[around]
            best = around[inside.sum(axis=0).argmax()]
            center, radius = inner[best], width[best]
        else:
            center, radius = best_sphere(pieces, point, samples, tree, is_bare, bulge, rng)
        is_bare[tree.query_ball_point(center, radius)] = False
        is_bare[first] = False
        centers.append(center)
        radii.append(radius)
    return np.array(centers), np.array(radii)


def _inner_points(
    pieces: list[Piece], samples: np.ndarray, bulge: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 3) of the body and their depths (m,), most of them far from the surface [m]."""
    num = int(np.clip(surface_area(pieces) / bulge**2, *_NUM_INNER))
    num = min(num, _MOST_DEPTHS // sum(len(piece.offsets) for piece in pieces))
    points = samples[rng.integers(len(samples), size=num)]
    depth = _depth(pieces, points)
    # A random walk uphill in depth, towards the medial axis. Some points stop early, so that
    # candidates are found between the surface and the axis too.
    going = np.arange(num)
    for scale in np.linspace(1.0, 0.1, _NUM_STEPS):
        step = scale * np.maximum(depth[going], bulge)[:, None] * rng.normal(size=(len(going), 3))
        moved = points[going] + step
        moved_depth = _depth(pieces, moved)
        better = moved_depth > depth[going]
        points[going[better]], depth[going[better]] = moved[better], moved_depth[better]
        going = going[rng.random(len(going)) > 1 / _NUM_STEPS]
    return points, depth


def _depth(pieces: list[Piece], points: np.ndarray) -> np.ndarray:
    """How deep points (n, 3) are in the true shape at least, (n,) [m]; negative outside."""
    return np.max([piece.depth(points) - piece.excess for piece in pieces], axis=0)


def _few_and_small(
    samples: np.ndarray, centers: np.ndarray, radii: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same spheres; radii are less, and zero for those that the others can do without."""
    tree = KDTree(samples)
    inside = [np.array(tree.query_ball_point(*s), int) for s in zip(centers, radii, strict=True)]
    count = np.bincount(np.concatenate(inside), minlength=len(samples))
    keep = np.ones(len(radii), bool)
    # Those that few samples depend on go first.
    for k in np.argsort([np.sum(count[own] == 1) for own in inside], kind="stable"):
        if np.all(count[inside[k]] > 1):
            keep[k] = False
            count[inside[k]] -= 1
    # A sample belongs to the sphere that it lies deepest in, and radii reach what is their own.
    depth, owner = np.full(len(samples), -np.inf), np.full(len(samples), -1)
    for k in np.flatnonzero(keep):
        own = radii[k] - np.linalg.norm(samples[inside[k]] - centers[k], axis=1)
        deeper = own > depth[inside[k]]
        depth[inside[k][deeper]], owner[inside[k][deeper]] = own[deeper], k
    smaller = np.zeros(len(radii))
    found = owner >= 0
    distance = np.linalg.norm(samples[found] - centers[owner[found]], axis=1)
    np.maximum.at(smaller, owner[found], distance)
    return centers, np.where(keep, np.clip(smaller, 0.3 * radii, radii), 0.0)
