"""Homes for training: random floor plans with furniture, as occupancy grids.

They stand in for the scanned homes of the Neural Randomized Planner (Lu et al. 2024). Rooms come
from recursive splits; corridors, doors and furniture of real sizes follow; at last the errors that
a scanner makes. Everything is in cells of 0.1 m. The same seed gives the same home.
"""

import dataclasses
from typing import Any, cast

import numpy as np
from scipy import ndimage

from nrp_jax.homes.floor_plan import WALL, FloorPlan, Room, make_floor_plan
from nrp_jax.homes.furniture import FREE_STANDING, HEIGHT, MAKERS, ROOMS
from nrp_jax.homes.grid import Grid

VERSION = 1  # of the generator; data sets record it
CELLS = {"snake": 100, "fetch": 150}  # cells of a side of the grids
BODY = {"snake": 1.0, "fetch": 1.5}  # height of a robot's base and trunk [m]
SPREAD = 4  # radius of the base, in cells, that furniture keeps free
ERODE = 0.3  # radius of the base for which the free floor must be connected [m]
MIN_ROOMS = 4
_ATTEMPTS = 100


@dataclasses.dataclass(frozen=True, kw_only=True)
class House:
    """A home, and the parts it was made of."""

    seed: int
    kind: str  # "snake" or "fetch", the robot that it is made for
    grid: Grid  # occupancy (X, Y, 20)
    rooms: tuple[Room, ...]
    doors: tuple[Room, ...]  # openings in walls, as rectangles
    walls: np.ndarray  # (X, Y) bool

    def plan(self) -> Grid:
        """The map (X, Y, 1) that a planar robot meets: all cells below 1 m."""
        return self.grid.flatten(0.0, 1.0)


def generate_house(seed: int, kind: str = "snake", clutter: float = 1.0, variant: int = 0) -> House:
    """Generate a home.

    Args:
        seed: the same seed, kind, clutter and variant give the same home.
        kind: "snake" for 10 x 10 m, "fetch" for 12 to 15 m in a grid of 15 m.
        clutter: multiple of the usual amount of furniture beyond what each room needs.
        variant: another home for the same seed, see :func:`nrp_jax.learning.difficulty.fair_house`.

    Raises:
        ValueError: the kind is unknown.
        RuntimeError: no attempt with this seed gives a home.
    """
    if kind not in CELLS:
        raise ValueError(f"unknown kind of home '{kind}'; have: {', '.join(CELLS)}")
    for attempt in range(_ATTEMPTS * variant, _ATTEMPTS * (variant + 1)):
        rng = np.random.default_rng([VERSION, seed, attempt, CELLS[kind]])
        house = _attempt(rng, seed, kind, clutter)
        if house and len(house.rooms) >= MIN_ROOMS and is_connected(house.grid, kind):
            return house
    raise RuntimeError(
        f"no home came out of seed {seed} in {_ATTEMPTS} attempts; take another seed"
    )


def is_connected(grid: Grid, kind: str) -> bool:
    """Whether a robot's base, with 0.3 m of free space around it, can reach all of the floor."""
    return _pieces(floor(grid, kind))[1] == 1


def floor(grid: Grid, kind: str) -> np.ndarray:
    """Cells (X, Y) whose centers have 0.3 m of free space around them, as high as the robot."""
    plan = grid.flatten(0.0, BODY[kind]).occupied[:, :, 0]
    # Distances run between centers of cells: half a cell of each belongs to the obstacle.
    return _distance(~plan) * grid.resolution > ERODE + 0.5 * grid.resolution


def _pieces(mask: np.ndarray) -> tuple[np.ndarray, int]:
    """Labels (X, Y) of the connected parts of a mask, 0 outside, and the number of parts."""
    labels, count = cast(Any, ndimage.label(mask))
    return labels, int(count)


def _distance(mask: np.ndarray) -> np.ndarray:
    """Distance (X, Y) of every cell to the nearest cell outside the mask [cells]."""
    return cast(np.ndarray, ndimage.distance_transform_edt(mask))


def _attempt(rng: np.random.Generator, seed: int, kind: str, clutter: float) -> House | None:
    """Try to make a home; None if the floor is not connected even without furniture."""
    side = CELLS[kind]
    width, depth = (side, side) if kind == "snake" else rng.integers(120, side + 1, 2).tolist()
    num_rooms = int(rng.integers(4, 7) if kind == "snake" else rng.integers(5, 9))
    plan = make_floor_plan(rng, side, width, depth, num_rooms)
    draft = _Draft(plan, round(10 * BODY[kind]))
    if _pieces(~draft.blocked)[1] != 1:
        return None
    for door in plan.doors:
        draft.keep_clear(door)
        if max(door.x1 - door.x0, door.y1 - door.y0) <= 12 and rng.random() < 0.35:
            _hang_leaf(rng, draft, door)
    for room in plan.rooms:
        _furnish(rng, draft, room, clutter)
    return House(
        seed=seed,
        kind=kind,
        grid=Grid(occupied=_scan(rng, draft, kind)),
        rooms=plan.rooms,
        doors=plan.doors,
        walls=draft.walls,
    )


def _hang_leaf(rng: np.random.Generator, draft: "_Draft", door: Room) -> None:
    """Add an open door leaf at right angles to the wall, at one of four places, if it fits."""
    along_y = door.y1 - door.y0 > door.x1 - door.x0
    length = max(door.x1 - door.x0, door.y1 - door.y0)
    end, side = rng.integers(0, 2, 2)
    shape = (length, 1) if along_y else (1, length)
    if along_y:
        at = (door.x1 if side else door.x0 - length, (door.y0 - 1, door.y1)[end])
    else:
        at = ((door.x0 - 1, door.x1)[end], door.y1 if side else door.y0 - length)
    draft.place(np.ones((*shape, HEIGHT), bool), *at, clear=False)


class _Draft:
    """An unfinished home: what stands where, what must stay clear, and where the base can go."""

    def __init__(self, plan: FloorPlan, body: int):
        """Begin with the walls of a plan; ``body`` is the height of the robot's body in cells."""
        self.walls = plan.labels == WALL
        self.occupied = np.repeat(self.walls[:, :, None], HEIGHT, axis=2)
        self.taken = self.walls.copy()  # (X, Y) cells where something stands at any height
        self.clear = np.zeros_like(self.walls)  # (X, Y) cells before doors
        self.body = body
        i, j = np.ogrid[-SPREAD : SPREAD + 1, -SPREAD : SPREAD + 1]
        self.disc = i**2 + j**2 < (SPREAD + 0.5) ** 2
        # Cells where the center of the base cannot be; a bit fewer near walls, so that doors pass.
        self.blocked = _distance(~self.walls) <= SPREAD - 0.5

    def keep_clear(self, door: Room, reach: int = 6) -> None:
        """Keep furniture out of a door and ``reach`` cells before and behind it."""
        if door.y1 - door.y0 > door.x1 - door.x0:
            self.clear[door.x0 - reach : door.x1 + reach, door.y0 : door.y1] = True
        else:
            self.clear[door.x0 : door.x1, door.y0 - reach : door.y1 + reach] = True

    def place(self, volume: np.ndarray, x: int, y: int, clear: bool = True) -> bool:
        """Put a piece of furniture at a place, if it fits and leaves the floor connected.

        Args:
            volume: (w, d, 20) its occupied cells.
            x: first cell along x.
            y: first cell along y.
            clear: keep out of the cells before doors.

        Returns:
            Whether it was placed.
        """
        w, d = volume.shape[:2]
        if x < 1 or y < 1 or x + w >= len(self.taken) or y + d >= len(self.taken):
            return False
        # It may neither overlap with anything nor stand before a door.
        here = (slice(x, x + w), slice(y, y + d))
        footprint = volume.any(2)
        if (self.taken[here] & footprint).any() or (clear and (self.clear[here] & footprint).any()):
            return False
        # Where does it block the base? Undo it if the floor falls apart.
        base = np.pad(volume[:, :, : self.body].any(2), SPREAD)
        grown = cast(np.ndarray, ndimage.binary_dilation(base, self.disc))
        i, j = max(x - SPREAD, 0), max(y - SPREAD, 0)
        around = (slice(i, x + w + SPREAD), slice(j, y + d + SPREAD))
        before = self.blocked[around].copy()
        grown = grown[i - x + SPREAD :, j - y + SPREAD :][: before.shape[0], : before.shape[1]]
        self.blocked[around] |= grown
        if _pieces(~self.blocked)[1] != 1:
            self.blocked[around] = before
            return False
        self.taken[here] |= footprint
        self.occupied[here] |= volume
        return True


def _furnish(rng: np.random.Generator, draft: _Draft, room: Room, clutter: float) -> None:
    """Place what a room of this kind has, then fillers, clutter and things on the walls."""
    needs, fillers = ROOMS[room.kind]
    for name in needs:
        _try(rng, draft, room, name, tries=12)
    square_metres = room.area / 100
    count = rng.poisson(clutter * square_metres * (0.1 if room.kind == "corridor" else 0.16))
    for name in rng.choice(fillers, count):
        _try(rng, draft, room, str(name), tries=6)
    for _ in range(rng.poisson(clutter * square_metres * 0.08)):
        _try(rng, draft, room, "clutter", tries=4)
    for _ in range(rng.poisson(square_metres * 0.08)):
        _try(rng, draft, room, "wall shelf", tries=3)


def _try(rng: np.random.Generator, draft: _Draft, room: Room, name: str, tries: int) -> bool:
    """Try some random places in a room for a piece of furniture; whether one of them fits."""
    for _ in range(tries):
        turn = int(rng.integers(0, 4))
        volume = np.rot90(MAKERS[name](rng), turn, (0, 1))
        w, d = volume.shape[:2]
        space = (room.x1 - room.x0 - w, room.y1 - room.y0 - d)
        if min(space) < 0:
            continue
        x = room.x0 + int(rng.integers(0, space[0] + 1))
        y = room.y0 + int(rng.integers(0, space[1] + 1))
        # Against a wall, with its back to it.
        if name not in FREE_STANDING or rng.random() < 0.3:
            if turn % 2 == 0:  # turned by 0 or 2, the back is at the low or the high end of y
                y = room.y0 if turn == 0 else room.y1 - d
            else:
                x = room.x1 - w if turn == 1 else room.x0
        if draft.place(volume, x, y):
            return True
    return False


def _scan(rng: np.random.Generator, draft: _Draft, kind: str) -> np.ndarray:
    """The map (X, Y, 20) that a scanner would make: ragged edges, blobs on walls, specks."""
    occupied = draft.occupied.copy()
    plan = draft.walls.shape
    beside = ndimage.binary_dilation(occupied, np.ones((3, 3, 1), bool)) & ~occupied
    # Ragged cells beside solid ones, alike over half a meter of height.
    ragged = np.repeat(rng.random((*plan, 4)) < 0.13, HEIGHT // 4, axis=2)
    blobs = ndimage.binary_dilation(rng.random(plan) < 0.002, iterations=2)
    near_wall = cast(np.ndarray, ndimage.binary_dilation(draft.walls, iterations=2))
    specks = rng.random(plan) < 0.0015
    noise = (beside & ragged) | (blobs & near_wall | specks)[:, :, None]
    occupied |= noise & ~draft.clear[:, :, None]
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    # Fill places where the base could stand but which it cannot reach.
    pieces, count = _pieces(floor(Grid(occupied=occupied), kind))
    if count > 1:
        sizes = np.bincount(pieces.ravel())[1:]
        lost = (pieces > 0) & (pieces != 1 + int(sizes.argmax()))
        if lost.sum() < 0.05 * sizes.max():
            occupied[lost & ~draft.clear, :8] = True
    return occupied
