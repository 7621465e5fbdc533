"""Local primitives: what is solid in a part of a home, with a sample that solved something there.

FIRE (Chamzas et al. 2022) cuts a home into parts that overlap. An *entry* of its database is a
part, the query's start and goal as seen from there, and a configuration that the query's path had
there. Two entries are *alike* if each one's sample would do for the other. Letters: ``n`` entries,
``m`` pairs, ``W`` parts of a home, ``D`` joints, ``E`` features.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from nrp_jax.homes.grid import Grid
from nrp_jax.learning.data import Dataset
from nrp_jax.learning.edge_check import POINT_BATCH, pad_rows
from nrp_jax.learning.features import MAX_GOAL_DISTANCE
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import batch_is_free, build_world, with_grid
from vrrt_jax.core.precision import single_precision

SIDE, STRIDE = 20, 5  # cells of a part's sides, and between parts: 2 m and 0.5 m
NEAR = 0.5  # samples that are alike are no farther apart than this, see :func:`_places` [m]
NEIGHBORS = 64  # nearest samples among which one that may be alike is drawn
_HEADING = 0.3  # meters that a heading's unit vector counts for
_ARM = 0.125  # meters that a radian of the arm counts for, as in the paper's metric


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entries:
    """The n entries of some homes; configurations are seen from the middles of the parts."""

    home: np.ndarray  # (n,) i32 index of the home
    corner: np.ndarray  # (n, 2) i32 first cell of the part
    sample: np.ndarray  # (n, D)
    start: np.ndarray  # (n, D) of the query
    goal: np.ndarray  # (n, D) of the query

    def __len__(self) -> int:
        """Number of entries."""
        return len(self.home)

    def __getitem__(self, index: np.ndarray) -> "Entries":
        """Some of the entries."""
        return Entries(**{name: column[index] for name, column in vars(self).items()})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pairs:
    """Pairs of entries, and which are alike."""

    index: np.ndarray  # (m, 2) of the entries
    alike: np.ndarray  # (m,) bool


def cells_of_parts(occupied: np.ndarray) -> np.ndarray:
    """Cells (X', Y', SIDE) of which all parts are full; what is beside the map is solid.

    Args:
        occupied: (X, Y, Z) bool; of more than two meters of height the lowest count.
    """
    # As many cells as the last stride needs.
    sides = [max(SIDE, -(-n // STRIDE) * STRIDE) - n for n in occupied.shape[:2]]
    low = occupied[..., :SIDE]
    low = np.pad(low, [(0, 0), (0, 0), (0, SIDE - low.shape[2])])
    return np.pad(low, [(0, sides[0]), (0, sides[1]), (0, 0)], constant_values=True)


def corners_of_parts(shape: tuple[int, ...]) -> np.ndarray:
    """First cells (W, 2) of all parts of a home of ``shape`` from :func:`cells_of_parts`."""
    along = [np.arange(0, n - SIDE + 1, STRIDE) for n in shape[:2]]
    return np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)


def middles(corner: np.ndarray, resolution: float) -> np.ndarray:
    """Middles (..., 2) of parts whose first cells are ``corner`` (..., 2), from the map's [m]."""
    return (corner + SIDE / 2) * resolution


def query_features(robot: MobileRobot, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Features (n, E) of queries as seen from parts: starts and goals (n, D).

    Far places are moved to 6 m; angles are given by cosine and sine.
    """
    is_angle, found = np.array(robot.angular), []
    for q in (np.asarray(start, np.float32), np.asarray(goal, np.float32)):
        far = np.linalg.norm(q[:, :2], axis=1, keepdims=True)
        place = q[:, :2] * np.minimum(1.0, MAX_GOAL_DISTANCE / np.maximum(far, 1e-6))
        linear = q[:, ~is_angle][:, 2:]
        found += [place, linear, np.cos(q[:, is_angle]), np.sin(q[:, is_angle])]
    return np.concatenate(found, axis=1).astype(np.float32)


def make_entries(dataset: Dataset) -> Entries:
    """The entries of all rows of a data set: one for each part that a sample's base is in.

    Args:
        dataset: of experiences.
    """
    rows, found = dataset.rows, []
    for home, grid in enumerate(dataset.grids):
        own = np.flatnonzero(rows["home"] == home)
        corners = corners_of_parts(cells_of_parts(grid.occupied).shape)
        cell = np.floor(rows["waypoint"][own, :2] / grid.resolution)[:, None]
        row, part = np.nonzero(((corners <= cell) & (cell < corners + SIDE)).all(axis=-1))
        middle = middles(corners[part], grid.resolution)
        shift = np.pad(middle, [(0, 0), (0, rows["waypoint"].shape[1] - 2)])
        columns = {
            name: (rows[source][own[row]] - shift).astype(np.float32)
            for name, source in (("sample", "waypoint"), ("start", "q_start"), ("goal", "q_goal"))
        }
        index = np.full(len(row), home, np.int32)
        found.append(Entries(home=index, corner=corners[part], **columns))
    return Entries(
        **{
            field.name: np.concatenate([getattr(part, field.name) for part in found])
            for field in dataclasses.fields(Entries)
        }
    )


@single_precision
def make_pairs(
    robot: MobileRobot,
    grids: Sequence[Grid],
    entries: Entries,
    rng: np.random.Generator,
    num: int,
) -> Pairs:
    """Pairs of entries of different homes, half of them alike.

    Two are alike if their samples are near each other, and each is free in the home of the other,
    when it is placed in the other's part. Of those that are not, half are near but not free.

    Args:
        robot: the robot.
        grids: the homes.
        entries: of these homes.
        rng: where the choices come from.
        num: pairs, at most.

    Raises:
        ValueError: the entries are of one home, or no two are alike.
    """
    if len(np.unique(entries.home)) < 2:
        raise ValueError("the experiences are of one home; expected two or more, to compare them")
    places = _places(robot, entries.sample)
    tree = cKDTree(places)
    # Near ones: for entries that are drawn, one of the nearest that is of another home.
    first = rng.integers(len(entries), size=2 * num)
    apart, near = tree.query(places[first], min(NEIGHBORS, len(entries)))
    usable = (entries.home[near] != entries.home[first][:, None]) & (apart <= NEAR)
    chosen = np.argmax(usable * rng.random(usable.shape), axis=1)
    some = usable.any(axis=1)
    index = np.stack([first, near[np.arange(len(first)), chosen]], axis=1)[some]
    alike = _placed_free(robot, grids, entries, index)
    alike &= _placed_free(robot, grids, entries, index[:, ::-1])
    # Others at random, those that happen to be near left out.
    random = rng.integers(len(entries), size=(2 * num, 2))
    far = np.linalg.norm(places[random[:, 0]] - places[random[:, 1]], axis=1) > NEAR
    random = random[far & (entries.home[random[:, 0]] != entries.home[random[:, 1]])]
    good, bad = index[alike][: num // 2], index[~alike]
    if not len(good):
        raise ValueError("no two experiences of different homes are alike; expected more homes")
    kinds = (good, bad[: len(good) // 2], random[: len(good) - min(len(bad), len(good) // 2)])
    index = np.concatenate(kinds)
    order = rng.permutation(len(index))
    return Pairs(index=index[order], alike=(np.arange(len(index)) < len(kinds[0]))[order])


def _places(robot: MobileRobot, sample: np.ndarray) -> np.ndarray:
    """Samples (n, D) as places whose straight distance is nearly that of the metric [m]."""
    heading, arm = sample[:, 2], sample[:, 3:]
    turning = np.asarray(robot.is_continuous)[3:]
    parts = [sample[:, :2], _HEADING * np.stack([np.cos(heading), np.sin(heading)], axis=1)]
    parts += [_ARM * arm[:, ~turning], _ARM * np.cos(arm[:, turning])]
    return np.concatenate([*parts, _ARM * np.sin(arm[:, turning])], axis=1)


def _placed_free(
    robot: MobileRobot, grids: Sequence[Grid], entries: Entries, index: np.ndarray
) -> np.ndarray:
    """Whether (m,) the samples of the first are free in the parts of the second, pairs (m, 2)."""
    world = build_world(robot, grids[0])
    free = np.zeros(len(index), bool)
    for home, grid in enumerate(grids):
        own = np.flatnonzero(entries.home[index[:, 1]] == home)
        if not len(own):
            continue
        q = entries.sample[index[own, 0]].copy()
        q[:, :2] += middles(entries.corner[index[own, 1]], grid.resolution)
        here = with_grid(world, grid)
        for begin in range(0, len(own), POINT_BATCH):
            batch = jnp.asarray(pad_rows(q[begin : begin + POINT_BATCH], POINT_BATCH))
            part = own[begin : begin + POINT_BATCH]
            free[part] = np.asarray(batch_is_free(here, batch))[: len(part)]
    return free
