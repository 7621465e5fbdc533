"""What curves are measured on: homes, and the queries to solve in each."""

import dataclasses
import hashlib
import itertools
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from nrp_jax.bench.maps import load_maps
from nrp_jax.homes.grid import Grid
from nrp_jax.homes.houses import generate_house
from nrp_jax.learning.difficulty import long_queries
from nrp_jax.learning.shards import DatasetSettings, home_seed
from nrp_jax.scene.configurations import check_configuration, check_shape
from nrp_jax.scene.nearest import nearest_free
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, build_world
from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.data_file import read_json


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class QueryHome:
    """A home with n queries; equal to itself only."""

    name: str
    grid: Grid  # planar for a planar robot
    starts: np.ndarray  # (n, D)
    goals: np.ndarray  # (n, D)
    labels: tuple[str, ...] = ()  # of the queries; of named poses only
    notes: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # poses moved or left out

    def fingerprint(self) -> str:
        """Of the cells, where they lie, and the queries."""
        digest = hashlib.sha256(np.packbits(self.grid.occupied).tobytes())
        digest.update(str((self.grid.occupied.shape, self.grid.resolution)).encode())
        for numbers in (self.grid.origin, self.starts, self.goals):
            digest.update(np.asarray(numbers, np.float64).tobytes())
        return digest.hexdigest()[:12]


def unseen(robot: MobileRobot, num: int, queries: int, seed: int) -> list[QueryHome]:
    """Test homes of a data set, which no network was trained in, each with long queries.

    They are taken as they come, whatever a planner makes of them. A home without places that are
    far enough apart is passed over.

    Args:
        robot: the robot.
        num: of homes.
        queries: of a home.
        seed: of the data set.

    Raises:
        ValueError: hardly any home has long queries.
    """
    found: list[QueryHome] = []
    for index in range(10 * num):
        own = home_seed(DatasetSettings(task=robot.name, seed=seed), "test", index)
        grid = _fitting(robot, generate_house(own, robot.name).grid)
        try:
            found.append(_with_long_queries(robot, f"test {own}", grid, queries, own))
        except ValueError as error:
            print(f"home {own} is passed over: {error}", file=sys.stderr)
        if len(found) == num:
            return found
    raise ValueError(f"only {len(found)} of {10 * num} homes have long queries; take another seed")


def from_maps(
    robot: MobileRobot,
    folder: Path,
    num: int,
    queries: int,
    seed: int,
    poses: Mapping[str, np.ndarray] | None = None,
    legs: bool = False,
) -> list[QueryHome]:
    """The first maps in a folder, or one map, with long queries or all ordered pairs of poses.

    Args:
        robot: the robot.
        folder: see :func:`nrp_jax.bench.maps.load_maps`.
        num: maps at most.
        queries: of a map, at most.
        seed: of long queries.
        poses: (D,) by name.
        legs: only the pairs of a pose and the next one.

    Raises:
        ValueError: no map fits, or in none of them there is a query.
    """
    grids = load_maps(folder, robot.name, lambda grid: _fitting(robot, grid))
    found = []
    for name, grid in grids.items():
        try:
            found.append(
                _with_long_queries(robot, name, grid, queries, seed)
                if poses is None
                else _with_poses(robot, name, grid, poses, queries, legs)
            )
        except ValueError as error:
            if len(grids) == 1:
                raise ValueError(f"map '{name}' of '{folder}': {error}") from None
            print(f"map '{name}' is left out: {error}", file=sys.stderr)
        if len(found) == num:
            break
    if not found:
        raise ValueError(f"no queries in the maps of '{folder}'; the lines above tell why")
    return found


def read_poses(file: Path, robot: MobileRobot, key: str | None = None) -> dict[str, np.ndarray]:
    """Read named configurations.

    Args:
        file: JSON of an object, or ``.npz``. A name has one configuration (D,), or several (n, D),
            which are then called "name 0", "name 1" and so on. Texts are passed over.
        robot: whose configurations they are.
        key: the only name to read; all if None.

    Raises:
        ValueError: the file is none of this kind, or has fewer than two configurations.
        OSError: it cannot be read.
    """
    try:
        named = dict(read_arrays(file) if file.suffix == ".npz" else read_json(file))
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"'{file}' holds no poses ({error}); expected a JSON object or an .npz of named "
            "configurations"
        ) from None
    if key is not None and key not in named:
        raise ValueError(f"'{file}' has no '{key}'; have: {', '.join(named)}")
    poses: dict[str, np.ndarray] = {}
    for name, value in named.items():
        if key not in (None, name) or _is_text(value):
            continue
        try:
            value = np.asarray(value, float)
        except (TypeError, ValueError):
            raise ValueError(f"pose '{name}' in '{file}' is no list of numbers") from None
        rows = value if value.ndim == 2 else [value]
        for index, row in enumerate(rows):
            called = name if value.ndim == 1 else f"{name} {index}"
            poses[called] = check_shape(robot, row, f"pose '{called}' in '{file}'")
    if len(poses) < 2:
        raise ValueError(f"'{file}' has {len(poses)} poses; expected two at least")
    return poses


def _is_text(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        value = value.ravel()
    parts = [value] if isinstance(value, str) or not isinstance(value, Iterable) else value
    return any(isinstance(part, str) for part in parts)


def _fitting(robot: MobileRobot, grid: Grid) -> Grid:
    """The map as the robot sees it.

    Raises:
        ValueError: the robot cannot be put into it.
    """
    grid = grid.flatten() if robot.planar else grid
    build_world(robot, grid)
    return grid


def _with_long_queries(
    robot: MobileRobot, name: str, grid: Grid, queries: int, seed: int
) -> QueryHome:
    starts, goals = long_queries(robot, build_world(robot, grid), grid, queries, seed)
    return QueryHome(name=name, grid=grid, starts=starts, goals=goals)


def _with_poses(
    robot: MobileRobot,
    name: str,
    grid: Grid,
    poses: Mapping[str, np.ndarray],
    queries: int,
    legs: bool,
) -> QueryHome:
    """All ordered pairs of poses, or ``legs`` from each to the next.

    A pose that is refused is replaced by the nearest that is free.
    """
    world = build_world(robot, grid)
    free, moved, refused = {}, {}, {}
    for pose, q in poses.items():
        free[pose], problem = _freed(robot, world, q, pose)
        if problem and free[pose] is not None:
            moved[pose] = {"refused": problem, "instead": free[pose].tolist()}
        elif problem:
            refused[pose] = problem
            del free[pose]
    ordered = itertools.pairwise(free) if legs else itertools.permutations(free, 2)
    pairs = list(ordered)[:queries]
    if not pairs:
        raise ValueError(f"fewer than two poses are free: {'; '.join(refused.values())}")
    return QueryHome(
        name=name,
        grid=grid,
        starts=np.stack([free[a] for a, _ in pairs]),
        goals=np.stack([free[b] for _, b in pairs]),
        labels=tuple(f"{a} to {b}" for a, b in pairs),
        notes={"poses_moved": moved, "poses_refused": refused},
    )


def _freed(
    robot: MobileRobot, world: GridWorld, q: np.ndarray, name: str
) -> tuple[np.ndarray | None, str]:
    """A pose that is free, the nearest one if need be, and what was wrong with the one given."""
    try:
        return check_configuration(robot, world, q, name), ""
    except ValueError as error:
        return nearest_free(robot, world, q, key=jax.random.key(0)), str(error)
