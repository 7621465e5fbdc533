"""Homes: rooms, doors and furniture as in homes, in one piece, the same for the same seed."""

import time

import numpy as np
import pytest

from nrp_jax.homes import houses
from nrp_jax.homes.figure import save_figure
from nrp_jax.homes.furniture import HEIGHT, MAKERS
from nrp_jax.homes.grid import load_map

SNAKE_SEEDS, FETCH_SEEDS = range(16), range(4)


@pytest.fixture(scope="module")
def homes():
    started = time.process_time()
    made = [houses.generate_house(seed, "snake") for seed in SNAKE_SEEDS]
    made += [houses.generate_house(seed, "fetch") for seed in FETCH_SEEDS]
    assert time.process_time() - started < 1.0 * len(made)
    return made


def reachable(passable: np.ndarray, start: tuple[int, int]) -> np.ndarray:
    """Cells (X, Y) that a flood from one cell reaches, by a plain loop."""
    seen, front = np.zeros_like(passable), [start]
    seen[start] = True
    while front:
        i, j = front.pop()
        for x, y in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if passable[x, y] and not seen[x, y]:
                seen[x, y] = True
                front.append((x, y))
    return seen


def roomy(solid: np.ndarray) -> np.ndarray:
    """Cells (X, Y) more than 0.35 m from the center of any solid one, by shifting the map."""
    ok = np.ones_like(solid)
    padded = np.pad(solid, 3, constant_values=True)
    for i in range(-3, 4):
        for j in range(-3, 4):
            if i * i + j * j <= 3.5**2:
                ok &= ~padded[3 + i : 3 + i + solid.shape[0], 3 + j : 3 + j + solid.shape[1]]
    return ok


def test_same_seed_same_home():
    for kind in ("snake", "fetch"):
        first, second = (houses.generate_house(7, kind) for _ in range(2))
        assert (first.grid.occupied == second.grid.occupied).all()
        assert first.rooms == second.rooms and first.doors == second.doors
        other = houses.generate_house(8, kind)
        assert (first.grid.occupied != other.grid.occupied).mean() > 0.05


def test_sizes_and_borders(homes):
    for house in homes:
        side = {"snake": 100, "fetch": 150}[house.kind]
        occupied = house.grid.occupied
        assert occupied.shape == (side, side, HEIGHT) and house.plan().occupied.shape[2] == 1
        for edge in (occupied[0], occupied[-1], occupied[:, 0], occupied[:, -1]):
            assert edge.all()
        inside = ~occupied.all(2)
        assert 95 <= np.ptp(np.flatnonzero(inside.any(1))) <= 150
        # Scanned homes are about half full.
        full = occupied[:, :, :10].any(2)[inside].mean()
        assert 0.1 < full < 0.5, full


def test_one_piece_that_enters_every_room(homes):
    for house in homes:
        height = {"snake": 10, "fetch": 15}[house.kind]
        passable = roomy(house.grid.occupied[:, :, :height].any(2))
        assert (passable == houses.floor(house.grid, house.kind)).all()
        seen = reachable(passable, tuple(np.argwhere(passable)[0].tolist()))
        assert (seen == passable).all() and houses.is_connected(house.grid, house.kind)
        assert len(house.rooms) >= houses.MIN_ROOMS
        for room in house.rooms:
            assert seen[room.x0 : room.x1, room.y0 : room.y1].any(), (house.seed, room)


def test_doors_are_open_and_as_wide_as_doors(homes):
    widths = []
    for house in homes:
        assert len(house.doors) >= len(house.rooms) - 1
        for door in house.doors:
            way = house.grid.occupied[door.x0 : door.x1, door.y0 : door.y1]
            along_y = door.y1 - door.y0 > door.x1 - door.x0
            assert not way.any(), (house.seed, door)
            assert (
                house.walls[door.x0, door.y0 - 1] if along_y else house.walls[door.x0 - 1, door.y0]
            )
            widths.append(max(door.x1 - door.x0, door.y1 - door.y0))
    widths = np.array(widths)
    assert widths.min() >= 8
    assert 0.5 < (widths <= 10).mean() < 0.95


def test_furniture_and_overhangs(homes):
    for house in homes:
        standing = house.grid.occupied.any(2) & ~house.walls
        assert standing.sum() > 400
        over = standing & ~house.grid.occupied[:, :, 0]  # table tops, cabinets, shelves
        assert over.sum() > 20
        under_a_table = over & house.grid.occupied[:, :, 5:8].any(2)
        assert under_a_table.any()


def test_furniture_has_real_sizes(rng):
    for name, make in MAKERS.items():
        for _ in range(20):
            volume = make(rng)
            w, d, h = volume.shape
            assert h == HEIGHT and volume.any()
            assert 1 <= w <= 40 and 1 <= d <= 30, (name, volume.shape)
            if name not in ("clutter", "bin"):
                assert volume.any((0, 1)).nonzero()[0].max() >= 3, name
    fridge_and_counter = MAKERS["kitchen"](np.random.default_rng(1))
    assert fridge_and_counter[:, :, 12].sum() < fridge_and_counter[:, :, 5].sum()


def test_clutter_fills():
    def full(clutter):
        seeds = range(3)
        return np.mean(
            [houses.generate_house(s, clutter=clutter).plan().occupied.mean() for s in seeds]
        )

    assert full(2.0) > full(0.0) + 0.03


def test_unknown_kind():
    with pytest.raises(ValueError, match="unknown kind of home 'drone'; have: snake, fetch"):
        houses.generate_house(0, "drone")


def test_save_and_load(tmp_path, homes):
    homes[0].grid.save(tmp_path / "home.npz")
    assert (load_map(tmp_path / "home.npz").occupied == homes[0].grid.occupied).all()


def test_figure(tmp_path, homes):
    save_figure(homes[:3], tmp_path / "homes.png")
    assert (tmp_path / "homes.png").stat().st_size > 20_000
