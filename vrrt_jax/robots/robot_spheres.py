"""The spheres and polytopes that a robot is loaded with: its file's, or made just now."""

import dataclasses
from typing import Literal

import mujoco
import numpy as np

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.kinematics import BodySpheres
from vrrt_jax.robots.polytopes import outer_polytopes, read_polytopes
from vrrt_jax.robots.sphere_cover import cover_convex_parts

_MOST_SELF_COLLISION = 100  # self-collision spheres of one body


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotSpheres:
    """The spheres of a robot, of two kinds, and where they come from."""

    collision: BodySpheres  # cover the moving bodies: checked against obstacles
    self_collision: BodySpheres  # on all bodies: checked against each other
    # "written": by the command `vrrt spheres`, with the pairs of bodies to ignore.
    # "own": all collision geoms of the file are spheres, and serve for both kinds.
    # "fitted": the file has other geoms, covered just now. The self-collision spheres then cover
    # their bodies too, and are too large for their purpose until their radii are fitted.
    origin: Literal["written", "own", "fitted"]
    # By body the vertices (V, 3) of what contains it more tightly, in its frame [m]; none of
    # bodies that are spheres.
    polytopes: dict[int, list[np.ndarray]]


def spheres_of(model: mujoco.MjModel) -> RobotSpheres:
    """Spheres of a robot: its own if its collision geoms are all spheres, else a cover of them.

    Args:
        model: a compiled robot with planned joints only.

    Raises:
        ValueError: it has no collision geom, or one that spheres cannot be fitted to.
    """
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    if np.any(_is_kind(model, np.arange(model.ngeom), mjcf_writer.COLLISION_GEOM)):
        collides &= ~mjcf_writer.is_polytope(model)  # as `vrrt spheres` writes them
    geoms = np.flatnonzero(collides)
    if len(geoms) == 0:
        raise ValueError(
            "the robot has no collision geom: nothing to keep free of obstacles; expected geoms "
            "with contype or conaffinity: add them, or spheres"
        )
    if np.any(model.geom_type[geoms] != mujoco.mjtGeom.mjGEOM_SPHERE):
        cover = fine = cover_convex_parts(model)
        # Every pair of self-collision spheres is checked: large bodies get fewer.
        if np.bincount(cover.body).max() > _MOST_SELF_COLLISION:
            cover = cover_convex_parts(model, most=_MOST_SELF_COLLISION)
        return RobotSpheres(
            collision=_on_moving_bodies(model, fine),
            self_collision=cover,
            origin="fitted",
            polytopes=outer_polytopes(model),
        )
    # A file that `vrrt spheres` wrote marks both kinds by their groups and contact bits.
    is_collision = _is_kind(model, geoms, mjcf_writer.COLLISION_GEOM)
    is_self_collision = _is_kind(model, geoms, mjcf_writer.SELF_COLLISION_GEOM)
    has_kinds = bool(np.all(is_collision | is_self_collision))
    if not has_kinds:
        is_collision = is_self_collision = np.ones(len(geoms), bool)
    return RobotSpheres(
        collision=_on_moving_bodies(model, _read(model, geoms[is_collision])),
        self_collision=_read(model, geoms[is_self_collision]),
        origin="written" if has_kinds else "own",
        polytopes=read_polytopes(model) if has_kinds else {},
    )


def _is_kind(model: mujoco.MjModel, geoms: np.ndarray, kind: dict[str, str]) -> np.ndarray:
    return (
        (model.geom_group[geoms] == int(kind["group"]))
        & (model.geom_contype[geoms] == int(kind["contype"]))
        & (model.geom_conaffinity[geoms] == int(kind["conaffinity"]))
    )


def _read(model: mujoco.MjModel, geoms: np.ndarray) -> BodySpheres:
    return BodySpheres(
        body=model.geom_bodyid[geoms],
        center=model.geom_pos[geoms],
        radius=model.geom_size[geoms, 0],
    )


def _on_moving_bodies(model: mujoco.MjModel, spheres: BodySpheres) -> BodySpheres:
    # The fixed base may touch obstacles: it cannot get out of their way.
    moves = model.body_weldid[spheres.body] != 0
    return BodySpheres(
        body=spheres.body[moves], center=spheres.center[moves], radius=spheres.radius[moves]
    )
