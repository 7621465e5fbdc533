"""Furniture of real sizes as small blocks of voxels, for :mod:`nrp_jax.homes.houses`.

Every maker takes a random generator and returns a volume (w, d, 20) of occupied cells of 0.1 m that
stands on the floor. The back, which is the side that belongs against a wall, is at index 0 of the
second axis. Sizes are medians of furniture in homes, varied by a tenth.
"""

from collections.abc import Callable

import numpy as np

HEIGHT = 20  # cells, 2 m
Maker = Callable[[np.random.Generator], np.ndarray]


def _cells(rng: np.random.Generator, *sizes: float) -> list[int]:
    """Sizes [m], varied by a tenth, in cells."""
    return [max(1, round(10 * size * rng.uniform(0.9, 1.1))) for size in sizes]


def _box(rng: np.random.Generator, w: float, d: float, h: float) -> np.ndarray:
    i, j, k = _cells(rng, w, d, h)
    volume = np.zeros((i, j, HEIGHT), bool)
    volume[:, :, :k] = True
    return volume


def _box_of(w: float, d: float, h: float) -> Maker:
    return lambda rng: _box(rng, w, d, h)


def _round_of(diameter: float, h: float) -> Maker:
    def make(rng: np.random.Generator) -> np.ndarray:
        volume = _box(rng, diameter, diameter, h)
        i, j = np.ogrid[: volume.shape[0], : volume.shape[1]]
        radii = np.array(volume.shape[:2]) / 2
        outside = ((i + 0.5) / radii[0] - 1) ** 2 + ((j + 0.5) / radii[1] - 1) ** 2 > 1.05
        volume[outside] = False
        return volume

    return make


def _table(rng: np.random.Generator, w: float, d: float, h: float) -> np.ndarray:
    """A top on four legs."""
    volume = _box(rng, w, d, h)
    top = int(volume[0, 0].sum()) - 1
    volume[:, :, :top] = False
    volume[np.ix_([0, -1], [0, -1], range(top))] = True
    return volume


def _chair(rng: np.random.Generator) -> np.ndarray:
    """A seat with a back."""
    volume = _box(rng, 0.45, 0.5, 0.45)
    volume[:, 0, : round(10 * rng.uniform(0.85, 1.0))] = True
    return volume


def _bed(rng: np.random.Generator) -> np.ndarray:
    """A mattress with a headboard, and a night table on either side or one."""
    bed = _box(rng, rng.choice([0.9, 1.4, 1.6]), 2.1, 0.55)
    bed[:, 0, : round(10 * rng.uniform(0.7, 1.1))] = True
    tables = [_box(rng, 0.45, 0.4, 0.6) for _ in range(2)]
    return _row(tables[0], bed, tables[1]) if rng.random() < 0.5 else _row(bed, tables[0])


def _sofa(rng: np.random.Generator) -> np.ndarray:
    """Seat, back and arms, often with a coffee table before it."""
    sofa = _box(rng, rng.choice([1.6, 2.0, 2.4]), 0.9, 0.45)
    sofa[:, :2, :8] = True
    sofa[[0, -1], :, :6] = True
    if rng.random() < 0.4:
        return sofa
    table = _table(rng, 1.0, 0.6, 0.45)
    gap = int(rng.integers(4, 6))
    both = np.zeros((len(sofa), sofa.shape[1] + gap + table.shape[1], HEIGHT), bool)
    both[:, : sofa.shape[1]] = sofa
    start = (len(sofa) - len(table)) // 2
    both[start : start + len(table), -table.shape[1] :] = table
    return both


def _dining(rng: np.random.Generator) -> np.ndarray:
    """A table with two to six chairs, some pushed in and some drawn out."""
    table = _table(rng, rng.choice([1.0, 1.4, 1.7]), rng.choice([0.8, 0.95]), 0.77)
    margin = 6
    volume = np.zeros((len(table), table.shape[1] + 2 * margin, HEIGHT), bool)
    volume[:, margin:-margin] = table
    for _ in range(2):  # one side, then the other
        for i in range(1, len(table) - 5, 6):
            if rng.random() < 0.8:
                chair, j = _chair(rng), int(rng.integers(0, 4))
                volume[i : i + chair.shape[0], j : j + chair.shape[1]] |= chair
        volume = volume[:, ::-1]
    return volume


def _desk(rng: np.random.Generator) -> np.ndarray:
    """A desk, a chair before it, often drawers under it and a shelf above."""
    desk = _table(rng, 1.3, 0.6, 0.75)
    if rng.random() < 0.5:
        desk[:4, :, :7] = True
    if rng.random() < 0.4:
        desk[:, :2, 13:15] = True
    chair = np.rot90(_chair(rng), 2, (0, 1))
    volume = np.zeros((len(desk), desk.shape[1] + 4, HEIGHT), bool)
    volume[:, : desk.shape[1]] = desk
    i = int(rng.integers(3, max(4, len(desk) - 5)))
    target = volume[i : i + len(chair), -chair.shape[1] :]
    target |= chair[: len(target)]
    return volume


def _kitchen(rng: np.random.Generator) -> np.ndarray:
    """A counter under wall cabinets, with a fridge at its end."""
    counter = _box(rng, rng.choice([1.6, 2.2, 2.6]), 0.6, 0.94)
    start = int(rng.integers(0, 6))
    counter[start:, :4, 14:] = True
    fridge = _box(rng, 0.7, 0.7, 1.85)
    if rng.random() < 0.3:
        return counter
    return _row(counter, fridge) if rng.random() < 0.5 else _row(fridge, counter)


def _island(rng: np.random.Generator) -> np.ndarray:
    """A free-standing counter whose top overhangs on one side."""
    island = _box(rng, 1.5, 0.8, 0.9)
    island[:, -2:, :8] = False
    return island


def _wall_shelf(rng: np.random.Generator) -> np.ndarray:
    """Something mounted on the wall at the height of the arm: a shelf, a screen, a boiler."""
    w, d = _cells(rng, rng.choice([0.5, 0.9, 1.2]), rng.choice([0.15, 0.25, 0.35]))
    low = int(rng.integers(9, 14))
    volume = np.zeros((w, d, HEIGHT), bool)
    volume[:, :, low : low + int(rng.integers(1, 7))] = True
    return volume


def _clutter(rng: np.random.Generator) -> np.ndarray:
    """A box, a bag or a toy."""
    return _box(rng, *rng.uniform(0.1, 0.5, 3))


def _row(*volumes: np.ndarray) -> np.ndarray:
    """Pieces side by side with their backs in line."""
    depth = max(v.shape[1] for v in volumes)
    padded = [np.pad(v, ((0, 0), (0, depth - v.shape[1]), (0, 0))) for v in volumes]
    return np.concatenate(padded)


MAKERS: dict[str, Maker] = {
    "armchair": _box_of(0.9, 0.85, 0.8),
    "bath": _box_of(1.6, 0.75, 0.6),
    "bed": _bed,
    "bin": _round_of(0.4, 0.55),
    "chair": _chair,
    "clutter": _clutter,
    "desk": _desk,
    "dining": _dining,
    "dresser": _box_of(1.2, 0.5, 1.0),
    "island": _island,
    "kitchen": _kitchen,
    "lamp": _round_of(0.4, 1.9),
    "plant": _round_of(0.45, 0.9),
    "round table": _round_of(1.0, 0.75),
    "shelf": _box_of(0.9, 0.35, 1.8),
    "side table": _box_of(0.55, 0.4, 0.65),
    "sofa": _sofa,
    "toilet": _box_of(0.45, 0.7, 0.85),
    "tv": _box_of(1.3, 0.45, 0.6),
    "wall shelf": _wall_shelf,
    "wardrobe": _box_of(1.5, 0.6, 2.0),
    "washbasin": _box_of(0.6, 0.5, 0.85),
    "washer": _box_of(0.65, 0.65, 0.9),
}

# What stands in a room: first what makes it that room, in this order, then fillers at random.
ROOMS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "living": (
        ("sofa", "tv", "armchair", "dining", "shelf", "lamp"),
        ("armchair", "plant", "shelf", "side table", "dresser", "round table", "chair"),
    ),
    "kitchen": (
        ("kitchen", "dining", "kitchen"),
        ("chair", "island", "bin", "shelf", "side table"),
    ),
    "bedroom": (
        ("bed", "wardrobe", "dresser"),
        ("chair", "desk", "shelf", "armchair", "side table", "lamp", "plant"),
    ),
    "office": (
        ("desk", "shelf", "desk", "shelf"),
        ("armchair", "dresser", "chair", "plant", "round table"),
    ),
    "bath": (
        ("bath", "toilet", "washbasin", "washer"),
        ("bin", "side table", "clutter"),
    ),
    "corridor": (("side table",), ("shelf", "plant", "clutter")),
}

# These stand away from walls as often as not; all others belong against one.
FREE_STANDING = frozenset({"dining", "round table", "island", "armchair", "chair", "clutter"})
