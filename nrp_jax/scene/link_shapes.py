"""A robot against itself: the capsules and boxes of its links, and its round base, exactly."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.types import pytree, static
from vrrt_jax.robots.kinematics import place, placement
from vrrt_jax.robots.self_collision import checked_pairs

_HALVINGS = 9  # of a capsule's axis, in search of its nearest point to a convex solid


@pytree
class LinkShapes:
    """Capsules (spheres too, as short ones) and boxes on links, and which pairs are checked.

    Letters: ``M`` capsules, ``N`` boxes.
    """

    ends: jax.Array  # (L * 4, 2 M) placement of the axes' ends, all first ones before
    radius: jax.Array  # (M,) [m]
    box_center: jax.Array  # (N, 3) in the links' frames [m]
    box_rotation: jax.Array  # (N, 3, 3) to the links' frames
    box_half: jax.Array  # (N, 3) [m]
    link: tuple[int, ...] = static()  # (M,) of the capsules
    box_link: tuple[int, ...] = static()  # (N,)
    pairs: tuple[tuple[int, int], ...] = static()  # of capsules
    box_pairs: tuple[tuple[int, int], ...] = static()  # a capsule and a box


def link_shapes(
    model: mujoco.MjModel, geoms: np.ndarray, body_link: np.ndarray, body_in_link: np.ndarray
) -> LinkShapes:
    """The shapes of a model's geoms.

    Args:
        model: a compiled robot.
        geoms: (g,) indices of its spheres, capsules and boxes.
        body_link: (bodies,) link of each body.
        body_in_link: (bodies, 4, 4) frame of each body in its link.

    Raises:
        ValueError: two boxes would have to be checked against each other.
    """
    kind, is_box = mujoco.mjtGeom, model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_BOX
    rotation, center = np.zeros((len(geoms), 3, 3)), np.zeros((len(geoms), 3))
    for row, geom in enumerate(geoms):
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, model.geom_quat[geom])
        pose = body_in_link[model.geom_bodyid[geom]]
        rotation[row] = pose[:3, :3] @ turned.reshape(3, 3)
        center[row] = pose[:3, :3] @ model.geom_pos[geom] + pose[:3, 3]
    # A capsule's axis is its z; a sphere is a capsule without length.
    is_capsule = model.geom_type[geoms] == kind.mjGEOM_CAPSULE
    half = (rotation[:, :, 2] * (model.geom_size[geoms, 1] * is_capsule)[:, None])[~is_box]
    link = body_link[model.geom_bodyid[geoms]]
    ends = np.concatenate([center[~is_box] - half, center[~is_box] + half])
    # Pairs as MuJoCo has them, sorted by kind; rows count capsules and boxes apart.
    row = np.where(is_box, np.cumsum(is_box), np.cumsum(~is_box)) - 1
    pairs, box_pairs = [], []
    for first, second in checked_pairs(model, geoms).tolist():
        if is_box[first] and is_box[second]:
            raise ValueError("boxes on two links cannot be checked against each other")
        if is_box[first]:
            first, second = second, first
        (box_pairs if is_box[second] else pairs).append((int(row[first]), int(row[second])))
    return LinkShapes(
        ends=jnp.asarray(placement(np.tile(link[~is_box], 2), ends, int(body_link.max()) + 1)),
        radius=jnp.asarray(model.geom_size[geoms[~is_box], 0], jnp.float32),
        box_center=jnp.asarray(center[is_box], jnp.float32),
        box_rotation=jnp.asarray(rotation[is_box], jnp.float32),
        box_half=jnp.asarray(model.geom_size[geoms[is_box]], jnp.float32),
        link=tuple(link[~is_box].tolist()),
        box_link=tuple(link[is_box].tolist()),
        pairs=tuple(pairs),
        box_pairs=tuple(box_pairs),
    )


def axes(shapes: LinkShapes, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where the capsules' axes start (3, M) and where they lead (3, M) [m].

    Args:
        shapes: from :func:`link_shapes`.
        poses: (L, 4, 4) of the links.
    """
    # The barrier keeps XLA's CPU fusions from placing the ends once for every use.
    ends = jax.lax.optimization_barrier(place(shapes.ends, poses))
    num = len(shapes.link)
    return ends[:, :num], ends[:, num:] - ends[:, :num]


def gaps(
    shapes: LinkShapes, poses: jax.Array, start: jax.Array, axis: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Gaps (P,) between pairs of capsules and (P',) between capsules and boxes [m].

    They are negative where the shapes overlap, and not exact there.

    Args:
        shapes: from :func:`link_shapes`.
        poses: (L, 4, 4) of the links.
        start: (3, M) and
        axis: (3, M) from :func:`axes`.
    """
    first, second = np.array(shapes.pairs, int).reshape(-1, 2).T
    pairs = (start[:, first], axis[:, first], start[:, second], axis[:, second])
    between = _between_segments(*jax.lax.optimization_barrier(pairs))
    between = between - shapes.radius[first] - shapes.radius[second]
    # The capsules' axes in the frames of the boxes.
    capsule, box = np.array(shapes.box_pairs, int).reshape(-1, 2).T
    pose = poses[np.array(shapes.box_link, int)]
    turned = pose[:, :3, :3] @ shapes.box_rotation
    middle = jnp.einsum("nij,nj->ni", pose[:, :3, :3], shapes.box_center) + pose[:, :3, 3]
    local = jnp.einsum("pji,jp->ip", turned[box], start[:, capsule] - middle[box].T)
    local_axis = jnp.einsum("pji,jp->ip", turned[box], axis[:, capsule])
    local, local_axis = jax.lax.optimization_barrier((local, local_axis))
    to_box = _segment_to_box(local, local_axis, shapes.box_half[box].T)
    return between, to_box - shapes.radius[capsule]


def _between_segments(p: jax.Array, u: jax.Array, q: jax.Array, v: jax.Array) -> jax.Array:
    """Distances (P,) between segments from (3, P) along (3, P); points are short segments."""
    apart = p - q
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    up, vp = _dot(u, apart), _dot(v, apart)
    # The nearest points of the two lines, then what the segments allow, one after the other.
    tiny = 1e-12
    slope = uu * vv - uv * uv
    s = jnp.where(slope > 1e-7 * uu * vv, (uv * vp - up * vv) / jnp.maximum(slope, tiny), 0.5)
    s = jnp.clip(s, 0, 1)
    t = jnp.clip((uv * s + vp) / jnp.maximum(vv, tiny), 0, 1)
    s = jnp.clip((uv * t - up) / jnp.maximum(uu, tiny), 0, 1)
    t = jnp.clip((uv * s + vp) / jnp.maximum(vv, tiny), 0, 1)
    nearest = apart + s * u - t * v
    return jnp.sqrt(_dot(nearest, nearest))


def _segment_to_box(start: jax.Array, axis: jax.Array, half: jax.Array) -> jax.Array:
    """Lower bounds (P,) of distances from segments (3, P) to boxes (3, P) around the origin."""
    return _segment_to(start, axis, lambda point: point - jnp.clip(point, -half, half))


def segment_to_cylinder(
    start: jax.Array, axis: jax.Array, radius: jax.Array, height: jax.Array
) -> jax.Array:
    """Lower bounds (P,) of distances from segments (3, P) to a cylinder at the origin.

    The cylinder of a ``radius`` () stands upright and reaches up to a ``height`` (), from below all
    else.
    """

    def outside(point: jax.Array) -> jax.Array:
        beside = jnp.sqrt(_dot(point * jnp.array([[1.0], [1.0], [0.0]]), point))
        share = jnp.maximum(1 - radius / jnp.maximum(beside, 1e-9), 0)
        return jnp.stack([point[0] * share, point[1] * share, jnp.maximum(point[2] - height, 0)])

    return _segment_to(start, axis, outside)


def _segment_to(
    start: jax.Array, axis: jax.Array, outside: Callable[[jax.Array], jax.Array]
) -> jax.Array:
    """Lower bounds (P,) of distances from segments (3, P) to convex solids.

    The distance is convex along a segment, so that its slope tells in which half the nearest point
    is.

    Args:
        start: (3, P) and
        axis: (3, P) of the segments.
        outside: of points (3, P), the steps (3, P) to them from the nearest points of the solids.
    """

    def halve(_: Any, bounds: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bounds
        middle = (low + high) / 2
        rises = _dot(outside(start + middle * axis), axis) > 0
        return jnp.where(rises, low, middle), jnp.where(rises, middle, high)

    low = jnp.zeros_like(start[0])
    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (low, low + 1))
    nearest = outside(start + (low + high) / 2 * axis)
    return jnp.sqrt(_dot(nearest, nearest)) - jnp.sqrt(_dot(axis, axis)) / 2 ** (_HALVINGS + 1)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
