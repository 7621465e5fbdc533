"""What a robot holds: a primitive that moves with a body, and the spheres that stand for it."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from vrrt_jax.scene.obstacles import Obstacle

_ROUND = 8  # spheres come in multiples of so many, so that worlds share their compiled functions


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HeldSpheres:
    """Spheres on links, beside the robot's own. Letters: ``h`` spheres."""

    link: np.ndarray  # (h,) int
    center: np.ndarray  # (h, 3) in the link's frame [m]
    radius: np.ndarray  # (h,) [m]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HeldObject:
    """An object that a body of the robot holds; for the host."""

    obstacle: Obstacle  # its pose is in the frame of the body
    body: str
    spheres: HeldSpheres
    bulge: float  # how far the spheres stick out of the object at most [m]
    # Distances (h,) of the spheres' centers to obstacles, by name, where the object was gripped:
    # they may always be so near to these obstacles, whatever radius and margin are [m].
    gripped_distances: Mapping[str, np.ndarray]
    # How deep the object may be in obstacles that it was gripped on or beside, by name [m].
    supports: Mapping[str, float]


def together(attached: Sequence[HeldObject]) -> HeldSpheres:
    """The spheres of all objects, as many as a multiple of eight: the last one is repeated."""
    spheres = [held.spheres for held in attached]
    rows = _rows(attached)
    return HeldSpheres(
        link=np.concatenate([np.zeros(0, int), *(own.link for own in spheres)])[rows],
        center=np.concatenate([np.zeros((0, 3)), *(own.center for own in spheres)])[rows],
        radius=np.concatenate([np.zeros(0), *(own.radius for own in spheres)])[rows],
    )


def gripped_distances(attached: Sequence[HeldObject], names: Sequence[str]) -> np.ndarray:
    """How near these spheres may always be to obstacles of these names (K,).

    Returns:
        (h, K) [m], infinite where nothing is allowed.
    """
    found = [np.zeros((0, len(names)))]
    for held in attached:
        nothing = np.full(len(held.spheres.radius), np.inf)
        columns = [held.gripped_distances.get(name, nothing) for name in names]
        found.append(np.reshape(columns, (len(names), len(nothing))).T)
    return np.concatenate(found)[_rows(attached)]


def _rows(attached: Sequence[HeldObject]) -> np.ndarray:
    """Which spheres to take: each once, then the last until they are enough."""
    count = sum(len(held.spheres.radius) for held in attached)
    return np.minimum(np.arange(_ROUND * -(-count // _ROUND)), max(count - 1, 0))
