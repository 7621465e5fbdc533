"""Spheres around a held object: few of them, and how far they stick out is known."""

import dataclasses
import functools
import itertools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence

import mujoco
import numpy as np

from vrrt_jax.robots.bounded_cover import cover_within
from vrrt_jax.robots.convex_parts import piece_of
from vrrt_jax.robots.geom_pieces import primitive_points
from vrrt_jax.robots.sphere_cover import MAX_BULGE, cover_geom
from vrrt_jax.scene.obstacle_kinds import KINDS

MOST_SPHERES = 24  # around one object
BULGE = 0.01  # [m] what they may stick out, where so many spheres are enough
_MOST_OF_LARGE = 1000  # around an object that would stick out too far otherwise
_MOST_SECTORS = 8  # of the ends of a cylinder
_RIM = 12  # corners of the prism around a cylinder, 3.5 % wider
_NUM_RADII = 40  # tried for the centers of such sectors


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Cover:
    """Spheres that contain a primitive."""

    center: np.ndarray  # (h, 3) in the frame of the primitive [m]
    radius: np.ndarray  # (h,) [m]
    bulge: float  # how far they stick out at most [m]


@functools.lru_cache(maxsize=64)
def cover(kind: str, size: tuple[float, float, float]) -> Cover:
    """Spheres around a primitive: a row for a capsule, bricks of a box, slices of a cylinder.

    The fewest are taken that stick out by :data:`BULGE`. Where :data:`MOST_SPHERES` are not enough
    for that, those are taken that stick out least, but where that is more than
    :data:`vrrt_jax.robots.sphere_cover.MAX_BULGE`, there are as many spheres as it takes.

    Args:
        kind: sphere, capsule, box or cylinder.
        size: as MuJoCo's geom size [m].

    Raises:
        ValueError: another kind.
    """
    if kind not in _CHOICES:
        raise ValueError(f"a {kind} cannot be held; expected one of: {', '.join(_CHOICES)}")
    choices = [c for c in _CHOICES[kind](np.asarray(size)) if len(c.radius) <= MOST_SPHERES]
    fine = [choice for choice in choices if choice.bulge <= BULGE + 1e-9]
    if fine:
        return min(fine, key=lambda choice: (len(choice.radius), choice.bulge))
    least = min(choices, key=lambda choice: choice.bulge)
    if least.bulge <= MAX_BULGE:
        return least
    points = primitive_points(KINDS[kind].geom, np.asarray(size))
    assert points is not None  # as obstacles are primitives
    rng = np.random.default_rng(0)
    found = cover_within([piece_of(*points)], MAX_BULGE, rng, most=_MOST_OF_LARGE)
    if found is None:
        warnings.warn(
            f"a {kind} of size {size} is too large to be held with care: spheres around it stick "
            f"out by up to {least.bulge:.2f} m, and the planner refuses what is nearer; hold "
            "several smaller objects in its stead",
            stacklevel=3,
        )
        return least
    return Cover(center=found[0], radius=found[1], bulge=MAX_BULGE)


def corners(kind: str, size: Sequence[float]) -> tuple[np.ndarray, float]:
    """Spheres of one radius whose convex hull is a primitive, or a little larger.

    Returns:
        Their centers (c, 3) in the frame of the primitive, and their radius [m].
    """
    if kind == "sphere":
        return np.zeros((1, 3)), size[0]
    if kind == "capsule":
        return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), size[0]
    if kind == "box":
        return np.array(list(itertools.product((-1, 1), repeat=3))) * size, 0.0
    angle = 2 * np.pi * np.arange(_RIM) / _RIM
    rim = size[0] / np.cos(np.pi / _RIM) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate(
        [np.column_stack([rim, np.full(_RIM, z)]) for z in (-size[1], size[1])]
    ), 0.0


def _sphere(size: np.ndarray) -> Iterator[Cover]:
    yield Cover(center=np.zeros((1, 3)), radius=size[:1], bulge=0.0)


def _rows(size: np.ndarray) -> Iterator[Cover]:
    """A capsule's axis in more and more gaps between centers."""
    for num_gaps in range(1, MOST_SPHERES):
        center, radius = cover_geom(mujoco.mjtGeom.mjGEOM_CAPSULE, size, size[1] / num_gaps)
        yield Cover(center=center, radius=radius, bulge=float(radius[0] - size[0]))


def _bricks(size: np.ndarray) -> Iterator[Cover]:
    """A box in bricks, with a sphere around each."""
    for counts in _counts(MOST_SPHERES):
        brick = size / counts
        ticks = [h * (2 * np.arange(n) + 1 - n) for h, n in zip(brick, counts, strict=True)]
        center = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        radius = np.linalg.norm(brick)
        yield Cover(
            center=center,
            radius=np.full(len(center), radius),
            bulge=float(radius - brick.min()),
        )


def _counts(most: int) -> Iterator[tuple[int, int, int]]:
    """All triples of positive numbers whose product is at most ``most``."""
    for first in range(1, most + 1):
        for second in range(1, most // first + 1):
            for third in range(1, most // (first * second) + 1):
                yield first, second, third


def _slices(size: np.ndarray) -> Iterator[Cover]:
    """A cylinder in slices of equal height, whose first and last are cut into sectors."""
    radius, half = size[:2]
    for num_slices, num_sectors in itertools.product(
        range(1, MOST_SPHERES + 1), (1, *range(3, _MOST_SECTORS + 1))
    ):
        num_ends = min(num_slices, 2)
        if num_slices - num_ends + num_ends * num_sectors > MOST_SPHERES:
            continue
        thickness = half / num_slices  # half of it
        heights = thickness * (2 * np.arange(num_slices) + 1 - num_slices)
        # Whole slices, between the ends.
        whole = np.hypot(radius, thickness)
        centers = [np.column_stack([np.zeros((num_slices, 2)), heights])[1:-1]]
        radii = [np.full(len(centers[0]), whole)]
        bulge = whole - radius if len(centers[0]) else 0.0
        # Sectors of the ends.
        off, reach = _sector(radius, thickness, num_sectors)
        angle = 2 * np.pi * np.arange(num_sectors) / num_sectors
        ring = off * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        for height in sorted({heights[0], heights[-1]}):
            centers.append(np.column_stack([ring, np.full(num_sectors, height)]))
            radii.append(np.full(num_sectors, reach))
        yield Cover(
            center=np.concatenate(centers),
            radius=np.concatenate(radii),
            bulge=float(max(bulge, reach - thickness, off + reach - radius)),
        )


def _sector(radius: float, thickness: float, num_sectors: int) -> tuple[float, float]:
    """Distance from the axis and radius of the sphere around a sector of a slice, the best one."""
    if num_sectors == 1:
        return 0.0, float(np.hypot(radius, thickness))
    off = np.linspace(0.0, radius, _NUM_RADII)
    # The farthest points of a sector are the ends of its arc, and its tip on the axis.
    corner = radius**2 + off**2 - 2 * radius * off * np.cos(np.pi / num_sectors)
    reach = np.sqrt(np.maximum(corner, off**2) + thickness**2)
    best = np.argmin(np.maximum(reach - thickness, off + reach - radius))
    return float(off[best]), float(reach[best])


_CHOICES: Mapping[str, Callable[[np.ndarray], Iterator[Cover]]] = {
    "sphere": _sphere,
    "capsule": _rows,
    "box": _bricks,
    "cylinder": _slices,
}
