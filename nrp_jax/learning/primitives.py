"""Local primitives: what is solid in a part of a home, with a sample that solved something there.

FIRE (Chamzas et al. 2022) cuts a home into parts that overlap. An *entry* of its database is a
part, the query's start and goal as seen from there, and a configuration that the query's path had
in its middle. Two entries are *alike* if each one's sample would do for the other. Letters: ``n``
entries, ``m`` pairs, ``W`` parts of a home, ``D`` joints, ``E`` features.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.learning.data import Dataset
from nrp_jax.learning.edge_check import POINT_BATCH, pad_rows
from nrp_jax.learning.features import MAX_GOAL_DISTANCE
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import batch_is_free, build_world, with_grid
from vrrt_jax.core.precision import single_precision

SIDE, STRIDE = 20, 5  # cells of a part's sides, and between parts: 2 m and 0.5 m


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
    """The entries of a data set's rows: the part whose middle is nearest to the sample's base.

    A part that has the sample elsewhere does not tell where in it the sample would do. Samples that
    no part has in its middle, beside the walls around a map, are left out.

    Args:
        dataset: of experiences.
    """
    rows, found = dataset.rows, []
    for home, grid in enumerate(dataset.grids):
        own = np.flatnonzero(rows["home"] == home)
        corners = corners_of_parts(cells_of_parts(grid.occupied).shape)
        inside = (rows["waypoint"][own, :2] / grid.resolution)[:, None] - corners - SIDE / 2
        row, part = np.nonzero(((-STRIDE / 2 <= inside) & (inside < STRIDE / 2)).all(axis=-1))
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

    Two are alike if the sample of each is free in the home of the other, when it is placed in the
    other's part.

    Args:
        robot: the robot.
        grids: the homes.
        entries: of these homes.
        rng: where the choices come from.
        num: pairs, at most.

    Raises:
        ValueError: the entries are of one home, or all pairs are alike, or none.
    """
    if len(np.unique(entries.home)) < 2:
        raise ValueError("the experiences are of one home; expected two or more, to compare them")
    index = rng.integers(len(entries), size=(2 * num, 2))
    index = index[entries.home[index[:, 0]] != entries.home[index[:, 1]]]
    alike = _placed_free(robot, grids, entries, index)
    alike[alike] = _placed_free(robot, grids, entries, index[alike, ::-1])
    half = min(alike.sum(), (~alike).sum(), num // 2)
    if not half:
        raise ValueError(
            f"of {len(alike)} pairs of experiences {alike.sum()} are alike; expected more homes"
        )
    kept = np.concatenate([np.flatnonzero(alike)[:half], np.flatnonzero(~alike)[:half]])
    kept = rng.permutation(kept)
    return Pairs(index=index[kept], alike=alike[kept])


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
