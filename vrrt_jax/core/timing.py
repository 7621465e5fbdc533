"""Timing on a machine that others use too, and what a report tells of that machine."""

import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from vrrt_jax.core.command import usable_cores


def best_ms(function: Callable, *args: Any, repeats: int = 30) -> tuple[float, float]:
    """Smallest time of a call after the first [ms], and the time of the first call [s].

    Machines are shared and noisy: the smallest of many is what the code itself costs.
    """
    started = time.perf_counter()
    jax.block_until_ready(function(*args))
    first_s = time.perf_counter() - started
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - started)
    return 1e3 * min(times), first_s


def timed(run: Callable[[], Any], *programs: Any) -> tuple[Any, float, float]:
    """The result of a run, and the seconds that compiling these jitted functions took, and it."""

    def clocked() -> tuple[Any, float]:
        started = time.perf_counter()
        result = jax.block_until_ready(run())
        return result, time.perf_counter() - started

    def compiled() -> int:
        return sum(program._cache_size() for program in programs)

    before = compiled()
    result, first_s = clocked()
    if compiled() == before:
        return result, 0.0, first_s
    result, run_s = clocked()
    return result, first_s - run_s, run_s


def interleaved_ms(functions: dict[str, Callable[[], Any]], repeats: int = 30) -> dict[str, float]:
    """Smallest times [ms] of several calls taken in turn, so that noise hits all alike."""
    for call in functions.values():
        jax.block_until_ready(call())
    best = dict.fromkeys(functions, float("inf"))
    for _ in range(repeats):
        for name, call in functions.items():
            started = time.perf_counter()
            jax.block_until_ready(call())
            best[name] = min(best[name], 1e3 * (time.perf_counter() - started))
    return best


def machine() -> dict[str, str | int]:
    """What a benchmark ran on, for its report."""
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "platform": platform.platform(),
        "device": str(jax.devices()[0]),
    }


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    names = ("vrrt-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "optax", "numpy")
    found = {name: metadata.version(name) for name in names}
    return {"python": platform.python_version(), **found}


def _processor() -> str:
    """The processor's name where Linux tells it."""
    table = Path("/proc/cpuinfo")
    lines = table.read_text().splitlines() if table.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
