"""Feed both commands damaged and odd inputs, and tell what they do not answer as they should.

``python tests/fuzz.py --command vrrt --count 1000 --seed 1``, from the repository. All is read by
the code that users run; what comes after the reading (searches, training, the browser) is left out.
An answer is as it should be if the command goes on, or ends with the exit code 2 and one line that
names what is wrong; no input changes, and time and memory stay bounded. A worker does the work, so
that what kills it is told too. With ``--options`` the files stay as they are, and options are odd.
"""

import argparse
import contextlib
import functools
import json
import os
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from unittest import mock

if __name__ == "__main__":  # the packages and the inputs lie beside this file
    sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

import fuzz_options
import numpy as np
from fuzz_damage import damage

SECONDS, SILENT_SECONDS, BYTES = 30, 90, 1 << 30  # that a command may take
WORDS = ("allow_pickle", "Traceback", "object at 0x")  # that mean nothing to users
# What may be named in place of the damaged file, where that says where the robot should be.
NAMED = ("--", "camera 0", "the start", "the goal", "configuration", "at home", "self-model")


class Read(BaseException):
    """All inputs are read."""


# What follows the reading, by command.
STOPS = {
    "vrrt": (
        *("vrrt_jax.planner.plan_by_loss", "vrrt_jax.bench.dream._solve"),
        *("vrrt_jax.splat.fit_robot.fit_self_model", "vrrt_jax.bench.arm._run_scene"),
        *(
            "vrrt_jax.splat.mujoco_images.MeshRenderer.picture",
            "vrrt_jax.robots.robot_fit.fit_spheres",
        ),
        *("vrrt_jax.bench.runner.in_workers", "vrrt_jax.bench.pose_ambiguity.draw"),
        *(f"vrrt_jax.bench.{name}.run" for name in ("kinematics", "raster", "search")),
        *("vrrt_jax.bench.pose_ambiguity.run", "vrrt_jax.doctor.findings"),
    ),
    "nrp": (
        *("nrp_jax.planner._searched", "nrp_jax.bench.curves.in_workers"),
        *("nrp_jax.bench.score.score_homes", "nrp_jax.learning.train.run_epochs"),
        *("nrp_jax.online.train_online", "nrp_jax.learning.shards.in_workers"),
        *("nrp_jax.bench.checks.run", "nrp_jax.bench.planning.run", "nrp_jax.bench.growth.run"),
        "nrp_jax.homes.figure.generate_house",
    ),
}


class Inputs:
    """A folder of valid inputs, of which one is damaged at a time."""

    def __init__(self, name: str, folder: Path):
        """Write them."""
        import fuzz_inputs

        import nrp_jax.cli
        import vrrt_jax.cli

        self.name = name
        self.parser = {"vrrt": vrrt_jax.cli, "nrp": nrp_jax.cli}[name]._parser()
        self.folder, self.out = folder / "inputs", folder / "out"
        self.folder.mkdir()
        make = fuzz_inputs.vrrt_inputs if name == "vrrt" else fuzz_inputs.nrp_inputs
        self.commands = make(self.folder)
        self.files = sorted(path for path in self.folder.rglob("*") if path.is_file())
        self.bytes = {file: file.read_bytes() for file in self.files}

    def case(self, seed: int, number: int) -> tuple[Path, str, list[str]]:
        """Damage a file that a command reads; returns the file, what was done, and the command."""
        rng = np.random.default_rng([seed, number])
        place, words = self.commands[int(rng.integers(len(self.commands)))]
        near = [file for file in self.files if self._is_read(file, place, words)]
        file = near[int(rng.integers(len(near)))]
        return file, damage(rng, file, self.files), self.written(words)

    def odd_options(self, seed: int, number: int) -> tuple[Path, str, list[str]]:
        """A command with odd options; returns a file that it may name, what was done, and it."""
        rng = np.random.default_rng([seed, number, 1])
        commands = [words for _, words in self.commands] + list(fuzz_options.BARE[self.name])
        words = commands[int(rng.integers(len(commands)))]
        words, done = fuzz_options.odd(rng, self.parser, words, self.files)
        return self.folder, done, self.written(words)

    def written(self, words: list[str]) -> list[str]:
        """A command with the empty folder that it writes into."""
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir()
        return [word.replace("OUT", str(self.out)) for word in words]

    def reading(self, name: str) -> tuple[Path, list[str]]:
        """A file by its name, and the first command that reads it."""
        file = self.folder / name
        words = next(words for place, words in self.commands if self._is_read(file, place, words))
        return file, self.written(words)

    def _is_read(self, file: Path, place: str, words: list[str]) -> bool:
        named = [word for word in words if word.startswith(str(self.folder))]
        if place == ".":
            beside = {"defaults.xml"} if str(self.folder / "arm.xml") in words else set()
            beside |= {"part.stl"} if str(self.folder / "arm.urdf") in words else set()
            return (
                str(file) in named
                or file.name in beside
                or any(str(file).startswith(f"{word}/") for word in named)
            )
        return file == self.folder / place or file.is_relative_to(self.folder / place)

    def snapshot(self) -> dict[str, tuple]:
        """What tells whether files have changed."""
        found = {}
        for path in sorted(self.folder.rglob("*")):
            status = path.lstat()
            found[str(path)] = (status.st_size, status.st_mtime_ns, status.st_mode)
        return found

    def mend(self) -> None:
        """Put back what was damaged."""
        for path in sorted(self.folder.rglob("*"), reverse=True):
            if path not in self.bytes and (path.is_symlink() or not path.is_dir()):
                path.unlink()
        for file, content in self.bytes.items():
            if file.is_symlink() or (file.exists() and not file.is_file()):
                file.rmdir() if file.is_dir() and not file.is_symlink() else file.unlink()
            if not file.exists() or file.read_bytes() != content:
                file.write_bytes(content)


@contextlib.contextmanager
def reading_only(name: str):
    """Inside, the command stops when all inputs are read."""
    stops = contextlib.ExitStack()
    with stops:
        for place in STOPS[name]:
            with contextlib.suppress(AttributeError):
                stops.enter_context(mock.patch(place, side_effect=Read))
        page = mock.MagicMock()
        page.return_value.serve.side_effect = Read
        stops.enter_context(mock.patch(f"{name}_jax.viewer.Page", page))
        yield


def _stderr():
    """As Python opens it."""
    return open(2, "w", errors="backslashreplace", closefd=False)


def answer(name: str, words: list[str]) -> tuple[int | str, str, list[BaseException], list]:
    """Exit code (or "read"), what was written to the standard error, exceptions and warnings."""
    import nrp_jax.cli
    import vrrt_jax.cli
    from vrrt_jax.core import command

    errors: list[BaseException] = []
    told = command.in_one_line

    def noted(error):
        errors.append(error)
        return told(error)

    main = {"vrrt": vrrt_jax.cli.main, "nrp": nrp_jax.cli.main}[name]
    with (
        tempfile.TemporaryFile() as heard,
        open(os.devnull, "w") as nowhere,
        warnings.catch_warnings(record=True) as warned,
    ):
        warnings.simplefilter("always")
        sys.stderr.flush()
        before = os.dup(2)
        os.dup2(heard.fileno(), 2)
        try:
            with (
                mock.patch.object(command, "in_one_line", noted),
                mock.patch.object(sys, "stderr", _stderr()),
                mock.patch.object(sys, "stdout", nowhere),
            ):
                try:
                    code = main(words)
                except Read:
                    code = "read"
                except BaseException as error:
                    code = f"raised {error!r}"
                sys.stderr.flush()
        finally:
            os.dup2(before, 2)
            os.close(before)
        heard.seek(0)
        return code, heard.read().decode(errors="replace"), errors, list(warned)


def faults(inputs: Inputs, name: str, file: Path, words: list[str]) -> tuple[list[str], str]:
    """What is not as it should be about the answer, and the answer."""
    from vrrt_jax.core.command import KNOWN_ERRORS

    before, started = inputs.snapshot(), time.process_time()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    code, heard, errors, warned = answer(name, words)
    took = time.process_time() - started
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - most)
    lines = [line for line in heard.split("\n") if line and "\r" not in line]
    found = []
    if code not in (0, 2, "read"):
        found.append(f"exit code {code}")
    if code == 2 and len(lines) != 1 or code != 2 and lines:
        found.append(f"{len(lines)} lines on the standard error")
    if any(not isinstance(error, (*KNOWN_ERRORS, MemoryError)) for error in errors):
        found.append(f"unexpected {type(errors[-1]).__name__}")
    if said := [word for word in WORDS if word in heard]:
        found.append(f"says {said[0]!r}")
    options = [word[2:].partition("=") for word in words if word.startswith("--")]
    given = [part for name, _, value in options for part in (name, *value.split(","))]
    named = (file.stem, file.parent.name, *NAMED, *(part[:99] for part in given))
    if code == 2 and not any(name in heard for name in named if name):
        found.append("names nothing that was given")
    found += sorted(
        {f"{w.category.__name__}" for w in warned if not issubclass(w.category, UserWarning)}
    )
    if inputs.snapshot() != before:
        found.append("an input has changed")
    if took > SECONDS:
        found.append(f"{took:.0f} s")
    if grown > BYTES:
        found.append(f"{grown / 2**30:.1f} GiB more")
    return found, f"{code}: {heard.strip()[:700]}"


def judged(inputs: Inputs, name: str, file: Path, done: str, words: list[str]) -> dict:
    """Ask, judge, and mend the file."""
    try:
        found, told = faults(inputs, name, file, words)
    finally:
        inputs.mend()
    where = str(file.relative_to(inputs.folder))
    told = told.replace(str(inputs.folder), "IN")
    return {"command": words[:2], "file": where, "done": done, "faults": found, "told": told}


@contextlib.contextmanager
def inputs_of(name: str):
    """The valid inputs of a command in a folder of their own, which is the working directory."""
    here = os.getcwd()
    with tempfile.TemporaryDirectory() as folder, reading_only(name):
        os.chdir(folder)
        try:
            yield Inputs(name, Path(folder))
        finally:
            os.chdir(here)


def work(
    name: str, seed: int, numbers: range, say=lambda line: None, *, options: bool = False
) -> list[dict]:
    """Try cases one after the other: damaged files, or odd options."""
    rows = []
    with inputs_of(name) as inputs:
        case = inputs.odd_options if options else inputs.case
        for number in numbers:
            say(json.dumps({"begin": number}))
            rows.append({"number": number, **judged(inputs, name, *case(seed, number))})
            say(json.dumps(rows[-1]))
    return rows


def watched(name: str, seed: int, count: int, first: int = 0, *flags: str):
    """Rows of a worker that is begun again where something kills it."""
    while first < count:
        words = ["--command", name, "--seed", seed, "--count", count, "--first", first, "--worker"]
        words += flags
        worker = subprocess.Popen(
            [sys.executable, __file__, *map(str, words)], stdout=subprocess.PIPE, bufsize=0
        )
        assert worker.stdout is not None
        begun, heard = None, b""
        while select.select([worker.stdout], [], [], SILENT_SECONDS)[0]:
            if not (part := worker.stdout.read(1 << 16)):
                break
            *lines, heard = (heard + part).split(b"\n")
            for row in map(json.loads, lines):
                begun = row.get("begin", begun)
                if "faults" in row:
                    first = row["number"] + 1
                    yield row
        code = worker.poll()
        worker.kill()
        worker.wait()
        if begun is None:
            raise RuntimeError(f"the worker ended with {code} before its first input")
        if first < count:
            end = "it hangs" if code is None else f"the process ended with {code}"
            yield {"number": begun, "faults": [end], "told": ""}
            first = begun + 1


def main() -> int:
    """Print what is not as it should be; 1 if there is such a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--command", choices=("vrrt", "nrp"), required=True)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--all", action="store_true", help="print what is as it should be too")
    parser.add_argument("--options", action="store_true", help="odd options, not damaged files")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        say = functools.partial(print, flush=True)
        numbers = range(given.first, given.count)
        work(given.command, given.seed, numbers, say, options=given.options)
        return 0
    bad = refused = 0
    flags = ["--options"] * given.options
    for row in watched(given.command, given.seed, given.count, given.first, *flags):
        bad += bool(row["faults"])
        refused += row["told"].startswith("2")
        if row["faults"] or given.all:
            print(json.dumps(row, ensure_ascii=False), flush=True)
    print(f"{given.count - given.first} inputs, {refused} refused, {bad} not as they should be")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
