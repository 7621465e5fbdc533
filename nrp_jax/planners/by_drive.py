"""Search by drive: from both ends to a drive along the floor, by two short searches."""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.planners.drive import LENGTH, Folded, compile_drive, find_drive
from nrp_jax.planners.nrp_connect import NRPConnect, search_connect
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.rrt_connect import ConnectNode
from vrrt_jax.core.search import COST, SearchResult, StopReason, Termination, search
from vrrt_jax.core.shortcut import path_length, without_repeats
from vrrt_jax.core.tree import joined
from vrrt_jax.core.types import Tree

SUMS = [0, 1, 3, 5]  # columns that never fall: iterations, seconds, nodes, checks
MOST = 16  # iterations from an end to the drive
RANKS = (0, 3, 15, 63)  # of the postures that are tried one after the other


def search_by_drive(
    world: GridWorld,
    goal: ConfigurationGoal,
    policy: NRPConnect,
    tree: Tree[ConnectNode],
    *,
    folded: Folded | None,
    key: jax.Array,
    termination: Termination,
    time_limit_s: float,
    **options: Any,
) -> tuple[SearchResult, np.ndarray | None]:
    """Search by drive; where there is none, or an end does not reach it, by ``search_connect``.

    Args:
        world: the robot in a home.
        goal: where to, one configuration.
        policy: the planner.
        tree: from ``policy.init``.
        folded: from :func:`nrp_jax.planners.drive.folded_postures`; None to do without a drive.
        key: random key.
        termination: when to end.
        time_limit_s: wall time of all searches without compilation [s].
        options: of :func:`vrrt_jax.core.search.search`.

    Returns:
        All searches as one, with the trees that the path goes through, or that of the last search;
        and the path (P, D), None if there is none.
    """
    compile_s = 0.0 if folded is None else compile_drive(world)
    drive_s, found = 0.0, []

    def left(most: Any) -> dict[str, Any]:
        """What the next search may take, ``most`` iterations at most."""
        used = sum(int(one.tree.iteration) for one in found)
        most = np.int32(min(int(most), int(termination.max_iterations) - used))
        return {
            "key": jax.random.fold_in(key, len(found)) if found else key,
            "termination": dataclasses.replace(termination, max_iterations=most),
            "time_limit_s": time_limit_s - drive_s - sum(one.search_s for one in found),
            **options,
        }

    straight, ends = policy.straight(), np.stack([tree.q[0], goal.q])
    room = LENGTH + 2 + MOST * straight.lanes  # more than such a search can fill
    for rank in RANKS:
        started = time.perf_counter()
        drive = None if folded is None else find_drive(world, folded, *ends, rank=rank)
        drive_s += time.perf_counter() - started
        if drive is None:
            break
        towards, halves = ConfigurationGoal(q=jnp.asarray(drive)), []
        for end in ends:
            forest = straight.init(world, towards, end[None], room)
            found.append(search(world, towards, straight, forest, **left(MOST)))
            found[-1].history[:, COST] = np.inf  # half a path is none
            if found[-1].stopped is not StopReason.REACHED:
                break
            halves.append(straight.extract_path(found[-1].tree))
        if len(halves) == 2:
            path = _with_drive(world, drive, *halves)
            found[-1].history[-1, COST] = path_length(world, path)
            grown = joined([one.tree for one in found[-2:]], 0)
            return _as_one(found, grown, drive_s, compile_s), path
        if found[-1].stopped is not StopReason.ITERATIONS or _is_over(left(1)):
            return _as_one(found, found[-1].tree, drive_s, compile_s), None

    # No drive, or an end that does not come to it: as without one, with what is left.
    found.append(search_connect(world, goal, policy, tree, **left(termination.max_iterations)))
    grown = found[-1].tree
    return _as_one(found, grown, drive_s, compile_s), policy.extract_path(grown)


def _is_over(left: dict[str, Any]) -> bool:
    return int(left["termination"].max_iterations) < 1 or left["time_limit_s"] <= 0


def _with_drive(
    world: GridWorld, drive: np.ndarray, from_start: np.ndarray, from_goal: np.ndarray
) -> np.ndarray:
    """The path (P, D) of two halves (P', D), from both ends to the drive (K, D), and the drive."""
    first, last = (
        np.argmin(np.abs(drive - half[-1]).max(axis=1)) for half in (from_start, from_goal)
    )
    between = drive[first : last + 1] if first <= last else drive[last : first + 1][::-1]
    return without_repeats(world, np.concatenate([from_start, between, from_goal[::-1]]))


def _as_one(
    found: list[SearchResult], grown: Tree, drive_s: float, compile_s: float
) -> SearchResult:
    """Searches one after the other, with the tree that is kept; drives were found before them."""
    history, before = [], np.array([0.0, drive_s, 0.0, 0.0])
    for one in found:
        rows = np.array(one.history)
        rows[:, SUMS] += before
        before = rows[-1, SUMS]
        history.append(rows)
    counts = {
        name: sum(getattr(one.tree, name) for one in found)
        for name in ("iteration", "rejected", "checked")
    }
    return dataclasses.replace(
        found[-1],
        tree=dataclasses.replace(grown, **counts),
        history=np.concatenate(history),
        compile_s=compile_s + sum(one.compile_s for one in found),
        search_s=drive_s + sum(one.search_s for one in found),
    )
