"""Several runs of a program at once."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from vrrt_jax.core.command import usable_cores
from vrrt_jax.core.precision import single_precision


def map_on_threads(function: Callable, items: Iterable[Any]) -> list[Any]:
    """Results of a jitted function for every item, as NumPy arrays.

    On a CPU a program of ours runs on one core, and what is dispatched runs in turn. Threads that
    wait for their own results keep all cores busy.
    """
    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(pool.map(single_precision(lambda item: jax.device_get(function(item))), items))
