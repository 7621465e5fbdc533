"""What a robot holds: a primitive that moves with a body, and the spheres that stand for it."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from vrrt_jax.scene.obstacles import Obstacle

_ROUND = 8  # spheres come in multiples of so many, so that worlds share their compiled functions


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HeldSpheres:
    """Spheres on links, beside the robot's own. Letters: ``h`` spheres."""

    link: np.ndarray  # (h,) int
    center: np.ndarray  # (h, 3) in the link's frame [m]
    radius: np.ndarray  # (h,) [m]
    # How far the centers were from obstacles where the object was gripped: they may always be so
    # near, whatever radius and margin are. Infinite where nothing is known [m].
    gripped_distance: np.ndarray  # (h,)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HeldObject:
    """An object that a body of the robot holds; for the host."""

    obstacle: Obstacle  # its pose is in the frame of the body
    body: str
    spheres: HeldSpheres
    bulge: float  # how far the spheres stick out of the object at most [m]
    # Obstacles that it stands on, and how deep it may be in them at most [m].
    supports: tuple[tuple[str, float], ...] = ()


def together(attached: Sequence[HeldObject]) -> HeldSpheres:
    """The spheres of all objects, as many as a multiple of eight: the last one is repeated."""
    parts = [held.spheres for held in attached]
    count = sum(len(part.radius) for part in parts)
    # Which to take: each once, then the last until they are enough.
    rows = np.minimum(np.arange(_ROUND * -(-count // _ROUND)), max(count - 1, 0))
    empty = HeldSpheres(
        link=np.zeros(0, int),
        center=np.zeros((0, 3)),
        radius=np.zeros(0),
        gripped_distance=np.zeros(0),
    )
    fields = {
        field.name: np.concatenate([getattr(part, field.name) for part in [empty, *parts]])[rows]
        for field in dataclasses.fields(HeldSpheres)
    }
    return HeldSpheres(**fields)
