"""A function on many items, on the machines of a Ray cluster (https://docs.ray.io).

Workers may come and go. Results come back to this process, which alone writes files: what a worker
had not finished when it died is done again by another, and nothing is counted twice.
"""

import fcntl
import itertools
import os
import socket
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from vrrt_jax.core.compiling import keep_programs
from vrrt_jax.core.timing import versions

LOCAL = "local"  # the address that stands for this machine alone, also for Ray
TRIES = 4  # of an item whose worker dies
SECONDS = 5.0  # between two looks whether machines have come [s]

_core: list[Any] = []  # of this worker: its lock


def on_cluster(function: Callable[[Any], Any], items: Sequence[Any], address: str) -> Iterator[Any]:
    """What the function returns for the items, as they come; each item has a core of its own.

    After a failure no item is sent; those that were sent are finished before it is raised.

    Args:
        function: it is sent to the cluster once.
        items: each is a task of the cluster.
        address: of the cluster, such as ``10.0.0.1:6379``, or "auto" on one of its machines; or
            "local" for the cores of this machine.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: there is no cluster at that address.
        ValueError: a machine of the cluster has other versions.
        RuntimeError: a task has ended its worker :data:`TRIES` times.
    """
    ray = _connected(address)
    try:
        shared, here = ray.put(function), versions()
        call = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_call)
        cache = jax.config.jax_compilation_cache_dir
        waiting, pending, failure = iter(items), [], None
        while True:
            # As many as there are cores now, and a few that wait for those that come.
            room = 0 if failure else 2 + int(ray.cluster_resources().get("CPU", 0)) - len(pending)
            more = itertools.islice(waiting, max(room, 0))
            pending += [call.remote(shared, item, here, cache) for item in more]
            if not pending:
                break
            finished, pending = ray.wait(pending, timeout=SECONDS)
            for one in finished:
                try:
                    result = _result(ray, one)
                except Exception as problem:
                    failure = failure or problem
                else:
                    yield result
        if failure:
            raise failure
    finally:
        ray.shutdown()


def _connected(address: str) -> Any:
    """Ray, connected to a cluster."""
    # Ray sends statistics of its use to its makers, unless it is told not to.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "--cluster needs Ray, which is not installed: pip install 'vrrt-jax[cluster]'"
        ) from None
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == LOCAL:
        ray.init(LOCAL, num_cpus=len(_cores()), include_dashboard=False, **quiet)
        return ray
    try:
        if address != "auto":
            _check_there(address)
        ray.init(address, **quiet)
    except OSError as error:
        raise ConnectionError(
            f"there is no Ray cluster at '{address}' ({' '.join(str(error).split())[:200]}); begin "
            "one with `ray start --head`, or take --cluster local"
        ) from None
    return ray


def _check_there(address: str) -> None:
    """Raise an OSError if nothing answers at host:port; Ray would wait for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConnectionError("expected an address such as 10.0.0.1:6379, auto or local")
    socket.create_connection((host, int(port)), timeout=10).close()


def _result(ray: Any, finished: Any) -> Any:
    try:
        return ray.get(finished)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError) as error:
        raise RuntimeError(
            f"a task has ended its worker {TRIES} times ({' '.join(str(error).split())[:200]}); "
            "are the cluster's machines short of memory? What was done is kept"
        ) from None


def _call(
    function: Callable[[Any], Any], item: Any, wanted: dict[str, str], cache: str | None
) -> Any:
    """On a worker: the result for an item."""
    if not _core:
        here = versions()
        other = [f"{k} {v} (here {wanted[k]})" for k, v in here.items() if v != wanted[k]]
        if other:
            raise ValueError(
                f"machine {os.uname().nodename} of the cluster has {', '.join(other)}: results of "
                "different versions are not mixed; install the same there"
            )
        jax.config.update("jax_enable_x64", False)
        keep_programs(cache)
        _core.append(_take_core())
    return function(item)


def _take_core() -> Any:
    """Keep this process on a core that no other worker of this machine has, if one is left.

    Several workers would fight for all cores otherwise. A lock on a file says who has which: it
    goes when its process does, however that ends.
    """
    for core in _cores():
        place = os.path.join(tempfile.gettempdir(), f"vrrt_core_{core}_{os.getuid()}.lock")
        file = open(place, "a")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        os.sched_setaffinity(0, {core})
        return file
    return None


def _cores() -> list[int]:
    return sorted(os.sched_getaffinity(0))
