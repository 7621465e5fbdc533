"""The batched expansion kernel that every planner runs on.

What flows through it is in :mod:`~vrrt_jax.core.types` and :mod:`~vrrt_jax.core.goal`; an iteration
is :func:`~vrrt_jax.core.expand.expand`, on a :mod:`~vrrt_jax.core.tree`, along
:mod:`~vrrt_jax.core.edges`; :func:`~vrrt_jax.core.search.search` is the loop around it. A raw path
becomes a verified one in :mod:`~vrrt_jax.core.postprocess`, and what becomes of a plan is a
:class:`~vrrt_jax.core.result.PlanResult`. Planners are in :mod:`vrrt_jax.core.planners`.
"""
