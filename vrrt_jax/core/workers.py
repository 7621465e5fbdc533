"""A function on many items, in several processes that each have cores of their own."""

import concurrent.futures
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from vrrt_jax.core.command import end_with_parent
from vrrt_jax.core.interrupt import of_parent_alone

_function: list[Callable[[Any], Any]] = []  # of a worker process


def in_processes(function: Callable[[Any], Any], items: Sequence[Any], jobs: int) -> Iterator[Any]:
    """What the function returns for the items; with one job in their order, otherwise as they come.

    Args:
        function: it is sent to each worker process once, so that it may hold what is large.
        items: each is sent to a worker.
        jobs: worker processes; with one, all is done in this process.
    """
    if jobs == 1:
        yield from map(function, items)
        return
    context = multiprocessing.get_context("spawn")
    cores = context.Queue()
    available = sorted(os.sched_getaffinity(0))
    for worker in range(jobs):
        cores.put(available[worker % len(available) :: jobs] or available)
    settings = (function, cores, jax.config.jax_compilation_cache_dir)
    pool = concurrent.futures.ProcessPoolExecutor(jobs, context, _begin, settings)
    try:
        with of_parent_alone():
            pending = [pool.submit(_call, item) for item in items]
        for finished in concurrent.futures.as_completed(pending):
            yield finished.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _begin(function: Callable[[Any], Any], cores: Any, cache: str | None) -> None:
    """Give a worker cores of its own, or several would fight for all; and the parent's programs."""
    end_with_parent()
    os.sched_setaffinity(0, cores.get())
    jax.config.update("jax_compilation_cache_dir", cache)
    _function.append(function)


def _call(item: Any) -> Any:
    return _function[0](item)
