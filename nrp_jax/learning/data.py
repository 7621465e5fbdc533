"""Data sets: expert data about many homes, one shard a home.

A folder holds ``manifest.json`` and the shards ``train_00000.npz``, ``test_00000.npz`` and so on.
Every file is written under another name first, so that a killed run leaves no half written file.
"""

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nrp_jax.homes import houses
from nrp_jax.homes.grid import Grid
from nrp_jax.learning.shards import (
    ROWS,
    VERSION,
    DatasetSettings,
    Shard,
    checksum,
    make_shards,
    shard_name,
)
from vrrt_jax.core import command, workers
from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.command import usable_cores
from vrrt_jax.core.data_file import read_json
from vrrt_jax.core.fields import check_fields, record_of
from vrrt_jax.core.files import UNFINISHED, replacing
from vrrt_jax.core.precision import single_precision

MANIFEST = "manifest.json"
_FIELDS = ("settings", "rows", "shards")  # of the manifest


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dataset:
    """The n rows of one split, and the homes they are from."""

    settings: DatasetSettings
    grids: list[Grid]  # (X, Y, Z) each; the snake sees ``grid.flatten()``
    rows: dict[str, np.ndarray]
    """Columns by name, see :class:`nrp_jax.learning.expert.Rows`; ``query`` counts within a home,
    and ``home`` (n,) is the index of the row's grid."""

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows["ratio"])


@single_precision
def write_dataset(
    out: str | Path,
    settings: DatasetSettings,
    *,
    homes: int = 25,
    test_homes: int = 5,
    jobs: int = 1,
    cluster: str | None = None,
    on_progress: Callable[[int, int], Any] | None = None,
) -> dict[str, Any]:
    """Write a data set: all shards of it that are missing or damaged.

    Args:
        out: folder, new or with a data set of the same settings.
        settings: what the data set is made with.
        homes: homes for training.
        test_homes: homes for tests, which no training home equals.
        jobs: processes.
        cluster: address of a Ray cluster, instead of processes.
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
    # What is missing, damaged or not yet begun.
    todo = [w for w in wanted if not _intact(out, shard_name(*w), manifest["shards"])]
    done = len(wanted) - len(todo)
    if on_progress is not None:
        on_progress(done, len(wanted))
    for name, entry in make_shards(out, settings, todo, jobs, cluster):
        # The manifest is written after each shard, so that a killed run can be continued.
        # In the order of names, whatever came first.
        manifest["shards"] = dict(sorted({**manifest["shards"], name: entry}.items()))
        manifest["rows"] = sum(shard["rows"] for shard in manifest["shards"].values())
        _write_manifest(out, manifest)
        done += 1
        if on_progress is not None:
            on_progress(done, len(wanted))
    return manifest


@single_precision
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
    # Rows of other versions mean something else.
    settings = DatasetSettings(**manifest["settings"])
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
    # Shard by shard, in the order of the names; homes are numbered in that order.
    grids, parts = [], []
    for home, name in enumerate(names):
        if not _intact(folder, name, manifest["shards"]):
            raise ValueError(
                f"shard '{folder / name}' is missing or damaged; run `nrp data --task "
                f"{settings.task} --out {folder}` with the same settings to make it again"
            )
        data = read_arrays(folder / name, "occupied", "layers", *ROWS)
        grids.append(Grid(occupied=np.unpackbits(data["occupied"], axis=-1).astype(bool)
                          [..., : int(data["layers"])]))  # fmt: skip
        parts.append({key: data[key] for key in ROWS})
        parts[-1]["home"] = np.full(len(data["ratio"]), home, np.int32)
    rows = {key: np.concatenate([part[key] for part in parts]) for key in (*ROWS, "home")}
    return Dataset(settings=settings, grids=grids, rows=rows)


def fingerprint(folder: str | Path) -> str:
    """A name (16 hexadecimal digits) for the training rows of a folder, wherever it lies."""
    shards = _read_manifest(Path(folder))["shards"]
    sums = [shards[name]["sha256"] for name in sorted(shards) if name.startswith("train")]
    return hashlib.sha256("".join(sums).encode()).hexdigest()[:16]


def _check(settings: DatasetSettings, homes: int, test_homes: int, jobs: int) -> None:
    """Raise a ValueError that names the number out of range."""
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


def _open(out: Path, settings: DatasetSettings) -> dict[str, Any]:
    """Make the folder or open it, and drop files that a killed run left unfinished.

    Returns:
        The manifest.

    Raises:
        ValueError: the folder holds something else, or a data set of other settings.
    """
    out.mkdir(parents=True, exist_ok=True)
    if not (out / MANIFEST).exists():
        if any(path.suffix != UNFINISHED for path in out.iterdir()):
            raise ValueError(f"folder '{out}' is not empty and holds no data set; take another")
        manifest = {"settings": dataclasses.asdict(settings), "rows": 0, "shards": {}}
        _write_manifest(out, manifest)
    manifest = _read_manifest(out)
    there = dataclasses.asdict(DatasetSettings(**manifest["settings"]))
    for key, value in dataclasses.asdict(settings).items():
        if there[key] != value:
            raise ValueError(
                f"the data set in '{out}' was made with {key} {there[key]}, not {value}; take "
                "another folder, or the same settings"
            )
    # Files that a killed run left.
    for path in out.glob(f"*{UNFINISHED}"):
        path.unlink()
    return manifest


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Read a folder's manifest.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(f"no data set in '{folder}': {MANIFEST} is missing; run `nrp data`")
    try:
        manifest = read_json(path)
        check_fields(manifest, _FIELDS, "it")
        if missing := [name for name in _FIELDS if name not in manifest]:
            raise ValueError(f"it lacks {', '.join(missing)}")
        record_of(DatasetSettings, manifest["settings"], "settings")
        for name, entry in dict(manifest["shards"]).items():
            record_of(Shard, entry, f"the shard '{name}'")
            if Path(name).name != name:
                raise ValueError(f"the shard '{name}' is not in the folder")
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"'{path}' is not readable ({error}); remove the folder and write it again"
        ) from error
    return manifest


def _intact(folder: Path, name: str, shards: dict[str, Any]) -> bool:
    """Whether a shard is there and as the manifest has it."""
    path = folder / name
    return name in shards and path.is_file() and checksum(path) == shards[name]["sha256"]


def _write_manifest(out: Path, manifest: dict[str, Any]) -> None:
    with replacing(out / MANIFEST, "w") as file:
        file.write(json.dumps(manifest, indent=1))


def add_arguments(subparsers) -> None:
    """Add the ``data`` command to a command line."""
    default = DatasetSettings
    parser = subparsers.add_parser("data", help="write a data set, or go on with one")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--task", required=True, choices=tuple(houses.CELLS), help="whose rows")
    parser.add_argument("--out", required=True, help="folder")
    parser.add_argument("--homes", type=command.whole(1, 100_000), default=25, help="for training")
    parser.add_argument(
        "--test-homes", type=command.whole(0, 100_000), default=5, help="apart, for tests"
    )
    parser.add_argument(
        "--queries", type=command.whole(1, 1_000_000), default=default.queries, help="of a home"
    )
    parser.add_argument(
        "--waypoints", type=command.whole(1, 10_000), default=default.waypoints, help="of a query"
    )
    parser.add_argument(
        "--nodes", type=command.whole(1, 1_000_000), default=default.nodes, help="of a roadmap"
    )
    parser.add_argument(
        "--seed", type=command.whole(0, 100_000), default=0, help="of homes, roadmaps and rows"
    )
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument(
        "--paths",
        action="store_true",
        help="states along whole paths, for --model global-cvae and --model next",
    )
    kind.add_argument(
        "--experiences", action="store_true", help="corners of shortened paths, for --model fire"
    )
    kind.add_argument(
        "--candidates", action="store_true", help="what NRP-d chooses among, for its discriminator"
    )
    workers.add_arguments(parser, jobs=usable_cores())


def _run_command(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    settings = DatasetSettings(
        task=arguments.task,
        queries=arguments.queries,
        waypoints=arguments.waypoints,
        nodes=arguments.nodes,
        seed=arguments.seed,
        paths=arguments.paths,
        experiences=arguments.experiences,
        candidates=arguments.candidates,
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
            cluster=arguments.cluster,
            on_progress=on_progress,
        )
    print(f"{manifest['rows']} rows of {len(manifest['shards'])} homes in {arguments.out}")
    return 0
