"""Ctrl-C at random moments: a command ends within 2 s with one line, and what was done is kept.

Run ``python -m tests.slow.interrupt --times 10``.
"""

import argparse
import signal
import subprocess
from pathlib import Path

import numpy as np

from .commands import Command, end, start, told_file, try_all
from .kill import fresh, kept

SOON = 2.0  # [s]
# Commands that leave nothing before they end.
OTHERS = {
    "vrrt plan": ("vrrt_jax", ["plan", "--problem", "panda_posts", "--no-pictures", "--out"]),
    "nrp plan": (
        "nrp_jax",
        [*("plan", "--problem", "home_1", "--method", "bit-star", "--time-limit", "20"), "--out"],
    ),
    "vrrt bench search": ("vrrt_jax", ["bench", "search", "--json"]),
    "vrrt spheres": ("vrrt_jax", ["spheres", "--robot", "panda", "--spheres", "12", "--out"]),
}


def others() -> list[Command]:
    """Commands whose results are not looked at."""
    return [
        Command(
            name=name,
            code=f"from {package}.cli import main; raise SystemExit(main())",
            words=lambda folder, words=words: [*words, str(folder / "out")],
            done=lambda folder: [],
            result=lambda folder: None,
        )
        for name, (package, words) in OTHERS.items()
    ]


def interrupted(
    command: Command, shared: Path, times: int, within: float, rng: np.random.Generator
) -> tuple[str, list[str]]:
    """Interrupt a command at random moments of so many seconds: how it ended, what was wrong."""
    folder, before = fresh(shared / "interrupted"), {}
    slowest, wrong, count = 0.0, [], 0
    for _ in range(3 * times):
        if count == times:
            break
        run = start(command, folder)
        moment = rng.uniform(0.2, within)
        try:
            run.wait(moment)
        except subprocess.TimeoutExpired:
            code, seconds = end(run, signal.SIGINT)
            lines = [line for line in told_file(folder).read_text().splitlines() if line.strip()]
            lines = [line for line in lines if "\r" not in line and "it/s" not in line]
            before = kept(command, folder, before)
            count, slowest = count + 1, max(slowest, seconds)
            ok = code == 130 and seconds < SOON and "interrupted" in lines[-1]
            if not ok or any("Traceback" in line for line in lines):
                wrong.append(f"at {moment:.1f} s: code {code}, {seconds:.1f} s, {lines[-2:]}")
            continue
        assert run.returncode in (0, 1), told_file(folder).read_text()[-300:]
        folder, before = fresh(shared / "interrupted"), {}
    return f"{count} interrupts, slowest {slowest:.2f} s", wrong


def main() -> int:
    """Interrupt them all; ends with 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=10)
    parser.add_argument("--within", type=float, default=30.0, help="of the start [s]")
    parser.add_argument("--seed", type=int, default=0)

    def attempt(command, shared, arguments):
        rng = np.random.default_rng(arguments.seed)
        return interrupted(command, shared, arguments.times, arguments.within, rng)

    return try_all(parser, attempt, others())


if __name__ == "__main__":
    raise SystemExit(main())
