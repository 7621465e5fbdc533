"""Less waiting for XLA: programs that compile in half of the time, and two of them at a time."""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.precision import single_precision

# On two cores (jaxlib 0.10) the first visual plan took 43 s by default and 28 s so, and the
# second plan 3.9 s and 3.5 s. At level 0 of LLVM's optimizer programs run five times as slow. The
# emitters of fusions also recompute long chains, see ``vrrt bench kinematics``.
QUICK_TO_COMPILE = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}

# Not for what someone may call inside of a ``jax.jit`` of their own: JAX refuses options there.
host_jit = functools.partial(jax.jit, compiler_options=QUICK_TO_COMPILE)


def keep_programs(folder: str | None) -> None:
    """Keep compiled programs in a folder, small ones too; JAX's own setting if None."""
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


_seen: set[Any] = set()  # the kinds that compile_together has been called with


def compile_together(kind: Any, *warm_ups: Callable[[], Any]) -> None:
    """Compile programs at the same time, unless it was done before.

    Args:
        kind: a pytree; what has the same structure and shapes needs no new programs.
        warm_ups: each calls some of the programs, on a thread of its own.
    """
    leaves, structure = jax.tree.flatten(kind)
    shapes = structure, tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
    if shapes in _seen:
        return
    with ThreadPoolExecutor(len(warm_ups)) as pool:
        for done in [pool.submit(single_precision(warm_up)) for warm_up in warm_ups]:
            done.result()
    _seen.add(shapes)
