"""Homes for training: random floor plans with furniture, as occupancy grids.

They stand in for the scanned homes of the Neural Randomized Planner (Lu et al. 2024): rooms by
recursive splits, corridors, doors, furniture of real sizes and the rags of a scan. Everything is in
cells of 0.1 m; the same seed gives the same home.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.sparse.csgraph import minimum_spanning_tree

from nrp_jax.furniture import FREE_STANDING, HEIGHT, MAKERS, ROOMS
from nrp_jax.grid import Grid

VERSION = 1  # of the generator; a data set remembers it
CELLS = {"snake": 100, "fetch": 150}  # sides of the grids
BODY = {"snake": 10, "fetch": 15}  # cells of height that a robot's base and trunk meet
SPREAD = 4  # cells that placing furniture keeps free around the base
ERODE = 0.3  # [m] around the base where the free space must be connected
MIN_ROOMS = 4
_WALL = -1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Room:
    """A room's rectangle [x0, x1) x [y0, y1) in cells, walls outside, and its use."""

    kind: str
    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def area(self) -> int:
        """Number of cells."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class House:
    """A home, and what it was made of."""

    seed: int
    kind: str  # "snake" or "fetch": the robot it is made for
    grid: Grid  # occupancy (X, Y, 20)
    rooms: tuple[Room, ...]
    doors: tuple[Room, ...]  # openings in walls, as rectangles
    walls: np.ndarray  # (X, Y) bool

    def plan(self) -> Grid:
        """The home seen by a robot that stays in the plane: (X, Y, 1), below 1 m."""
        return self.grid.flatten(0.0, 1.0)


def generate_house(seed: int, kind: str = "snake", clutter: float = 1.0) -> House:
    """Make a home.

    Args:
        seed: the same seed, kind and clutter give the same home.
        kind: "snake" for 10 x 10 m, "fetch" for 12 to 15 m in a grid of 15 m.
        clutter: multiple of the usual amount of furniture beyond what each room needs.

    Raises:
        ValueError: the kind is unknown.
    """
    if kind not in CELLS:
        raise ValueError(f"unknown kind of home '{kind}'; have: {', '.join(CELLS)}")
    for attempt in range(100):
        rng = np.random.default_rng([VERSION, seed, attempt, CELLS[kind]])
        house = _attempt(rng, seed, kind, clutter)
        if len(house.rooms) >= MIN_ROOMS and is_connected(house.grid, kind):
            return house
    raise RuntimeError(f"no home came out of seed {seed} in 100 attempts; take another seed")


def is_connected(grid: Grid, kind: str) -> bool:
    """Whether the floor where the base has 0.3 m of air around it is one piece."""
    return int(ndimage.label(_floor(grid.occupied, kind))[1]) == 1


def _floor(occupied: np.ndarray, kind: str) -> np.ndarray:
    plan = occupied[:, :, : BODY[kind]].any(2)
    # Distances run between centres of cells: half a cell of each belongs to the obstacle.
    return ndimage.distance_transform_edt(~plan) > 10 * ERODE + 0.5


def _attempt(rng: np.random.Generator, seed: int, kind: str, clutter: float) -> House:
    rooms, rectangle = _rooms(rng, kind)
    draft = _Draft(CELLS[kind], BODY[kind])
    for index, room in enumerate(rooms):
        draft.labels[room.x0 : room.x1, room.y0 : room.y1] = index
    _cut_corners(rng, draft, rectangle)
    doors = _doors(rng, rooms, draft)
    walls = draft.labels == _WALL
    draft.start(walls)
    for door in doors:
        draft.keep_clear(door)
        if door.x1 - door.x0 <= 12 and door.y1 - door.y0 <= 12 and rng.random() < 0.35:
            _hang_leaf(rng, draft, door)
    for room in rooms:
        _furnish(rng, draft, room, clutter)
    occupied = _scan(rng, draft, kind)
    return House(seed=seed, kind=kind, grid=Grid(occupied), rooms=rooms, doors=doors, walls=walls)


# --- rooms ---------------------------------------------------------------------------------------


def _rooms(rng: np.random.Generator, kind: str) -> tuple[tuple[Room, ...], Room]:
    """Split a rectangle, often along a corridor, until there are enough rooms."""
    side = CELLS[kind]
    w, h = (side, side) if kind == "snake" else (int(n) for n in rng.integers(120, side + 1, 2))
    x, y = (side - w) // 2, (side - h) // 2
    whole = Room(kind="", x0=x + 1, y0=y + 1, x1=x + w - 1, y1=y + h - 1)
    wanted = int(rng.integers(4, 7) if kind == "snake" else rng.integers(5, 9))
    rooms, corridors = [whole], []
    if rng.random() < 0.5:
        rooms, corridors = _split_off_corridor(rng, whole)
    while len(rooms) < wanted:
        rooms.sort(key=lambda room: room.area * rng.uniform(0.7, 1.0))
        parts = _split(rng, rooms.pop())
        rooms += parts
        if len(parts) == 1:
            break
    return (*_name(rng, rooms), *corridors), whole


def _split(rng: np.random.Generator, room: Room, shortest: int = 18) -> list[Room]:
    """Two rooms with a wall between them, across the longer side."""
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
    """A corridor from wall to wall, with a part of the home on either side."""
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
    """The largest room is for living, the smallest is the bath, the others as they come."""
    rooms = sorted(rooms, key=lambda room: -room.area)
    others = ["kitchen", "bedroom", "bedroom", "office", "bedroom", "office"]
    kinds = ["living", *others[: len(rooms) - 2], "bath"]
    if rooms[-1].area > 1400:  # too large for a bath
        kinds[-1] = "bedroom"
    if len(kinds) > 3 and rng.random() < 0.5:
        kinds[1], kinds[2] = kinds[2], kinds[1]
    return [dataclasses.replace(room, kind=k) for room, k in zip(rooms, kinds, strict=True)]


def _cut_corners(rng: np.random.Generator, draft: "_Draft", whole: Room) -> None:
    """Up to three corners of the home lie outside."""
    for corner in rng.permutation(4)[: rng.integers(0, 4)]:
        w, h = rng.integers(8, 22, 2)
        x = slice(whole.x0, whole.x0 + w) if corner < 2 else slice(whole.x1 - w, whole.x1)
        y = slice(whole.y0, whole.y0 + h) if corner % 2 else slice(whole.y1 - h, whole.y1)
        if len(np.unique(draft.labels[x, y])) == 1:  # never a piece of two rooms
            draft.labels[x, y] = _WALL


# --- doors ---------------------------------------------------------------------------------------


def _doors(rng: np.random.Generator, rooms: tuple[Room, ...], draft: "_Draft") -> tuple[Room, ...]:
    """Doors along a random spanning tree of the rooms, and up to two more."""
    n = len(rooms)
    doors = {}
    weight = np.zeros((n, n))
    for a in range(n):
        for b in range(a + 1, n):
            door = _door(rng, rooms[a], rooms[b], draft)
            if door is not None:
                hub = {"corridor", "living"} & {rooms[a].kind, rooms[b].kind}
                doors[a, b], weight[a, b] = door, rng.uniform(0.1, 1) + (0 if hub else 1)
    tree = minimum_spanning_tree(weight).tocoo()
    chosen = list(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    spare = [pair for pair in doors if pair not in chosen]
    extra = rng.permutation(len(spare))[: rng.integers(0, 3)]
    chosen += [spare[i] for i in extra]
    for pair in chosen:
        door = doors[pair]
        draft.labels[door.x0 : door.x1, door.y0 : door.y1] = n
    return tuple(doors[pair] for pair in chosen)


def _door(rng: np.random.Generator, a: Room, b: Room, draft: "_Draft") -> Room | None:
    """An opening in the wall between two rooms, if they share one that is long enough."""
    if b.x1 < a.x0 or b.y1 < a.y0:
        a, b = b, a
    beside_x = 1 <= b.x0 - a.x1 <= 2
    if not beside_x and not 1 <= b.y0 - a.y1 <= 2:
        return None
    if beside_x:
        low, high, before, after = max(a.y0, b.y0), min(a.y1, b.y1), a.x1, b.x0
        passable = (draft.labels[before - 1] >= 0) & (draft.labels[after] >= 0)
    else:
        low, high, before, after = max(a.x0, b.x0), min(a.x1, b.x1), a.y1, b.y0
        passable = (draft.labels[:, before - 1] >= 0) & (draft.labels[:, after] >= 0)
    where = low + np.flatnonzero(passable[low:high])
    if len(where) < 12:
        return None
    low, high = int(where[0]), int(where[-1]) + 1
    style, narrow = rng.random(), "bath" in (a.kind, b.kind)
    width = int(rng.integers(8, 11) if style < 0.7 or narrow else rng.integers(10, 13))
    if style > 0.85 and not narrow:
        width = int(rng.integers(18, 21))
        if style > 0.93:
            width = high - low - 4
    width = min(width, high - low - 2)
    last = high - width - 1
    near_end = [low + 1 + int(rng.integers(0, 3)), last - int(rng.integers(0, 3))]
    start = int(rng.choice(near_end) if rng.random() < 0.6 else rng.integers(low + 1, last + 1))
    start = int(np.clip(start, low + 1, last))
    if beside_x:
        return Room(kind="door", x0=before, x1=after, y0=start, y1=start + width)
    return Room(kind="door", x0=start, x1=start + width, y0=before, y1=after)


def _hang_leaf(rng: np.random.Generator, draft: "_Draft", door: Room) -> None:
    """An open door leaf at right angles to the wall, on one of its four places."""
    along_y = door.y1 - door.y0 > door.x1 - door.x0
    length = max(door.x1 - door.x0, door.y1 - door.y0)
    end, side = rng.integers(0, 2, 2)
    shape = (length, 1) if along_y else (1, length)
    if along_y:
        at = (door.x1 if side else door.x0 - length, (door.y0 - 1, door.y1)[end])
    else:
        at = ((door.x0 - 1, door.x1)[end], door.y1 if side else door.y0 - length)
    draft.place(np.ones((*shape, HEIGHT), bool), *at, clear=False)


# --- furniture -----------------------------------------------------------------------------------


class _Draft:
    """A home on its way: what stands where, what must stay clear, and where the base can go."""

    def __init__(self, side: int, body: int):
        self.labels = np.full((side, side), _WALL)  # room, door or wall
        self.occupied = np.zeros((side, side, HEIGHT), bool)
        self.clear = np.zeros((side, side), bool)
        self.blocked = np.zeros((side, side), bool)  # for the centre of the base
        self.taken = np.zeros((side, side), bool)  # by furniture, at any height
        self.body = body
        i, j = np.ogrid[-SPREAD : SPREAD + 1, -SPREAD : SPREAD + 1]
        self.disc = i**2 + j**2 < (SPREAD + 0.5) ** 2

    def start(self, walls: np.ndarray) -> None:
        """Raise the walls."""
        self.occupied[walls] = True
        self.taken |= walls
        narrow = ndimage.distance_transform_edt(~walls) <= SPREAD - 0.5  # doors stay passable
        self.blocked |= narrow

    def keep_clear(self, door: Room, reach: int = 6) -> None:
        """No furniture in a door nor right before it."""
        if door.y1 - door.y0 > door.x1 - door.x0:
            self.clear[door.x0 - reach : door.x1 + reach, door.y0 : door.y1] = True
        else:
            self.clear[door.x0 : door.x1, door.y0 - reach : door.y1 + reach] = True

    def place(self, volume: np.ndarray, x: int, y: int, clear: bool = True) -> bool:
        """Put a volume down with its corner at (x, y), if it fits and cuts nothing off."""
        w, d = volume.shape[:2]
        if x < 1 or y < 1 or x + w >= len(self.taken) or y + d >= len(self.taken):
            return False
        here = (slice(x, x + w), slice(y, y + d))
        footprint = volume.any(2)
        if (self.taken[here] & footprint).any() or (clear and (self.clear[here] & footprint).any()):
            return False
        base = np.pad(volume[:, :, : self.body].any(2), SPREAD)
        grown = ndimage.binary_dilation(base, self.disc)
        i, j = max(x - SPREAD, 0), max(y - SPREAD, 0)
        around = (slice(i, x + w + SPREAD), slice(j, y + d + SPREAD))
        before = self.blocked[around].copy()
        grown = grown[i - x + SPREAD :, j - y + SPREAD :][: before.shape[0], : before.shape[1]]
        self.blocked[around] |= grown
        if ndimage.label(~self.blocked)[1] != 1:
            self.blocked[around] = before
            return False
        self.taken[here] |= footprint
        self.occupied[here] |= volume
        return True


def _furnish(rng: np.random.Generator, draft: _Draft, room: Room, clutter: float) -> None:
    """What the room needs, then fillers, things on the walls and clutter."""
    needs, fillers = ROOMS[room.kind]
    for name in needs:
        _try(rng, draft, room, name, tries=12)
    square_metres = room.area / 100
    count = rng.poisson(clutter * square_metres * (0.1 if room.kind == "corridor" else 0.22))
    for name in rng.choice(fillers, count):
        _try(rng, draft, room, str(name), tries=6)
    for _ in range(rng.poisson(clutter * square_metres * 0.12)):
        _try(rng, draft, room, "clutter", tries=4)
    for _ in range(rng.poisson(square_metres * 0.08)):
        _try(rng, draft, room, "wall shelf", tries=3)


def _try(rng: np.random.Generator, draft: _Draft, room: Room, name: str, tries: int) -> bool:
    for _ in range(tries):
        turn = int(rng.integers(0, 4))
        volume = np.rot90(MAKERS[name](rng), turn, (0, 1))
        w, d = volume.shape[:2]
        space = (room.x1 - room.x0 - w, room.y1 - room.y0 - d)
        if min(space) < 0:
            continue
        x = room.x0 + int(rng.integers(0, space[0] + 1))
        y = room.y0 + int(rng.integers(0, space[1] + 1))
        if name not in FREE_STANDING or rng.random() < 0.3:
            if turn % 2 == 0:  # turned by 0 or 2, the back is at the low or the high end of y
                y = room.y0 if turn == 0 else room.y1 - d
            else:
                x = room.x1 - w if turn == 1 else room.x0
        if draft.place(volume, x, y):
            return True
    return False


# --- the scan ------------------------------------------------------------------------------------


def _scan(rng: np.random.Generator, draft: _Draft, kind: str) -> np.ndarray:
    """What a scanner would make of it: fat, ragged edges, blobs on walls, specks; (X, Y, 20)."""
    occupied = draft.occupied.copy()
    plan = draft.labels.shape
    beside = ndimage.binary_dilation(occupied, np.ones((3, 3, 1), bool)) & ~occupied
    # Rags hang together over half a metre of height.
    ragged = np.repeat(rng.random((*plan, 4)) < 0.17, HEIGHT // 4, axis=2)
    blobs = ndimage.binary_dilation(rng.random(plan) < 0.002, iterations=2)
    near_wall = ndimage.binary_dilation(draft.labels == _WALL, iterations=2)
    specks = rng.random(plan) < 0.0015
    noise = (beside & ragged) | (blobs & near_wall | specks)[:, :, None]
    occupied |= noise & ~draft.clear[:, :, None]
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    # Places that the base could stand in but never reach are filled.
    pieces, count = ndimage.label(_floor(occupied, kind))
    if count > 1:
        sizes = np.bincount(pieces.ravel())[1:]
        lost = (pieces > 0) & (pieces != 1 + int(sizes.argmax()))
        if lost.sum() < 0.05 * sizes.max():
            occupied[lost, :8] = True
    return occupied


# --- figure and command --------------------------------------------------------------------------


def save_figure(houses: list[House], path: str | Path) -> None:
    """Draw homes side by side: walls dark, furniture by height, overhangs hatched light."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = min(5, len(houses))
    rows = -(-len(houses) // columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(3.2 * columns, 3.3 * rows), dpi=110)
    axes = np.ravel(axes)
    for axis in axes:
        axis.axis("off")
    for axis, house in zip(axes, houses, strict=False):
        _draw(axis, house)
    figure.tight_layout(pad=0.4)
    figure.savefig(path)
    pyplot.close(figure)


def _draw(axis, house: House) -> None:
    from matplotlib import colormaps

    occupied = house.grid.occupied
    top = HEIGHT - occupied[:, :, ::-1].argmax(2)
    image = np.ones((*house.walls.shape, 3))
    standing = occupied.any(2)
    image[standing] = colormaps["YlOrBr"](0.25 + 0.6 * top / HEIGHT)[..., :3][standing]
    over = standing & ~occupied[:, :, 0]
    image[over] = 0.45 * image[over] + 0.55 * np.array([0.55, 0.75, 0.95])
    image[house.walls] = 0.2
    size = 0.1 * len(standing)
    axis.imshow(image.swapaxes(0, 1), origin="lower", extent=(0, size, 0, size))
    for room in house.rooms:
        axis.text(
            0.05 * (room.x0 + room.x1), 0.05 * (room.y0 + room.y1), room.kind,
            fontsize=6, color="tab:blue", ha="center", va="center",
        )  # fmt: skip
    axis.set_title(f"seed {house.seed}", fontsize=7, pad=2)


def add_arguments(subparsers) -> None:
    """Add the ``homes`` command to a command line."""
    parser = subparsers.add_parser("homes", help="draw random homes")
    parser.set_defaults(run=_run)
    parser.add_argument("--num", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the first; the others follow")
    parser.add_argument("--task", default="snake", choices=tuple(CELLS))
    parser.add_argument("--out", required=True, help="a .png file")


def _run(arguments: argparse.Namespace) -> int:
    if arguments.num < 1:
        raise ValueError(f"--num is {arguments.num}; expected at least 1")
    seeds = range(arguments.seed, arguments.seed + arguments.num)
    houses = [generate_house(seed, arguments.task) for seed in seeds]
    save_figure(houses, arguments.out)
    print(f"wrote {arguments.out}")
    return 0
