"""Small runs of the commands that take long, in processes of their own, and what they leave."""

import argparse
import csv
import dataclasses
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
# What differs between two runs that did the same: times, the machine's load, and places.
_OWN = {
    *("time_s", "search_s", "compile_s", "seconds", "wall_ms", "stages_ms", "search_median_ms"),
    *("median_time_s", "p95_time_s", "median_ms", "p95_ms", "minutes", "machine", "command"),
    *("steps", "planners", "recompiled", "shortcut_s", "verify_s", "timing", "unit_s"),
}
# A run ends when what began it does, and believes to be the installed command.
_BEGIN = "import ctypes, sys; ctypes.CDLL(None).prctl(1, 9); sys.argv[0] = {!r}\n"
_VRRT = "from vrrt_jax.cli import main; raise SystemExit(main())"
_NRP = "from nrp_jax.cli import main; raise SystemExit(main())"
_FIT = """
from vrrt_jax.splat import fit_robot
from vrrt_jax.splat.fit_config import FitConfig, LevelConfig
level = LevelConfig(num_splats=200, size_px=32, steps=300, batch=4)
small = FitConfig(num_images=60, num_surface_images=20, num_validation=8, image_px=96,
                  levels=(level, level), close_up=level, close_up_of_px=160)
fit_robot.fit_robot.__kwdefaults__["rounds"] = small, small
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Command:
    """A command line, and how to read what it leaves in a folder."""

    name: str
    code: str  # Python that runs it
    words: Callable[[Path], list[str]]  # its arguments
    done: Callable[[Path], list[tuple[str, Any]]]  # what is kept, by name; raises if unreadable
    result: Callable[[Path], Any]  # of a whole run, without what differs between two


def start(command: Command, folder: Path, **options: Any) -> subprocess.Popen:
    """Begin a run in a session of its own, with compiled programs beside the folder."""
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(folder.parent / "cache"))
    own = {
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return subprocess.Popen(
        [
            sys.executable,
            "-c",
            _BEGIN.format(command.name.split()[0]) + command.code,
            *command.words(folder),
        ],
        cwd=folder.parent,
        env=os.environ | own,
        stdout=subprocess.DEVNULL,
        stderr=told_file(folder).open("w"),
        start_new_session=True,
        **options,
    )


def told_file(folder: Path) -> Path:
    """Where the errors of a run in a folder are."""
    return folder.with_name(f"{folder.name}.told")


def end(run: subprocess.Popen, number: int = signal.SIGKILL) -> tuple[int, float]:
    """Send a signal to a run and its workers: exit code, seconds until it ended."""
    began = time.monotonic()
    os.killpg(run.pid, number)
    return run.wait(timeout=120), time.monotonic() - began


def plain(value: Any) -> Any:
    """What is in JSON, without what differs between two runs."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items() if k not in _OWN and not k.endswith("_s")}
    return [plain(part) for part in value] if isinstance(value, list) else value


def _arrays(file: Path) -> dict[str, Any]:
    """Of a file of arrays: sums, and of descriptions what is no time."""
    with np.load(file) as saved:
        return {name: _summed(saved[name]) for name in saved.files}


def _summed(array: np.ndarray) -> Any:
    if array.dtype.kind == "U" and not array.shape and str(array).startswith("{"):
        return plain(json.loads(str(array)))
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def _json(file: Path) -> Any:
    return json.loads(file.read_text()) if file.exists() else {}


def _rows(file: Path) -> list[dict[str, Any]]:
    """The rows that are whole, without the header."""
    text = file.read_text() if file.exists() else ""
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()[1:]]


def _log(file: Path) -> list[dict[str, str]]:
    return [
        {k: v for k, v in row.items() if k != "seconds"}
        for row in csv.DictReader(file.read_text().splitlines())
    ]


def _fit_done(folder: Path) -> list[tuple[str, Any]]:
    if (folder / "arm" / "robot.xml").exists():
        assert _json(folder / "arm" / "robot.json")["name"] == "arm"
    if not (folder / "arm" / "self_model.npz").exists():
        return []
    return [("self-model", _arrays(folder / "arm" / "self_model.npz"))]


def _visual_done(folder: Path) -> list[tuple[str, Any]]:
    tasks = _json(folder / "visual.json").get("tasks", [])
    return [(f"{row['level']} {row['index']}", row) for row in tasks]


def _arm_problems(folder: Path) -> None:
    sys.path.append(str(ROOT / "tests"))
    from arm_cases import AWAY, POST, arrays_of

    import vrrt_jax

    panda = vrrt_jax.load_robot("panda")
    for k in range(4):
        post = np.array(POST) + [0.0, 0.0, 0.02 * k]
        file = folder / f"posts_{k}.npz"
        np.savez(file, **arrays_of(panda, [post] * 3, [AWAY] * 3))


def _curves(folder: Path) -> list[tuple[str, Any]]:
    return [
        (" ".join(str(row[k]) for k in ("planner", "home", "query", "run")), row)
        for row in _rows(folder / "curves.json.rows")
    ]


def _model_done(folder: Path) -> list[tuple[str, Any]]:
    from nrp_jax.learning.checkpoint import load_model

    if (folder / "model" / "model.npz").exists():
        load_model(folder / "model")
    return []


def commands(shared: Path) -> list[Command]:
    """All of them; what they read is made in the folder ``shared`` first."""
    if not (shared / "posts_0.npz").exists():
        _arm_problems(shared)
    data = shared / "data"
    set_words = ["--task", "snake", "--queries", "40", "--nodes", "800"]
    if not data.exists():
        words = ["data", *set_words, "--homes", "4", "--test-homes", "0", "--out", str(data)]
        subprocess.run(
            [sys.executable, "-c", _NRP, *words, "--jobs", "1"], cwd=ROOT, check=True, timeout=600
        )
    return [
        Command(
            name="vrrt fit",
            code=_FIT + _VRRT,
            words=lambda f: ["fit", "--robot", "panda", "--out", str(f / "arm"), "--minutes", "0"],
            done=_fit_done,
            result=lambda f: [
                _arrays(f / "arm" / "self_model.npz"),
                plain(_json(f / "arm" / "robot.json")),
            ],
        ),
        Command(
            name="vrrt bench visual",
            code=_VRRT,
            words=lambda f: [
                *("bench", "visual", "--robot", "panda", "--levels", "0.5"),
                *("--tasks-per-level", "4", "--json", str(f / "visual.json")),
            ],
            done=_visual_done,
            result=lambda f: plain(_json(f / "visual.json")),
        ),
        Command(
            name="vrrt bench arm",
            code=_VRRT,
            words=lambda f: [
                *("bench", "arm", "--problems", str(shared), "--robot", "panda"),
                *("--json", str(f / "arm.json")),
            ],
            done=lambda f: list(_json(f / "arm.json").get("scenes", {}).items()),
            result=lambda f: plain(_json(f / "arm.json")),
        ),
        Command(
            name="nrp data",
            code=_NRP,
            words=lambda f: [
                *("data", *set_words, "--homes", "5", "--test-homes", "1", "--jobs", "2"),
                *("--out", str(f / "set")),
            ],
            done=lambda f: list(_json(f / "set" / "manifest.json").get("shards", {}).items()),
            result=lambda f: [
                _json(f / "set" / "manifest.json"),
                {file.name: _arrays(file) for file in sorted((f / "set").glob("*.npz"))},
            ],
        ),
        Command(
            name="nrp train",
            code="from nrp_jax.learning import training_io; training_io.SECONDS_BETWEEN = 0.5\n"
            + _NRP,
            words=lambda f: [
                *("train", "--task", "snake", "--model", "discriminator", "--data", str(data)),
                *("--epochs", "12", "--batch", "32", "--out", str(f / "model")),
            ],
            done=_model_done,
            result=lambda f: [
                {k: v for k, v in _arrays(f / "model" / "model.npz").items() if "/" in k},
                _log(f / "model" / "log.csv"),
            ],
        ),
        Command(
            name="nrp bench curves",
            code=_NRP,
            words=lambda f: [
                *("bench", "curves", "--planners", "rrt-connect,nrp-connect", "--num-homes", "1"),
                *("--queries", "6", "--nodes", "500", "--json", str(f / "curves.json")),
            ],
            done=_curves,
            result=lambda f: sorted((name, json.dumps(plain(row))) for name, row in _curves(f)),
        ),
    ]


def try_all(
    parser: argparse.ArgumentParser,
    attempt: Callable[[Command, Path, argparse.Namespace], tuple[str, list[str]]],
    more: Sequence[Command] = (),
) -> int:
    """Try all commands, and print what came of each; returns 1 if anything went wrong.

    Args:
        parser: of the options of the attempts.
        attempt: of a command, the folder to work in and the options: what came of it, and what
            went wrong.
        more: commands to try first.
    """
    parser.add_argument("--only", default="", help="commands whose names hold this")
    parser.add_argument("--folder", help="where to work; a temporary one by default")
    arguments = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        shared = Path(arguments.folder or folder)
        shared.mkdir(exist_ok=True)
        for command in [*more, *commands(shared)]:
            if arguments.only not in command.name:
                continue
            try:
                told, wrong = attempt(command, shared, arguments)
            except AssertionError as error:
                told, wrong = "failed", [str(error)]
            failed += len(wrong)
            print(f"{command.name}: {told}, wrong {len(wrong)} {wrong}", flush=True)
    return int(failed > 0)
