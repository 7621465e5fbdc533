"""Shards of data sets: the rows of one home each, made here or by several workers."""

import dataclasses
import hashlib
import io
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from nrp_jax.homes import houses
from nrp_jax.learning.candidates import make_candidate_rows
from nrp_jax.learning.difficulty import fair_house
from nrp_jax.learning.experiences import make_experience_rows
from nrp_jax.learning.expert import make_rows
from nrp_jax.learning.paths import make_path_rows
from nrp_jax.learning.roadmap import build_roadmap
from nrp_jax.scene.robots import load_robot
from nrp_jax.scene.world import build_world
from vrrt_jax.core.files import replacing
from vrrt_jax.core.workers import in_workers

VERSION = 6  # of rows, checks of their edges and choice of homes; other versions are refused
_MAKERS = {  # by what the rows hold
    "waypoints": make_rows,
    "paths": make_path_rows,
    "experiences": make_experience_rows,
    "candidates": make_candidate_rows,
}
ROWS = ("q_start", "q_goal", "waypoint", "optimal", "ratio", "length", "query")
FIRST_TEST_SEED = 1_000_000  # seeds of test homes begin here, those of training homes are below


@dataclasses.dataclass(frozen=True, kw_only=True)
class DatasetSettings:
    """What a data set is made with; two runs into one folder must agree on it."""

    task: str  # "snake" or "fetch"
    queries: int = 500  # of a home
    waypoints: int = 8  # of a query
    nodes: int = 10_000  # of a home's roadmap
    seed: int = 0
    paths: bool = False  # waypoints are states along whole paths, for a global CVAE
    experiences: bool = False  # waypoints are the corners of shortened paths, for FIRE
    candidates: bool = False  # waypoints are those that NRP-d chooses among
    homes_version: int = houses.VERSION
    rows_version: int = VERSION

    @property
    def holds(self) -> str:
        """What the waypoints of the rows are: "waypoints", "candidates", "paths", "experiences"."""
        other = ("candidates", "paths", "experiences")
        return next((name for name in other if getattr(self, name)), "waypoints")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shard:
    """A shard's entry in the manifest."""

    rows: int
    seed: int  # of the home
    sha256: str


def home_seed(settings: DatasetSettings, split: str, index: int) -> int:
    """Seed of a home; homes of different splits never share one."""
    return settings.seed * 10_000 + index + (FIRST_TEST_SEED if split == "test" else 0)


def shard_name(split: str, index: int) -> str:
    """Name of a shard's file."""
    return f"{split}_{index:05d}.npz"


def make_shard(settings: DatasetSettings, wanted: tuple[str, int]) -> tuple[str, int, bytes]:
    """Generate a home, ask the expert about it, and pack the rows.

    Args:
        settings: of the data set.
        wanted: split, "train" or "test", and index of the home in it.

    Returns:
        The name of the shard's file, its number of rows, and what it holds.
    """
    seed = home_seed(settings, *wanted)
    robot = load_robot(settings.task)
    house = fair_house(robot, seed)
    world = build_world(robot, house.grid)
    roadmap = build_roadmap(world, robot, jax.random.key(seed), settings.nodes)
    rng = np.random.default_rng(seed)
    make = _MAKERS[settings.holds]
    rows = make(world, robot, roadmap, rng, settings.queries, settings.waypoints)
    packed = io.BytesIO()
    np.savez_compressed(
        packed,
        occupied=np.packbits(house.grid.occupied, axis=-1),
        layers=house.grid.occupied.shape[2],
        **{key: getattr(rows, key) for key in ROWS},
    )
    return shard_name(*wanted), len(rows.ratio), packed.getvalue()


def make_shards(
    out: Path,
    settings: DatasetSettings,
    wanted: Sequence[tuple[str, int]],
    jobs: int,
    cluster: str | None = None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Make several shards and write them.

    Args:
        out: folder.
        settings: of the data set.
        wanted: split and index of each shard.
        jobs: processes.
        cluster: address of a Ray cluster, instead of processes.

    Yields:
        The name of each shard, as soon as it is written, and its entry in the manifest: number of
        rows, seed of the home, and checksum.
    """
    seeds = {shard_name(*one): home_seed(settings, *one) for one in wanted}
    for name, rows, packed in in_workers(partial(make_shard, settings), wanted, jobs, cluster):
        with replacing(out / name) as file:
            file.write(packed)
        yield name, {"rows": rows, "seed": seeds[name], "sha256": checksum(out / name)}


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
