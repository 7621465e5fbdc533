"""The convex pieces that a robot's collision geoms are made of."""

import mujoco
import numpy as np

from vrrt_jax.robots.convex_parts import STEP, Piece, piece_of

_ROUND_SIDES = 20  # sides of the prism around a cylinder, 1.2 % wider; 2.5 % for other round shapes
_ROUND_EXCESS = 3e-3  # [m] large ones get more sides, so that polytopes stick out less than this
_FLAT = 1e-4  # of its length: a thinner mesh has no hull of its own, and is made so thick


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
        points, excess = _geom_points(model, geom)
        piece = piece_of(in_body(model, geom, points), excess)
        pieces.setdefault(int(model.geom_bodyid[geom]), []).append(piece)
    return pieces


def in_body(model: mujoco.MjModel, geom: int, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) in the frame of a geom as they are in the frame of its body."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return points @ rotation.reshape(3, 3).T + model.geom_pos[geom]


def mesh_points(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The vertices (n, 3) of a mesh geom, in its frame [m]."""
    mesh = model.geom_dataid[geom]
    start = model.mesh_vertadr[mesh]
    return np.asarray(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], np.float64)


def _geom_points(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Points (n, 3) in the geom's frame whose hull contains it, and the hull's excess [m]."""
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return solid(mesh_points(model, geom)), 0.0
    found = primitive_points(kind, model.geom_size[geom])
    if found is None:
        name = model.body(model.geom_bodyid[geom]).name
        raise ValueError(
            f"a collision geom of body '{name}' is a {kind.name[7:].lower()}; expected sphere, "
            "box, capsule, cylinder, ellipsoid or mesh: replace it"
        )
    return found


def primitive_points(kind: mujoco.mjtGeom, size: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Points (n, 3) whose hull contains a primitive, and how far it sticks out at most [m].

    Args:
        kind: None is returned for those that are no primitive.
        size: (3,) as MuJoCo's [m].
    """
    kinds = mujoco.mjtGeom
    if kind == kinds.mjGEOM_BOX:
        return _corners() * size, 0.0
    sides = _sides(size.max() if kind == kinds.mjGEOM_ELLIPSOID else size[0])
    wider = 1 / np.cos(np.pi / sides) - 1
    if kind == kinds.mjGEOM_CYLINDER:
        rim = [_circle(sides, size[0], z) for z in (-size[1], size[1])]
        return np.vstack(rim), wider * size[0]
    wider = (1 + wider) ** 2 - 1
    if kind == kinds.mjGEOM_SPHERE:
        return _ball(sides) * size[0], wider * size[0]
    if kind == kinds.mjGEOM_ELLIPSOID:
        return _ball(sides) * size, wider * size.max()
    if kind == kinds.mjGEOM_CAPSULE:
        ball = _ball(sides) * size[0]
        return np.vstack([ball + [0, 0, z] for z in (-size[1], size[1])]), wider * size[0]
    return None


def _corners() -> np.ndarray:
    return np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3).astype(float)


def _sides(radius: float) -> int:
    """Sides of a polytope around a shape of a radius, an even number of them."""
    needed = np.pi * np.sqrt(radius / _ROUND_EXCESS)
    return max(_ROUND_SIDES, 2 * int(np.ceil(needed / 2)))


def _circle(sides: int, radius: float, z: float) -> np.ndarray:
    angle = np.arange(sides) * (2 * np.pi / sides)
    radius = radius / np.cos(np.pi / sides)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, z)], -1)


def _ball(sides: int) -> np.ndarray:
    """Vertices (n, 3) of a polytope around the unit sphere."""
    rings = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    points = np.vstack([_circle(sides, np.cos(a), np.sin(a)) for a in rings])
    return points / np.cos(np.pi / sides)


def solid(points: np.ndarray) -> np.ndarray:
    """The points (n, 3), with some beside those of a flat mesh: its hull has no volume."""
    middle = points - points.mean(axis=0)
    thickness = np.ptp(middle @ np.linalg.svd(middle.T @ middle)[0], axis=0)
    if thickness.min() > _FLAT * thickness.max():
        return points
    offset = _FLAT * max(thickness.max(), STEP) * _corners()
    return np.vstack([points + corner for corner in offset])
