"""A function on many items: here, in several processes, or on the machines of a cluster."""

import argparse
import concurrent.futures
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from vrrt_jax.core import command
from vrrt_jax.core.cluster import on_cluster
from vrrt_jax.core.command import end_with_parent
from vrrt_jax.core.compiling import keep_programs
from vrrt_jax.core.interrupt import of_parent_alone

_function: list[Callable[[Any], Any]] = []  # of a worker process


def in_workers(
    function: Callable[[Any], Any], items: Sequence[Any], jobs: int, cluster: str | None = None
) -> Iterator[Any]:
    """What the function returns for the items; with one job in their order, otherwise as they come.

    After a failure no item is begun; those under way are finished before it is raised.

    Args:
        function: it is sent to each worker process once, so that it may hold what is large.
        items: each is sent to a worker.
        jobs: worker processes; with one, all is done in this process.
        cluster: address of a Ray cluster that does the work instead, see :func:`on_cluster`.
    """
    if cluster is not None and items:
        yield from on_cluster(function, items, cluster)
        return
    if jobs == 1 or len(items) < 2:
        yield from map(function, items)
        return
    context = multiprocessing.get_context("spawn")
    cores = context.Queue()
    available = sorted(os.sched_getaffinity(0))
    for worker in range(jobs):
        cores.put(available[worker % len(available) :: jobs] or available)
    settings = (function, cores, jax.config.jax_compilation_cache_dir)
    pool = concurrent.futures.ProcessPoolExecutor(jobs, context, _begin, settings)
    failure = None
    try:
        with of_parent_alone():
            pending = [pool.submit(_call, item) for item in items]
        for finished in concurrent.futures.as_completed(pending):
            if finished.cancelled():
                continue
            if problem := finished.exception():
                failure = failure or problem
                for other in pending:
                    other.cancel()
            else:
                yield finished.result()
        if failure:
            raise failure
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def add_arguments(parser: argparse.ArgumentParser, jobs: int = 1) -> None:
    """Add ``--jobs`` and ``--cluster``."""
    parser.add_argument("--jobs", type=command.whole(1, 1024), default=jobs, help="processes")
    parser.add_argument(
        "--cluster", help="address of a Ray cluster to run on, or local; instead of --jobs"
    )


def _begin(function: Callable[[Any], Any], cores: Any, cache: str | None) -> None:
    """Give a worker cores of its own, or several would fight for all; and the parent's programs."""
    end_with_parent()
    os.sched_setaffinity(0, cores.get())
    keep_programs(cache)
    _function.append(function)


def _call(item: Any) -> Any:
    return _function[0](item)
