"""Floor plans: rooms by recursive splits, corridors, corners cut off, and doors.

All lengths and coordinates are in cells of 0.1 m.
"""

import dataclasses

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

WALL = -1  # label of walls and of what lies outside


@dataclasses.dataclass(frozen=True, kw_only=True)
class Room:
    """The rectangle [x0, x1) x [y0, y1) of a room in cells, without its walls, and its use."""

    kind: str  # a key of :data:`nrp_jax.homes.furniture.ROOMS`, or "door"
    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def area(self) -> int:
        """Number of cells."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FloorPlan:
    """Rooms, the openings between them, and the room of every cell."""

    rooms: tuple[Room, ...]
    doors: tuple[Room, ...]  # openings in walls, as rectangles
    labels: np.ndarray  # (X, Y) index of the room, len(rooms) for doors, -1 for walls and outside


def make_floor_plan(
    rng: np.random.Generator, side: int, width: int, depth: int, num_rooms: int
) -> FloorPlan:
    """Draw a plan.

    Args:
        rng: where the choices come from.
        side: cells of a side of the square map.
        width: cells of the home along x, outer walls included, in the middle of the map.
        depth: the same along y.
        num_rooms: rooms wanted beside corridors; fewer where they would be too small.
    """
    x, y = (side - width) // 2, (side - depth) // 2
    whole = Room(kind="", x0=x + 1, y0=y + 1, x1=x + width - 1, y1=y + depth - 1)
    rooms, corridors = [whole], []
    if rng.random() < 0.5:
        rooms, corridors = _split_off_corridor(rng, whole)
    while len(rooms) < num_rooms:
        rooms.sort(key=lambda room: room.area * rng.uniform(0.7, 1.0))
        parts = _split(rng, rooms.pop())
        rooms += parts
        if len(parts) == 1:
            break
    named = (*_name(rng, rooms), *corridors)
    labels = np.full((side, side), WALL)
    for index, room in enumerate(named):
        labels[room.x0 : room.x1, room.y0 : room.y1] = index
    _cut_corners(rng, labels, whole)
    return FloorPlan(rooms=named, doors=_doors(rng, named, labels), labels=labels)


def _split(rng: np.random.Generator, room: Room, shortest: int = 18) -> list[Room]:
    """Split a room by a wall across its longer side; the room itself if it is too small."""
    w, h = room.x1 - room.x0, room.y1 - room.y0
    across_x = w * rng.uniform(0.8, 1.25) > h
    length = w if across_x else h
    wall = int(rng.choice([1, 1, 2]))
    if length < 2 * shortest + wall:
        return [room]
    at = int(np.clip(length * rng.uniform(0.35, 0.65), shortest, length - shortest - wall))
    if across_x:
        cut = room.x0 + at
        return [dataclasses.replace(room, x1=cut), dataclasses.replace(room, x0=cut + wall)]
    cut = room.y0 + at
    return [dataclasses.replace(room, y1=cut), dataclasses.replace(room, y0=cut + wall)]


def _split_off_corridor(rng: np.random.Generator, whole: Room) -> tuple[list[Room], list[Room]]:
    """Split a home by a corridor from wall to wall: the parts on either side, and the corridor."""
    width = int(rng.integers(9, 16))
    along_x = rng.random() < 0.5
    length = whole.y1 - whole.y0 if along_x else whole.x1 - whole.x0
    at = int(length * rng.uniform(0.35, 0.65)) - width // 2
    first, second = ("y0", "y1") if along_x else ("x0", "x1")
    start = getattr(whole, first) + at
    corridor = dataclasses.replace(whole, kind="corridor", **{first: start, second: start + width})
    sides = [
        dataclasses.replace(whole, **{second: start - 1}),
        dataclasses.replace(whole, **{first: start + width + 1}),
    ]
    return sides, [corridor]


def _name(rng: np.random.Generator, rooms: list[Room]) -> list[Room]:
    """Give each room a use: the largest is the living room, the smallest is the bath."""
    rooms = sorted(rooms, key=lambda room: -room.area)
    others = ["kitchen", "bedroom", "bedroom", "office", "bedroom", "office"]
    kinds = ["living", *others[: len(rooms) - 2], "bath"]
    if rooms[-1].area > 1400:  # too large for a bath
        kinds[-1] = "bedroom"
    if len(kinds) > 3 and rng.random() < 0.5:
        kinds[1], kinds[2] = kinds[2], kinds[1]
    return [dataclasses.replace(room, kind=k) for room, k in zip(rooms, kinds, strict=True)]


def _cut_corners(rng: np.random.Generator, labels: np.ndarray, whole: Room) -> None:
    """Cut off up to three corners of the home; they lie outside then."""
    for corner in rng.permutation(4)[: rng.integers(0, 4)]:
        w, h = rng.integers(8, 22, 2)
        x = slice(whole.x0, whole.x0 + w) if corner < 2 else slice(whole.x1 - w, whole.x1)
        y = slice(whole.y0, whole.y0 + h) if corner % 2 else slice(whole.y1 - h, whole.y1)
        if len(np.unique(labels[x, y])) == 1:  # a corner belongs to one room
            labels[x, y] = WALL


def _doors(
    rng: np.random.Generator, rooms: tuple[Room, ...], labels: np.ndarray
) -> tuple[Room, ...]:
    """Open doors along a random spanning tree of the rooms, and up to two more."""
    # All doors that are possible; those to a corridor or the living room are preferred.
    n = len(rooms)
    doors = {}
    weight = np.zeros((n, n))
    for a in range(n):
        for b in range(a + 1, n):
            door = _door(rng, rooms[a], rooms[b], labels)
            if door is not None:
                hub = {"corridor", "living"} & {rooms[a].kind, rooms[b].kind}
                doors[a, b], weight[a, b] = door, rng.uniform(0.1, 1) + (0 if hub else 1)
    # The tree connects all rooms, and the spare doors make loops.
    tree = minimum_spanning_tree(weight).tocoo()
    chosen = list(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    spare = [pair for pair in doors if pair not in chosen]
    extra = rng.permutation(len(spare))[: rng.integers(0, 3)]
    chosen += [spare[i] for i in extra]
    for pair in chosen:
        door = doors[pair]
        labels[door.x0 : door.x1, door.y0 : door.y1] = n
    return tuple(doors[pair] for pair in chosen)


def _door(rng: np.random.Generator, a: Room, b: Room, labels: np.ndarray) -> Room | None:
    """Draw an opening in the wall between two rooms; None if they share no wall long enough."""
    if b.x1 < a.x0 or b.y1 < a.y0:
        a, b = b, a
    beside_x = 1 <= b.x0 - a.x1 <= 2
    if not beside_x and not 1 <= b.y0 - a.y1 <= 2:
        return None
    if beside_x:
        low, high, before, after = max(a.y0, b.y0), min(a.y1, b.y1), a.x1, b.x0
        passable = (labels[before - 1] >= 0) & (labels[after] >= 0)
    else:
        low, high, before, after = max(a.x0, b.x0), min(a.x1, b.x1), a.y1, b.y0
        passable = (labels[:, before - 1] >= 0) & (labels[:, after] >= 0)
    # The part of the wall that has a room on both sides.
    where = low + np.flatnonzero(passable[low:high])
    if len(where) < 12:
        return None
    low, high = int(where[0]), int(where[-1]) + 1
    # Most doors are narrow; some are wide, and a few nearly as wide as the wall.
    style, narrow = rng.random(), "bath" in (a.kind, b.kind)
    width = int(rng.integers(8, 11) if style < 0.7 or narrow else rng.integers(10, 13))
    if style > 0.85 and not narrow:
        width = int(rng.integers(18, 21))
        if style > 0.93:
            width = high - low - 4
    width = min(width, high - low - 2)
    # Doors are near the end of the wall more often than not.
    last = high - width - 1
    near_end = [low + 1 + int(rng.integers(0, 3)), last - int(rng.integers(0, 3))]
    start = int(rng.choice(near_end) if rng.random() < 0.6 else rng.integers(low + 1, last + 1))
    start = int(np.clip(start, low + 1, last))
    if beside_x:
        return Room(kind="door", x0=before, x1=after, y0=start, y1=start + width)
    return Room(kind="door", x0=start, x1=start + width, y0=before, y1=after)
