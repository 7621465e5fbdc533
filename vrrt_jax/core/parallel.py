"""Several runs of a program at once."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax


def on_cores(function: Callable, items: Iterable[Any]) -> list[Any]:
    """Results of a jitted function for every item, as NumPy arrays.

    On a CPU a program of ours runs on one core, and what is dispatched runs in turn. Threads that
    wait for their own results keep all cores busy.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # what this process may use; Linux knows
    cores = len(affinity(0)) if affinity else os.cpu_count()
    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(lambda item: jax.device_get(function(item)), items))
