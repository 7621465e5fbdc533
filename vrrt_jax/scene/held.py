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
    spheres: HeldSpheres  # contain the object
    bulge: float  # how far they stick out of it at most [m]
    grip: "Grip | None" = None  # where it was gripped, if that is known


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Grip:
    """What stood near an object where it was gripped. Letters: ``c`` corners."""

    corners: HeldSpheres  # of the object, where its spheres stick out into something
    # Distances (h + c,) of the centers of spheres and corners to obstacles, by name: they may
    # always be so near to these obstacles, whatever radius and margin are [m].
    distances: Mapping[str, np.ndarray]
    # How deep the object may be in obstacles that it was gripped on or beside, by name [m].
    supports: Mapping[str, float]


def together(attached: Sequence[HeldObject], *, with_corners: bool) -> HeldSpheres:
    """The spheres of all objects, as many as a multiple of eight: the last one is repeated."""
    parts = [part for held in attached for part in _parts(held, with_corners)]
    rows = _rows(sum(len(part.radius) for part in parts))
    return HeldSpheres(
        link=np.concatenate([np.zeros(0, int), *(part.link for part in parts)])[rows],
        center=np.concatenate([np.zeros((0, 3)), *(part.center for part in parts)])[rows],
        radius=np.concatenate([np.zeros(0), *(part.radius for part in parts)])[rows],
    )


def gripped_distances(attached: Sequence[HeldObject], names: Sequence[str]) -> np.ndarray:
    """How near these spheres, corners among them, may always be to obstacles of these names (K,).

    Returns:
        (h, K) [m], infinite where nothing is allowed.
    """
    found = [np.zeros((0, len(names)))]
    for held in attached:
        nothing = np.full(sum(len(part.radius) for part in _parts(held, True)), np.inf)
        known = held.grip.distances if held.grip else {}
        columns = [known.get(name, nothing) for name in names]
        found.append(np.reshape(columns, (len(names), len(nothing))).T)
    distances = np.concatenate(found)
    return distances[_rows(len(distances))]


def _parts(held: HeldObject, with_corners: bool) -> list[HeldSpheres]:
    return [held.spheres, *([held.grip.corners] if held.grip and with_corners else [])]


def _rows(count: int) -> np.ndarray:
    """Which spheres to take: each once, then the last until they are enough."""
    return np.minimum(np.arange(_ROUND * -(-count // _ROUND)), max(count - 1, 0))
