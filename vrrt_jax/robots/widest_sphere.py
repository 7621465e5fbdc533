"""The sphere through a point that sticks out of a body by a bound and takes in most of the rest."""

import numpy as np
from scipy.spatial import KDTree

from vrrt_jax.robots.convex_parts import Piece, sphere_directions

MARGIN = 0.1  # of the bound: a sphere reaches so far beyond its point
_DIRECTIONS = sphere_directions(96)  # in which the center of a sphere is tried
_NUM_TURNS = 32  # directions beside the best one, tried in each of the rounds
_TURNS = (0.25, 0.08)  # [rad] how far they are turned
_MAX_TARGETS = 2000  # bare points that count for the choice of a sphere


def bare_around(
    point: np.ndarray, radius: float, samples: np.ndarray, tree: KDTree, is_bare: np.ndarray
) -> np.ndarray:
    """Some of the bare samples (t, 3) within a radius [m] of a point (3,)."""
    near = np.array(tree.query_ball_point(point, radius), int)
    near = near[is_bare[near]]
    return samples[near[:: 1 + len(near) // _MAX_TARGETS]]


def best_sphere(
    pieces: list[Piece],
    point: np.ndarray,
    samples: np.ndarray,
    tree: KDTree,
    is_bare: np.ndarray,
    bulge: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, float]:
    """The sphere around a point (3,) that takes in most bare samples, and sticks out by a bound."""
    margin = MARGIN * bulge
    rooms = _rooms(pieces, point, bulge - margin)
    directions = _DIRECTIONS
    reach = _reach(rooms, directions)
    targets = bare_around(point, 2 * (reach.max() + margin), samples, tree, is_bare)
    best = (-1.0, point, margin)
    # First all around, then beside the best direction.
    for turn in (*_TURNS, None):
        centers = point + reach[:, None] * directions
        radii = reach + margin
        inside = np.linalg.norm(targets[:, None] - centers, axis=-1) <= radii
        # Of those that take in as many the larger one.
        score = inside.sum(axis=0) + 0.5 * reach / (reach.max() + 1e-12)
        k = int(score.argmax())
        best = max(best, (float(score[k]), centers[k], float(radii[k])), key=lambda b: b[0])
        if turn is None:
            break
        directions = directions[k] + turn * rng.normal(size=(_NUM_TURNS, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        reach = _reach(rooms, directions)
    return best[1], best[2]


def _rooms(
    pieces: list[Piece], point: np.ndarray, bulge: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Normals (f, 3) and how far (f,) the faces, moved out by the bulge, are from a point [m]."""
    rooms = []
    for piece in pieces:
        room = piece.offsets - piece.normals @ point + bulge - piece.excess
        if room.min() >= 0:
            rooms.append((piece.normals, room))
    return rooms


def _reach(rooms: list[tuple[np.ndarray, np.ndarray]], directions: np.ndarray) -> np.ndarray:
    """How far (k,) the center of a sphere through a point may be, in directions (k, 3) [m].

    A center that goes away by t is nearer to a face by the cosine times t, while the radius grows
    by t: the sphere meets the face that was moved out when both have used up the room.
    """
    reach = np.zeros(len(directions))
    for normals, room in rooms:
        closing = np.maximum(1.0 + directions @ normals.T, 1e-9)
        reach = np.maximum(reach, np.min(room / closing, axis=1))
    return reach
