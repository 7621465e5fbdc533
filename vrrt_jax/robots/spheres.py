"""Spheres that cover convex pieces."""

import dataclasses
from typing import Literal

import mujoco
import numpy as np

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.convex_parts import (
    Piece,
    collision_pieces,
    contain_surface,
    surface_samples,
    union_depth,
)

_SPACING = 0.004  # [m] between surface samples
_NUM_SURFACE, _NUM_CENTRES = 2000, 600  # for a body and for a piece
_LEAF = 2e-3  # [m]
_BULGE = 0.03  # [m] how far spheres fitted on loading stick out at most
_RELATIVE_BULGE = 0.1  # of the extent of the body, if that is less


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotSpheres:
    """The spheres of a robot."""

    cover: mjcf_writer.BodySpheres  # cover the moving bodies
    thin: mjcf_writer.BodySpheres  # for self-collision, on all bodies
    # "written" by fit_spheres, with the pairs to ignore; the file's "own"; or "fitted" just now:
    # then the thin ones cover their bodies too, and are too large for self-collision
    origin: Literal["written", "own", "fitted"]


def spheres_of(model: mujoco.MjModel) -> RobotSpheres:
    """Spheres of a robot: its own if its collision geoms are all spheres, else fitted ones.

    Args:
        model: a compiled robot with planned joints only.

    Raises:
        ValueError: it has no collision geom, or one that spheres cannot be fitted to.
    """
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(collides)
    if len(geoms) == 0:
        raise ValueError(
            "the robot has no collision geom: nothing to keep free of obstacles; expected geoms "
            "with contype or conaffinity: add them, or spheres"
        )
    if np.any(model.geom_type[geoms] != mujoco.mjtGeom.mjGEOM_SPHERE):
        return _fitted(model)
    is_cover, is_thin = (
        _is_kind(model, geoms, kind) for kind in (mjcf_writer.COVER, mjcf_writer.THIN)
    )
    has_kinds = bool(np.all(is_cover | is_thin))
    if not has_kinds:
        is_cover = is_thin = np.ones(len(geoms), bool)
    is_moving = model.body_weldid[model.geom_bodyid[geoms]] != 0
    return RobotSpheres(
        cover=_select(model, geoms[is_cover & is_moving]),
        thin=_select(model, geoms[is_thin]),
        origin="written" if has_kinds else "own",
    )


def _is_kind(model: mujoco.MjModel, geoms: np.ndarray, kind: dict[str, str]) -> np.ndarray:
    return (
        (model.geom_group[geoms] == int(kind["group"]))
        & (model.geom_contype[geoms] == int(kind["contype"]))
        & (model.geom_conaffinity[geoms] == int(kind["conaffinity"]))
    )


def _select(model: mujoco.MjModel, geoms: np.ndarray) -> mjcf_writer.BodySpheres:
    return mjcf_writer.BodySpheres(
        body=model.geom_bodyid[geoms],
        center=model.geom_pos[geoms],
        radius=model.geom_size[geoms, 0],
    )


def _fitted(model: mujoco.MjModel) -> RobotSpheres:
    rng = np.random.default_rng(0)
    body, center, radius = [], [], []
    bodies = collision_pieces(model)
    extents = {
        index: np.ptp(np.vstack([piece.vertices for piece in pieces]), axis=0).max()
        for index, pieces in bodies.items()
    }
    for index, pieces in bodies.items():
        # fine for small bodies, but without spending most spheres on the smallest
        own_bulge = max(extents[index], max(extents.values()) / 2) * _RELATIVE_BULGE
        own_bulge = min(own_bulge, _BULGE)
        centers, radii = cover_body(pieces, own_bulge, rng)
        body.append(np.full(len(radii), index))
        center.append(centers)
        radius.append(radii)
    owners, centers, radii = np.hstack(body), np.vstack(center), np.hstack(radius)
    moves = model.body_weldid[owners] != 0
    return RobotSpheres(
        cover=mjcf_writer.BodySpheres(
            body=owners[moves], center=centers[moves], radius=radii[moves]
        ),
        thin=mjcf_writer.BodySpheres(body=owners, center=centers, radius=radii),
        origin="fitted",
    )


def cover_body(
    pieces: list[Piece], bulge: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Greedy medial spheres that contain the surface of a body.

    Args:
        pieces: convex pieces of the body.
        bulge: how far a sphere may stick out of the piece that it lies in [m], give or take 2 mm.
        rng: source of randomness.

    Returns:
        Centers (n, 3) and radii (n,) [m].
    """
    surface = surface_samples(pieces, _SPACING, rng)
    if len(surface) > _NUM_SURFACE:
        surface = surface[rng.choice(len(surface), _NUM_SURFACE, replace=False)]
    centers = np.vstack([_inner_points(piece, rng) for piece in pieces])
    radii = union_depth(pieces, centers) + bulge
    covers = np.linalg.norm(surface[:, None] - centers, axis=-1) <= radii
    chosen = []
    while len(covers):
        best = int(np.argmax(covers.sum(0)))
        if not covers[:, best].any():
            break
        chosen.append(best)
        covers = covers[~covers[:, best]]
    return contain_surface(pieces, centers[chosen], radii[chosen], leaf=_LEAF)


def _inner_points(piece: Piece, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 3) where spheres may be centered, most of them far from the surface."""
    corners = piece.vertices[np.unique(piece.triangles)]
    points = rng.dirichlet(np.full(len(corners), 0.3), _NUM_CENTRES) @ corners
    spread = np.ptp(corners, axis=0).max() / 10
    for _ in range(30):  # uphill in depth, towards the medial axis; some stay on the way
        moved = points + rng.normal(size=points.shape) * spread
        better = piece.depth(moved) > piece.depth(points)
        better &= rng.random(len(points)) > 0.1
        points = np.where(better[:, None], moved, points)
        spread *= 0.9
    return points
