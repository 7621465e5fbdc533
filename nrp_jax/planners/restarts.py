"""Restarts: after a first path, search anew and keep the shortest path until the budget ends."""

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from nrp_jax.planners.by_drive import search_by_drive
from nrp_jax.planners.drive import Folded
from nrp_jax.planners.nrp_connect import NRPConnect
from nrp_jax.planners.shorten import shorten, shorten_parts
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.search import COST, SearchResult, StopReason, Termination
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.core.types import Tree

MOST_REFINED = 2  # times that checks become twice as fine, while every path is refused


def search_with_restarts(
    world: GridWorld,
    goal: ConfigurationGoal,
    policy: NRPConnect,
    tree: Tree,
    *,
    folded: Folded | None = None,
    accept: Callable[[np.ndarray], bool] | None = None,
    measure: Callable[[np.ndarray], float] | None = None,
    key: jax.Array,
    termination: Termination,
    time_limit_s: float,
    **options: Any,
) -> tuple[SearchResult, np.ndarray | None]:
    """Search again and again with new trees, shorten every path, and keep the shortest.

    Args:
        world: the robot in a home.
        goal: where to.
        policy: the planner.
        tree: from ``policy.init``; every search begins with it.
        folded: postures of the first searches, which are by drive until a path is kept; None to do
            without.
        accept: whether a path (P, D) may be kept, such as the exact check; None to keep any. A path
            whose shortcuts are refused is shortened in parts. If that is refused too, later
            searches check twice as finely, at most :data:`MOST_REFINED` times.
        measure: what the path that is kept has least of, such as the time that it takes; None for
            its length. With it, every second search is by drive.
        key: random key.
        termination: of all searches together; they go on after the goal is reached.
        time_limit_s: wall time of searches and shortcuts without compilation [s].
        options: of :func:`vrrt_jax.core.search.search`.

    Returns:
        What was found, with the tree of the shortest path, and that path (P, D); None if no search
        found one. The history has the length of the path that is kept, with its shortcuts.
    """
    finer = dataclasses.replace(world, resolution=world.resolution / 2)
    best, path, cost, least, refined = None, None, np.inf, np.inf, 0
    iterations, nodes, seconds, compile_s = 0, 0, 0.0, 0.0
    history = np.zeros((0, 6))
    for attempt in itertools.count():
        left = np.int32(int(termination.max_iterations) - iterations)
        found, raw = search_by_drive(
            world,
            goal,
            policy,
            tree,
            folded=folded if path is None or (measure and attempt % 2) else None,
            key=jax.random.fold_in(key, attempt),
            termination=dataclasses.replace(termination, max_iterations=left),
            time_limit_s=time_limit_s - seconds,
            **options,
        )
        # The rows of this search, after those before; they tell of paths before their shortcuts.
        rows = np.array(found.history)
        rows[:, [0, 1, 3]] += [iterations, seconds, nodes]
        rows[:, 5] += history[-1, 5] if len(history) else 0.0
        rows[:, COST] = np.minimum(rows[:, COST], cost)
        iterations, seconds = iterations + int(found.tree.iteration), seconds + found.search_s
        nodes, compile_s = nodes + int(found.tree.size), compile_s + found.compile_s
        if raw is not None:
            own, begun = jax.random.fold_in(key, attempt), time.perf_counter()
            path_length(finer, shorten(finer, raw, key=own, rounds=0))  # compiles, if need be
            for ask in (accept, measure) if attempt == 0 else ():
                if ask is not None:
                    ask(raw[:2])  # likewise
            started = time.perf_counter()
            compile_s += started - begun
            short = shorten(finer, raw, key=own)
            if measure or path_length(finer, short) < cost:  # else nothing of it is shorter either
                if accept is not None and not accept(short):
                    short = shorten_parts(finer, raw, accept, key=own)
            if short is not None:
                length = path_length(finer, short)
                amount = measure(short) if measure else length
                if amount < least:
                    best, path, cost, least = found, short, length, amount
            if path is None and refined < MOST_REFINED:
                world = dataclasses.replace(world, resolution=world.resolution / 2)
                refined += 1
            seconds += time.perf_counter() - started
            rows[:, COST] = np.maximum(rows[:, COST], cost)  # what was refused is no path
            rows = np.vstack([rows, [iterations, seconds, *rows[-1, 2:4], cost, rows[-1, 5]]])
        history = np.vstack([history, rows])
        over = seconds >= time_limit_s or iterations >= int(termination.max_iterations)
        if found.stopped is not StopReason.REACHED or over:
            break
    kept = found if best is None else best
    return dataclasses.replace(
        kept,
        tree=dataclasses.replace(kept.tree, iteration=np.int32(iterations)),
        history=history,
        search_s=seconds,
        compile_s=compile_s,
    ), path
