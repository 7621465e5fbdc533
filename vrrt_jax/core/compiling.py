"""``jax.jit`` for programs that the host calls: they compile in about half of the time."""

import functools

import jax

# On two cores (jaxlib 0.10) the first visual plan took 43 s by default and 28 s so, and the
# second plan 3.9 s and 3.5 s. At level 0 of LLVM's optimizer programs run five times as slow. The
# emitters of fusions also recompute long chains, see ``vrrt bench kinematics``.
QUICK_TO_COMPILE = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}

# Not for what someone may call inside of a ``jax.jit`` of their own: JAX refuses options there.
host_jit = functools.partial(jax.jit, compiler_options=QUICK_TO_COMPILE)
