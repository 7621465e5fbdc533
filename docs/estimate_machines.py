"""How long a benchmark would take on many machines, from the times of its tasks on one.

    python docs/estimate_machines.py results.json --start 60 --tasks 1500

Tasks are drawn again from those that were measured. Each core takes the next one as soon as it is
free, as Ray does, after it has started and compiled once.
"""

import argparse
import heapq
import json
from pathlib import Path

import numpy as np

CORES = (1, 2, 4, 10, 20, 100, 200, 400)


def makespan(times: np.ndarray, cores: int, start_s: float) -> float:
    """Seconds until the last task (T,) is done."""
    free = [start_s] * min(cores, len(times))
    for time in times:
        heapq.heapreplace(free, free[0] + time)
    return max(free)


def main() -> None:
    """Print a table of cores, minutes and the share of their time that is spent on tasks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", help="JSON of vrrt bench visual")
    parser.add_argument("--start", type=float, default=60.0, help="start and compiling [s]")
    parser.add_argument("--tasks", type=int, default=1500)
    arguments = parser.parse_args()
    rows = json.loads(Path(arguments.results).read_text())["tasks"]
    measured = np.array([row["wall_s"] for row in rows])
    times = np.random.default_rng(0).choice(measured, arguments.tasks)
    print(f"{len(measured)} tasks measured, {measured.mean():.1f} s in the mean")
    for cores in CORES:
        seconds = makespan(times, cores, arguments.start)
        busy = times.sum() / (seconds * cores)
        print(
            f"{cores:4d} cores {seconds / 60:7.1f} min  {100 * busy:3.0f} % of their time on tasks"
        )


if __name__ == "__main__":
    main()
