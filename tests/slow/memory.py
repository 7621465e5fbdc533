"""Many joint plans in one process: its memory does not grow.

Run ``python -m tests.slow.memory --plans 1000``.
"""

import argparse
import gc
import resource
import time
from pathlib import Path

import jax
import numpy as np

import vrrt_jax

FIRST = 50  # plans after which nothing new is compiled
GROWTH = 0.05


def resident_mib() -> float:
    """Memory of this process that is in use [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main() -> int:
    """Plan and print; ends with 1 if memory has grown by more than 5 % after the first plans."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=1000)
    parser.add_argument("--engine", default="closed_form")
    arguments = parser.parse_args()
    problem = vrrt_jax.load_problem("panda_posts", engine=arguments.engine)
    robot, rng, solved, began = problem.robot, np.random.default_rng(0), 0, time.monotonic()
    first = 0.0
    for count in range(1, arguments.plans + 1):
        # Other goals near the true one, so that paths and trees differ.
        goal = np.asarray(problem.true_goal) + rng.uniform(-0.02, 0.02, robot.num_joints)
        try:
            result = vrrt_jax.plan_to_configuration(
                robot, problem.world, problem.q_start, goal, key=jax.random.key(count)
            )
        except ValueError:  # it touches something
            continue
        solved += result.ok
        del result
        if count == FIRST:
            gc.collect()
            first = resident_mib()
        if count % 50 == 0:
            print(
                f"{count} plans, {solved} solved, {time.monotonic() - began:.0f} s: "
                f"{resident_mib():.0f} MiB, {len(jax.live_arrays())} arrays",
                flush=True,
            )
    gc.collect()
    grown = resident_mib() / first - 1
    print(f"grown by {100 * grown:.1f} % after the first {FIRST}")
    return int(grown > GROWTH)


if __name__ == "__main__":
    raise SystemExit(main())
