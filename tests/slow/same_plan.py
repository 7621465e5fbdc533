"""The same seed gives the same plan, bit by bit, whatever else the machine does.

Run ``python -m tests.slow.same_plan``. Each plan is made in fresh processes: again and again, with
one core and with all, beside a load, four at once on one cache of compiled programs, and on several
threads of one process.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
LOAD = "while True: sum(i * i for i in range(10**6))"


def _arm(engine: str) -> Callable[[], object]:
    import jax

    import vrrt_jax

    problem = vrrt_jax.load_problem("panda_posts", engine=engine)
    return lambda: vrrt_jax.plan_to_configuration(
        problem.robot, problem.world, problem.q_start, problem.true_goal, key=jax.random.key(5)
    )


def _visual() -> Callable[[], object]:
    import jax

    import vrrt_jax

    problem = vrrt_jax.load_problem("panda_open")
    parts = problem.robot, problem.world, problem.goal, problem.q_start
    return lambda: vrrt_jax.plan(*parts, key=jax.random.key(5))


def _home(name: str, method: str, **settings: object) -> Callable[[], object]:
    import jax

    import nrp_jax
    from nrp_jax.problems import load_problem

    p = load_problem(name)
    world = nrp_jax.build_world(p.robot, p.grid)
    return lambda: nrp_jax.plan(
        p.robot, p.grid, p.q_start, p.q_goal, key=jax.random.key(5), method=method, world=world,
        **settings,
    )  # fmt: skip


# Planners that improve their path end with the iterations that they are given, not with the clock.
_ITERATIONS = {"max_expansions": 1600, "time_limit_s": 1e6}
CASES: dict[str, Callable[[], Callable[[], object]]] = {
    "arm, closed_form": lambda: _arm("closed_form"),
    "arm, mjx": lambda: _arm("mjx"),
    "visual": _visual,
    "snake, nrp-connect": lambda: _home("home_1", "nrp-connect"),
    "snake, nrp-d": lambda: _home("home_1", "nrp-d"),
    "snake, bit-star, 1600 expansions": lambda: _home("home_1", "bit-star", **_ITERATIONS),
    "snake, nrp-star-connect, 1600 expansions": lambda: _home(
        "home_1", "nrp-star-connect", **_ITERATIONS
    ),
    "fetch, nrp-connect": lambda: _home("home_fetch", "nrp-connect"),
}


def digest(result: object) -> str:
    """Of all that a plan tells but times."""
    arrays = [result.path, result.raw_path, result.trajectory, result.tree.q, result.tree.cost]
    text = b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)
    return f"{result.status.name} {hashlib.sha256(text).hexdigest()[:16]}"


def process(case: str, cores: list[int], cache: str, threads: int = 1) -> subprocess.Popen:
    """Plan in a fresh process on these cores, on several of its threads at once."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.slow.same_plan", "--case", case, "--threads", str(threads)],
        cwd=ROOT,
        env=os.environ
        | {
            "PYTHONPATH": str(ROOT),
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "CORES": json.dumps(cores),
        },
        stdout=subprocess.PIPE,
        text=True,
    )


def told(run: subprocess.Popen) -> list[str]:
    """What a process has planned."""
    out, _ = run.communicate(timeout=900)
    assert run.returncode == 0, f"it ended with {run.returncode}"
    return json.loads(out.splitlines()[-1])


def compare(case: str, cache: str, times: int) -> tuple[bool, str]:
    """All ways of making one plan; whether all came out alike, and words."""
    every = sorted(os.sched_getaffinity(0))
    found: dict[str, list[str]] = {"": []}
    for _ in range(times):
        found[""] += told(process(case, every, cache))
    found["one core"] = told(process(case, every[:1], cache))
    load = [subprocess.Popen([sys.executable, "-c", LOAD]) for _ in every]
    try:
        found["beside a load"] = told(process(case, every, cache))
    finally:
        for busy in load:
            busy.kill()
    # Nothing is compiled yet in a new cache, which four processes fill at once.
    with tempfile.TemporaryDirectory() as empty:
        runs = [process(case, every, empty) for _ in range(4)]
        found["four at once"] = [plan for run in runs for plan in told(run)]
    found["four threads"] = told(process(case, every, cache, threads=4))
    plans = [plan for group in found.values() for plan in group]
    same = len(set(plans)) == 1
    return same, f"{len(plans)} plans, " + (f"all {plans[0]}" if same else json.dumps(found))


def main() -> int:
    """Compare all; ends with 1 if any plan came out otherwise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose names hold this")
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--case", help="plan this one here, and print what came out")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.case:
        os.sched_setaffinity(0, json.loads(os.environ["CORES"]))
        plan = CASES[arguments.case]()
        with ThreadPoolExecutor(arguments.threads) as pool:
            found = [pool.submit(plan) for _ in range(arguments.threads)]
            print(json.dumps([digest(one.result()) for one in found]))
        return 0
    failed = 0
    with tempfile.TemporaryDirectory() as cache:
        for case in (case for case in CASES if arguments.only in case):
            began = time.monotonic()
            same, words = compare(case, cache, arguments.times)
            failed += not same
            print(f"{case} ({time.monotonic() - began:.0f} s): {words}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
