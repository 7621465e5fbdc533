"""Cover geoms with spheres, as a robot is loaded.

There are two coverings, because the two packages ask for different things.

* :func:`cover_primitives` divides a box into bricks and a capsule into slices. It is exact and
  regular: the same geom always gives the same spheres, and no random number is drawn. It knows
  spheres, capsules and boxes only. The mobile robots of :mod:`nrp_jax` are made of these.
* :func:`cover_convex_parts` takes any collision geom, meshes too, as convex pieces. It chooses
  spheres one by one, each time the one that covers most of what is still bare. It needs far fewer
  spheres than bricks would. Robots from a file that does not bring spheres are loaded with it.

Neither can replace the other without new spheres for robots that planners were tuned or trained
with. Both return :class:`vrrt_jax.robots.kinematics.BodySpheres`.

This module is not :mod:`vrrt_jax.robots.sphere_fit`, which spends minutes on the best spheres for
the command ``vrrt spheres``.
"""

import warnings
from collections.abc import Iterator

import mujoco
import numpy as np

from vrrt_jax.robots.bounded_cover import cover_within
from vrrt_jax.robots.geom_pieces import collision_pieces
from vrrt_jax.robots.kinematics import BodySpheres

MAX_BULGE = 0.03  # [m] how far spheres stick out of the bodies of a loaded robot at most
_FINE_BULGE, _FEW_SPHERES = 0.02, 12  # [m] of a body that so many spheres are enough for
_RELATIVE_BULGE = 0.1  # of the extent of the body, if that is less
MOST_SPHERES = 2000  # of one body
_ROUNDING = 1e-6  # a length is divided into n parts if it exceeds n parts by less


def cover_primitives(
    model: mujoco.MjModel,
    geoms: np.ndarray,
    grain: np.ndarray,
    *,
    planar: bool = False,
) -> tuple[BodySpheres, np.ndarray]:
    """Spheres that cover geoms of primitive kinds.

    Args:
        model: a compiled robot.
        geoms: (g,) indices of the geoms to cover: spheres, capsules and boxes.
        grain: (g,) half the longest side of a brick, half the longest gap between two spheres [m].
        planar: heights do not matter, so that boxes are covered as flat rectangles.

    Returns:
        The spheres, geom by geom, and the geom (n,) that each sphere belongs to.

    Raises:
        ValueError: a geom of another kind.
    """
    used_axes = [1, 1, 0] if planar else [1, 1, 1]
    centers_of_geoms, radii_of_geoms = [], []
    for geom, own_grain in zip(geoms, grain, strict=True):
        centers, radii = cover_geom(
            mujoco.mjtGeom(model.geom_type[geom]),
            model.geom_size[geom] * used_axes,
            float(own_grain),
        )
        # The centers are in the geom's frame: bring them to the frame of its body.
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        centers_of_geoms.append(centers @ rotation.reshape(3, 3).T + model.geom_pos[geom])
        radii_of_geoms.append(radii)
    owner = np.repeat(geoms, [len(radii) for radii in radii_of_geoms])
    spheres = BodySpheres(
        body=model.geom_bodyid[owner],
        center=np.concatenate(centers_of_geoms),
        radius=np.concatenate(radii_of_geoms),
    )
    return spheres, owner


def cover_geom(
    kind: mujoco.mjtGeom, size: np.ndarray, grain: float
) -> tuple[np.ndarray, np.ndarray]:
    """Spheres that cover one geom: a box brick by brick, a capsule along its axis.

    Args:
        kind: sphere, capsule or box.
        size: (3,) as MuJoCo's [m].
        grain: half the longest side of a brick, half the longest gap between two spheres [m].

    Returns:
        Centers (n, 3) in the geom's frame and radii (n,) [m].

    Raises:
        ValueError: another kind.
    """
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), size[:1]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        radius, half = size[:2]
        num_gaps = int(np.ceil(half / grain - _ROUNDING))
        centers = np.zeros((num_gaps + 1, 3))
        centers[:, 2] = np.linspace(-half, half, num_gaps + 1)
        # Midway between two centers the spheres must still reach the capsule's surface.
        return centers, np.full(num_gaps + 1, np.hypot(radius, half / num_gaps))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        counts = np.maximum(np.ceil(size / grain - _ROUNDING), 1).astype(int)
        ticks = [h * (2 * np.arange(n) + 1 - n) / n for h, n in zip(size, counts, strict=True)]
        centers = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        # A sphere around a brick has half the brick's diagonal as its radius.
        return centers, np.full(len(centers), np.linalg.norm(size / counts))
    raise ValueError(f"geom of kind {kind.name}: expected spheres, capsules and boxes")


def cover_convex_parts(model: mujoco.MjModel, *, most: int = MOST_SPHERES) -> BodySpheres:
    """Spheres that cover all collision geoms of a model, whatever their shapes.

    They stick out of each body by at most 10 % of its extent, and by at most 3 cm, if ``most`` of
    them are enough for that. Bodies made of spheres keep these.

    Args:
        model: a compiled robot.
        most: number of spheres that no body has more of.

    Returns:
        The spheres, body by body; the same for the same model.

    Raises:
        ValueError: a geom has a shape that has no convex hull here.
    """
    rng = np.random.default_rng(0)
    pieces_of_bodies = collision_pieces(model)
    extents = {
        body: np.ptp(np.vstack([piece.vertices for piece in pieces]), axis=0).max()
        for body, pieces in pieces_of_bodies.items()
    }
    owners, centers, radii = [], [], []
    for body, pieces in pieces_of_bodies.items():
        # Small bodies get a fine cover, but the smallest must not use up most of the spheres.
        fine = max(extents[body], max(extents.values()) / 2) * _RELATIVE_BULGE
        found, bulge = _own_spheres(model, body), 0.0
        for wanted, enough in _choices(most):
            if found is None:
                bulge = min(wanted, fine) if wanted <= MAX_BULGE else wanted
                found = cover_within(pieces, bulge, rng, most=enough)
        assert found is not None  # as the coarsest spheres are larger than any robot
        if bulge > MAX_BULGE and most == MOST_SPHERES:
            warnings.warn(
                f"body '{model.body(body).name}' is so large that {most} spheres, the most for one "
                f"body, stick out of it by up to {bulge:g} m; expected {MAX_BULGE} m: the planner "
                "refuses what is nearer; give the body simpler shapes, or check the file's units",
                stacklevel=5,
            )
        owners.append(np.full(len(found[1]), body))
        centers.append(found[0])
        radii.append(found[1])
    return BodySpheres(body=np.hstack(owners), center=np.vstack(centers), radius=np.hstack(radii))


def _choices(most: int) -> Iterator[tuple[float, int]]:
    """How far spheres may stick out [m], and how many there may be: finer ones if few are enough.

    The bulge doubles where ``most`` spheres are not enough for :data:`MAX_BULGE`.
    """
    yield _FINE_BULGE, min(most, _FEW_SPHERES)
    yield from ((MAX_BULGE * 2**k, most) for k in range(20))


def _own_spheres(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Centers (n, 3) and radii (n,) of the geoms of a body; None if some are no spheres [m]."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(collides & (model.geom_bodyid == body))
    if np.any(model.geom_type[geoms] != mujoco.mjtGeom.mjGEOM_SPHERE):
        return None
    return model.geom_pos[geoms], model.geom_size[geoms, 0]
