"""Data sets: rows that the expert wrote about many homes, in one shard a home.

A folder holds ``manifest.json`` and ``train_00000.npz``, ``test_00000.npz`` and so on. Everything
is written under another name first, so that a killed run leaves nothing half written.
"""

import argparse
import concurrent.futures
import dataclasses
import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nrp_jax.homes import houses
from nrp_jax.homes.grid import Grid
from vrrt_jax.core.command import end_with_parent, usable_cores
from vrrt_jax.core.files import UNFINISHED, replacing

VERSION = 4  # of the rows
MANIFEST = "manifest.json"
ROWS = ("q_start", "q_goal", "waypoint", "optimal", "ratio", "length", "query")
FIRST_TEST_SEED = 1_000_000  # homes for tests have seeds from here on, those for training below


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What a data set is made with; two runs into one folder must agree on it."""

    task: str  # "snake" or "fetch"
    queries: int = 500  # of a home
    waypoints: int = 8  # of a query
    nodes: int = 10_000  # of a home's roadmap
    seed: int = 0
    homes_version: int = houses.VERSION
    rows_version: int = VERSION


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dataset:
    """Rows of one split, n of them, and the homes they are from."""

    settings: Settings
    grids: list[Grid]  # (X, Y, Z) each; the snake sees ``grid.flatten()``
    rows: dict[str, np.ndarray]
    """``q_start``, ``q_goal``, ``waypoint``, ``optimal`` (n, D): start, goal, a waypoint in the
    start's window, and the expert's; ``ratio`` (n,): length of the path through the waypoint over
    the optimum, inf where the straight edge to it is blocked; ``length`` (n,): of the optimum [m];
    ``query`` (n,): which rows belong together within a home; ``home`` (n,): index of the grid."""

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows["ratio"])


def write_dataset(
    out: str | Path,
    settings: Settings,
    *,
    homes: int = 25,
    test_homes: int = 5,
    jobs: int = 1,
    on_progress: Callable[[int, int], Any] | None = None,
) -> dict[str, Any]:
    """Write the shards that are missing or damaged.

    Args:
        out: folder, new or with a data set of the same settings.
        settings: what to write.
        homes: homes for training.
        test_homes: homes for tests, which no training home equals.
        jobs: processes.
        on_progress: called with shards done and shards in all.

    Returns:
        The manifest.

    Raises:
        ValueError: a number out of range, or the folder holds something else.
    """
    _check(settings, homes, test_homes, jobs)
    out = Path(out)
    manifest = _open(out, settings)
    wanted = [("train", k) for k in range(homes)] + [("test", k) for k in range(test_homes)]
    todo = [w for w in wanted if not _intact(out, _name(*w), manifest["shards"])]
    done = len(wanted) - len(todo)
    if on_progress is not None:
        on_progress(done, len(wanted))
    for name, entry in _run(out, settings, todo, jobs):
        manifest["shards"][name] = entry
        manifest["rows"] = sum(shard["rows"] for shard in manifest["shards"].values())
        _write_manifest(out, manifest)
        done += 1
        if on_progress is not None:
            on_progress(done, len(wanted))
    return manifest


def load_dataset(folder: str | Path, split: str = "train") -> Dataset:
    """Read a split.

    Args:
        folder: where :func:`write_dataset` wrote.
        split: "train" or "test".

    Raises:
        FileNotFoundError: there is no data set.
        ValueError: the split is unknown or empty, or a shard is damaged.
    """
    folder = Path(folder)
    if split not in ("train", "test"):
        raise ValueError(f"unknown split '{split}'; have: train, test")
    manifest = _read_manifest(folder)
    settings = Settings(**manifest["settings"])
    current = (houses.VERSION, VERSION)
    if (settings.homes_version, settings.rows_version) != current:
        raise ValueError(
            f"data set '{folder}' has homes and rows of versions {settings.homes_version} and "
            f"{settings.rows_version}; expected {current[0]} and {current[1]}: write it again with "
            "`nrp data`"
        )
    names = sorted(name for name in manifest["shards"] if name.startswith(split))
    if not names:
        raise ValueError(f"data set '{folder}' has no shards for '{split}' yet; run `nrp data`")
    grids, parts = [], []
    for home, name in enumerate(names):
        if not _intact(folder, name, manifest["shards"]):
            raise ValueError(
                f"shard '{folder / name}' is missing or damaged; run `nrp data --task "
                f"{settings.task} --out {folder}` with the same settings to make it again"
            )
        with np.load(folder / name) as data:
            grids.append(Grid(occupied=np.unpackbits(data["occupied"], axis=-1).astype(bool)
                              [..., : int(data["layers"])]))  # fmt: skip
            parts.append({key: data[key] for key in ROWS})
            parts[-1]["home"] = np.full(len(data["ratio"]), home, np.int32)
    rows = {key: np.concatenate([part[key] for part in parts]) for key in (*ROWS, "home")}
    return Dataset(settings=settings, grids=grids, rows=rows)


def fingerprint(folder: str | Path) -> str:
    """What names the training rows of a folder, wherever it lies."""
    shards = _read_manifest(Path(folder))["shards"]
    sums = [shards[name]["sha256"] for name in sorted(shards) if name.startswith("train")]
    return hashlib.sha256("".join(sums).encode()).hexdigest()[:16]


def home_seed(settings: Settings, split: str, index: int) -> int:
    """Seed of a home: those of the splits never meet."""
    return settings.seed * 10_000 + index + (FIRST_TEST_SEED if split == "test" else 0)


def make_shard(settings: Settings, split: str, index: int, path: Path) -> dict[str, Any]:
    """Generate a home, ask the expert and write the rows; returns the manifest's entry."""
    import jax

    from nrp_jax.learning import expert
    from nrp_jax.learning.difficulty import fair_house
    from nrp_jax.scene.robots import load_robot
    from nrp_jax.scene.world import build_world

    seed = home_seed(settings, split, index)
    robot = load_robot(settings.task)
    house = fair_house(robot, seed)
    world = build_world(robot, house.grid)
    roadmap = expert.build_roadmap(world, robot, jax.random.key(seed), settings.nodes)
    rows = expert.make_rows(
        world,
        robot,
        roadmap,
        np.random.default_rng(seed),
        settings.queries,
        settings.waypoints,
    )
    with replacing(path) as file:
        np.savez_compressed(
            file,
            occupied=np.packbits(house.grid.occupied, axis=-1),
            layers=house.grid.occupied.shape[2],
            **{key: getattr(rows, key) for key in ROWS},
        )
    return {"rows": len(rows.ratio), "seed": seed, "sha256": _checksum(path)}


def _run(out: Path, settings: Settings, todo: list[tuple[str, int]], jobs: int):
    """Names and manifest entries of the shards to do, as they get ready."""
    if jobs == 1 or len(todo) <= 1:
        for split, index in todo:
            name = _name(split, index)
            yield name, make_shard(settings, split, index, out / name)
        return
    import jax

    pool = concurrent.futures.ProcessPoolExecutor(
        min(jobs, len(todo)),
        multiprocessing.get_context("spawn"),
        _start_worker,
        (jax.config.jax_compilation_cache_dir,),
    )
    try:
        names = {}
        for split, index in todo:
            name = _name(split, index)
            names[pool.submit(make_shard, settings, split, index, out / name)] = name
        failure = None
        for future in concurrent.futures.as_completed(names):
            if future.cancelled():
                continue
            if problem := future.exception():
                failure = failure or problem
                for other in names:
                    other.cancel()
            else:  # also of those that were under way when another failed
                yield names[future], future.result()
        if failure:
            raise failure
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(cache: str | None) -> None:
    """One thread for each process (XLA reads NPROC when it starts), and the parent's cache."""
    import jax

    end_with_parent()
    os.environ["NPROC"] = "1"
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def _check(settings: Settings, homes: int, test_homes: int, jobs: int) -> None:
    if settings.task not in houses.CELLS:
        raise ValueError(f"unknown task '{settings.task}'; have: {', '.join(houses.CELLS)}")
    for name, value, least in (
        ("homes", homes, 0),
        ("test homes", test_homes, 0),
        ("queries", settings.queries, 1),
        ("waypoints", settings.waypoints, 1),
        ("nodes", settings.nodes, 500),
        ("seed", settings.seed, 0),
        ("jobs", jobs, 1),
    ):
        if value < least:
            raise ValueError(f"{value} {name}: expected at least {least}")
    if homes > 10_000 or test_homes > 10_000 or settings.seed >= 100:
        raise ValueError("expected at most 10000 homes of either split and a seed below 100")


def _open(out: Path, settings: Settings) -> dict[str, Any]:
    """The manifest of a new or fitting data set; old scratch files go."""
    out.mkdir(parents=True, exist_ok=True)
    if not (out / MANIFEST).exists():
        if any(path.suffix != UNFINISHED for path in out.iterdir()):
            raise ValueError(f"folder '{out}' is not empty and holds no data set; take another")
        manifest = {"settings": dataclasses.asdict(settings), "rows": 0, "shards": {}}
        _write_manifest(out, manifest)
    manifest = _read_manifest(out)
    for key, value in dataclasses.asdict(settings).items():
        if manifest["settings"].get(key) != value:
            raise ValueError(
                f"the data set in '{out}' was made with {key} {manifest['settings'].get(key)}, not "
                f"{value}; take another folder, or the same settings"
            )
    for path in out.glob(f"*{UNFINISHED}"):
        path.unlink()
    return manifest


def _read_manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(f"no data set in '{folder}': {MANIFEST} is missing; run `nrp data`")
    try:
        manifest = json.loads(path.read_text())
        if not {"settings", "shards"} <= manifest.keys():
            raise ValueError("settings or shards are missing")
        Settings(**manifest["settings"])
    except (ValueError, AttributeError, TypeError) as error:
        raise ValueError(
            f"'{path}' is not readable ({error}); remove the folder and write it again"
        ) from error
    return manifest


def _intact(folder: Path, name: str, shards: dict[str, Any]) -> bool:
    path = folder / name
    return name in shards and path.is_file() and _checksum(path) == shards[name]["sha256"]


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _write_manifest(out: Path, manifest: dict[str, Any]) -> None:
    with replacing(out / MANIFEST, "w") as file:
        file.write(json.dumps(manifest, indent=1))


def _name(split: str, index: int) -> str:
    return f"{split}_{index:05d}.npz"


def add_arguments(subparsers) -> None:
    """Add the ``data`` command to a command line."""
    parser = subparsers.add_parser("data", help="write a data set, or go on with one")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", required=True, choices=tuple(houses.CELLS), help="whose rows")
    parser.add_argument("--out", required=True, help="folder")
    parser.add_argument("--homes", type=int, default=25, help="for training")
    parser.add_argument("--test-homes", type=int, default=5, help="apart, for tests")
    parser.add_argument("--queries", type=int, default=Settings.queries, help="of a home")
    parser.add_argument("--waypoints", type=int, default=Settings.waypoints, help="of a query")
    parser.add_argument("--nodes", type=int, default=Settings.nodes, help="of a roadmap")
    parser.add_argument("--seed", type=int, default=0, help="of homes, roadmaps and rows")
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="processes")


def _run_command(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    settings = Settings(
        task=arguments.task,
        queries=arguments.queries,
        waypoints=arguments.waypoints,
        nodes=arguments.nodes,
        seed=arguments.seed,
    )
    with tqdm(unit="home", disable=None) as bar:

        def on_progress(done: int, total: int) -> None:
            bar.total = total
            bar.n = done
            bar.refresh()

        manifest = write_dataset(
            arguments.out,
            settings,
            homes=arguments.homes,
            test_homes=arguments.test_homes,
            jobs=arguments.jobs,
            on_progress=on_progress,
        )
    print(f"{manifest['rows']} rows of {len(manifest['shards'])} homes in {arguments.out}")
    return 0
