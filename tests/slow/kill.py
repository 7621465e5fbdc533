"""Commands that are killed (kill -9) at random moments and begun again.

Run ``python -m tests.slow.kill --kills 20``. Nothing that was reported as done may be lost or
counted twice, and what comes out is what an undisturbed run tells.
"""

import argparse
import shutil
import subprocess
import time
from collections import Counter
from pathlib import Path

import numpy as np

from .commands import Command, end, start, told_file, try_all


def fresh(folder: Path) -> Path:
    """The folder, empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def last_words(folder: Path) -> str:
    """The end of what a run told."""
    return told_file(folder).read_text()[-300:].strip()


def undisturbed(command: Command, folder: Path) -> float:
    """A whole run; how long it took [s]."""
    began = time.monotonic()
    run = start(command, fresh(folder))
    assert run.wait(timeout=900) == 0, last_words(folder)
    return time.monotonic() - began


def kept(command: Command, folder: Path, before: dict) -> dict:
    """What a killed run leaves; an assertion fails if anything of before is gone or twice there."""
    done = command.done(folder)
    twice = [name for name, count in Counter(name for name, _ in done).items() if count > 1]
    assert not twice, f"counted twice: {twice}"
    lost = [name for name, value in before.items() if dict(done).get(name) != value]
    assert not lost, f"lost or changed: {lost}"
    return dict(done)


def disturbed(command: Command, shared: Path, kills: int, rng: np.random.Generator) -> str:
    """Kill runs of a command, and begin them again, until all kills are done."""
    undisturbed(command, shared / "whole")  # compiles
    length = undisturbed(command, shared / "whole")
    expected = command.result(shared / "whole")
    folder, before, done, whole, noise = fresh(shared / "killed"), {}, 0, 0, 0
    while True:
        run = start(command, folder)
        try:
            # Nobody knows where in a run a kill comes; the last run is left alone.
            run.wait(rng.uniform(0.0, 1.05 * length) if done < kills else 900)
        except subprocess.TimeoutExpired:
            end(run)
            done += 1
            before = kept(command, folder, before)
            continue
        assert run.returncode == 0, f"after {done} kills: {last_words(folder)}"
        noise += "Traceback" in (told := told_file(folder).read_text()) or "Error" in told
        before = kept(command, folder, before)
        assert command.result(folder) == expected, "the results differ from an undisturbed run's"
        assert not (left := list(folder.rglob("*.part"))), f"unfinished files are left: {left}"
        whole += 1
        if done >= kills:
            return f"{done} kills, {whole} whole runs of {length:.0f} s, {noise} with errors told"
        folder, before = fresh(shared / "killed"), {}


def main() -> int:
    """Kill them all; ends with 1 if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20, help="of each command")
    parser.add_argument("--seed", type=int, default=0)

    def attempt(command, shared, arguments):
        rng = np.random.default_rng(arguments.seed)
        return disturbed(command, shared, arguments.kills, rng), []

    return try_all(parser, attempt)


if __name__ == "__main__":
    raise SystemExit(main())
