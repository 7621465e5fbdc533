"""Shards of data sets: the rows of one home each, made one by one or in several processes."""

import concurrent.futures
import dataclasses
import hashlib
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from nrp_jax.homes import houses
from nrp_jax.learning.difficulty import fair_house
from nrp_jax.learning.experiences import make_experience_rows
from nrp_jax.learning.expert import make_rows
from nrp_jax.learning.paths import make_path_rows
from nrp_jax.learning.roadmap import build_roadmap
from nrp_jax.scene.robots import load_robot
from nrp_jax.scene.world import build_world
from vrrt_jax.core.command import end_with_parent
from vrrt_jax.core.files import replacing

VERSION = 6  # of rows, checks of their edges and choice of homes; other versions are refused
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
    homes_version: int = houses.VERSION
    rows_version: int = VERSION


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


def make_shard(settings: DatasetSettings, split: str, index: int, path: Path) -> dict[str, Any]:
    """Generate a home, ask the expert about it and write the rows.

    Args:
        settings: of the data set.
        split: "train" or "test".
        index: of the home in its split.
        path: the file to write.

    Returns:
        The shard's entry in the manifest: number of rows, seed of the home, and checksum.
    """
    seed = home_seed(settings, split, index)
    robot = load_robot(settings.task)
    house = fair_house(robot, seed)
    world = build_world(robot, house.grid)
    roadmap = build_roadmap(world, robot, jax.random.key(seed), settings.nodes)
    rng = np.random.default_rng(seed)
    make = make_path_rows if settings.paths else make_rows
    make = make_experience_rows if settings.experiences else make
    rows = make(world, robot, roadmap, rng, settings.queries, settings.waypoints)
    with replacing(path) as file:
        np.savez_compressed(
            file,
            occupied=np.packbits(house.grid.occupied, axis=-1),
            layers=house.grid.occupied.shape[2],
            **{key: getattr(rows, key) for key in ROWS},
        )
    return {"rows": len(rows.ratio), "seed": seed, "sha256": checksum(path)}


def make_shards(
    out: Path, settings: DatasetSettings, wanted: Sequence[tuple[str, int]], jobs: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Make several shards, in several processes if asked to.

    Args:
        out: folder.
        settings: of the data set.
        wanted: split and index of each shard.
        jobs: processes.

    Yields:
        The name and manifest entry of each shard, as soon as it is written.
    """
    if jobs == 1 or len(wanted) <= 1:
        for split, index in wanted:
            name = shard_name(split, index)
            yield name, make_shard(settings, split, index, out / name)
        return
    pool = concurrent.futures.ProcessPoolExecutor(
        min(jobs, len(wanted)),
        multiprocessing.get_context("spawn"),
        _start_worker,
        (jax.config.jax_compilation_cache_dir,),
    )
    try:
        names = {}
        for split, index in wanted:
            name = shard_name(split, index)
            names[pool.submit(make_shard, settings, split, index, out / name)] = name
        # After a failure no shard is begun, but those under way are finished and kept.
        failure = None
        for future in concurrent.futures.as_completed(names):
            if future.cancelled():
                continue
            if problem := future.exception():
                failure = failure or problem
                for other in names:
                    other.cancel()
            else:
                yield names[future], future.result()
        if failure:
            raise failure
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(cache: str | None) -> None:
    """Give a worker process one thread (XLA reads NPROC when it starts) and the parent's cache."""
    end_with_parent()
    os.environ["NPROC"] = "1"
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
