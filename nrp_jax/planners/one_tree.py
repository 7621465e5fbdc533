"""Plans with one tree: what the exact check refuses is cut off the tree, and the rest grows on."""

import dataclasses
import itertools
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from nrp_jax.scene.world import GridWorld
from vrrt_jax.core import tree as trees
from vrrt_jax.core.goal import REACHED, ConfigurationGoal
from vrrt_jax.core.planners import RRT
from vrrt_jax.core.result import PlanResult, Status
from vrrt_jax.core.search import COST, SearchResult, Termination, search
from vrrt_jax.core.types import Tree


def plan_one_tree(
    world: GridWorld,
    goal: ConfigurationGoal,
    policy: RRT,
    tree: Tree[None],
    *,
    finish: Callable[[GridWorld, SearchResult, np.ndarray | None], PlanResult],
    accept: Callable[[np.ndarray], bool],
    key: jax.Array,
    termination: Termination,
    time_limit_s: float,
    **options: Any,
) -> PlanResult:
    """Search until a path is verified; a planner that shortens paths goes on until its budget ends.

    Edges are checked at sub-steps, so that a path may touch something in between. The edges of it
    that do are cut off, with all that hangs on them, and the rest of the tree grows on. Shorter
    paths keep closer to obstacles: checks are twice as fine from the first path on. Should the path
    at the end of the budget be refused, the first one stays.

    Args:
        world: the robot in a home.
        goal: where to.
        policy: a planner whose nodes have no payload.
        tree: from ``policy.init``.
        finish: shortens and verifies what a search in a world found, the path (P, D) of it.
        accept: the exact check of an edge (2, D).
        key: random key.
        termination: of all searches together.
        time_limit_s: wall time [s] of searches, and of what was done about paths that were refused,
            without compilation.
        options: of :func:`vrrt_jax.core.search.search`.

    Returns:
        The result; its ``timing`` is that of all searches, and its history tells of no path that
        was refused.
    """
    first = np.maximum(termination.score, np.float32(goal.threshold))
    to_first = dataclasses.replace(termination, score=first)
    spent: Any = Counter()
    refused, rows = 0, []

    def go_on(world: GridWorld, tree: Tree[None], until: Termination) -> PlanResult:
        """Search on from a tree, and what comes of it."""
        nonlocal refused
        begun_s = spent["search_s"]
        # The key of an iteration comes of its number, so that all searches may have the same one.
        left = {"termination": until, "time_limit_s": time_limit_s - begun_s}
        found = search(world, goal, policy, tree, key=key, **left, **options)
        rows.append(found.history + np.array([0.0, begun_s, 0.0, 0.0, 0.0, 0.0]))
        result = finish(world, found, policy.extract_path(found.tree))
        if result.status is Status.NOT_VERIFIED:
            rows[-1][:, COST] = np.inf
        spent.update(result.timing)
        refused += result.refused
        return result

    def is_budget_left(result: PlanResult) -> bool:
        most = int(termination.max_iterations)
        return spent["search_s"] < time_limit_s and result.iterations < most

    result = go_on(world, tree, to_first)
    while result.status is Status.NOT_VERIFIED and is_budget_left(result):
        started = time.perf_counter()
        tree = _without_refused(result.tree, accept)
        spent["search_s"] += time.perf_counter() - started
        for name in ("shortcut_s", "verify_s"):  # of a refused path: a part of the search
            spent["search_s"] += result.timing[name]
            spent[name] -= result.timing[name]
        result = go_on(world, tree, to_first)
    if result.ok and termination.score < to_first.score and is_budget_left(result):
        finer = dataclasses.replace(world, resolution=world.resolution / 2)
        last = go_on(finer, result.tree, termination)
        if last.ok:
            result = last
        else:
            rows[-1][:, COST] = rows[-2][-1, COST]
            numbers = ("tree", "iterations", "expansions", "rejected")
            result = dataclasses.replace(result, **{n: getattr(last, n) for n in numbers})
    return dataclasses.replace(
        result, timing=dict(spent), history=np.concatenate(rows), refused=refused
    )


def _without_refused(tree: Tree[None], accept: Callable[[np.ndarray], bool]) -> Tree[None]:
    """The tree without the edges of its best path that are refused, nor what hangs on them."""
    chain = trees.lineage(tree, int(trees.best_node(tree, REACHED)))
    q = np.asarray(tree.q)
    edges = itertools.pairwise(chain.tolist())
    cut = [child for node, child in edges if not accept(q[[node, child]])]
    return trees.without(tree, cut or chain[-1:].tolist())
