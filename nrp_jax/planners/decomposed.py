"""The decomposed planner: bring the arm to rest, drive, and stretch the arm out again.

The baseline of the Neural Randomized Planner's paper (Lu et al. 2024, section VII) that does not
plan for the whole body: Informed RRT* brings the arm to its pose of rest, Hybrid A* drives the
base, and Informed RRT* brings the arm to the goal. Each leg moves what the others keep still.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.planners.hybrid_astar import drive
from nrp_jax.planners.shorten import shorten
from nrp_jax.scene.car_world import CarWorld
from nrp_jax.scene.grid_world import GridWorld
from nrp_jax.scene.world import batch_is_free
from vrrt_jax.core.edges import Space
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.informed_rrt_star import InformedRRTStar
from vrrt_jax.core.search import COST, SearchResult, StopReason, Termination, no_search, search
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.core.types import Tree

# Torso [m] and arm [rad] at rest: all of the robot is within 0.3 m of the middle of its base.
REST = np.array([0.02, 1.1708, 1.4708, -0.4, 1.6708, 0.0, 1.5708, 0.0], np.float32)
BASE = 3  # joints of the base
TURN_S = 0.25  # the searches of the two arm legs take turns of so many seconds
ARM_LEGS = ("to its rest pose at the start", "from its rest pose to the goal")
ELSEWHERE = "take a planner of the whole body, such as nrp-star-connect"


@dataclasses.dataclass(frozen=True, kw_only=True)
class _ArmLeg:
    """A leg that moves the arm, and its search so far."""

    world: GridWorld  # with the base where it is
    goal: ConfigurationGoal
    found: SearchResult


def search_decomposed(
    world: CarWorld,
    goal: ConfigurationGoal,
    policy: InformedRRTStar,
    tree: Tree,
    *,
    grid: Grid,
    key: jax.Array,
    termination: Termination,
    time_limit_s: float,
    **options: Any,
) -> tuple[SearchResult, np.ndarray | None]:
    """Plan the three legs: first the base's, then the arm's two in turns, half the rest each.

    Args:
        world: the Fetch in a home.
        goal: where to.
        policy: of the two legs of the arm.
        tree: from ``policy.init``, of the start.
        grid: the home, where the world has it.
        key: random key.
        termination: of both arm legs together.
        time_limit_s: wall time of the three legs without compilation [s].
        options: of :func:`vrrt_jax.core.search.search`.

    Returns:
        What was found, and the path (P, D); None if a leg failed, which ``advice`` names. The
        history has the length of all three legs from when there is one of each. The tree is that
        of the first leg.
    """
    start, end = np.asarray(tree.q[0]), np.asarray(goal.q, np.float32)
    rest_start, rest_end = (np.append(q[:BASE], REST).astype(np.float32) for q in (start, end))
    nothing = no_search(policy, goal, tree)
    is_free = np.asarray(batch_is_free(world, jnp.asarray([rest_start, rest_end])))
    for place, free in zip(("start", "goal"), is_free, strict=True):
        if not free:
            advice = f"the arm cannot rest at the {place}, where its rest pose touches something"
            return dataclasses.replace(nothing, advice=f"{advice}: {ELSEWHERE}"), None
    way = drive(world, grid, rest_start, rest_end, time_limit_s=time_limit_s)
    if way.path is None:
        stopped = StopReason.REACHED if way.is_over else StopReason.TIME_LIMIT
        advice = "no way was found for the base with its arm at rest"
        advice += f": {ELSEWHERE if way.is_over else 'raise time_limit_s'}"
        taken = {"compile_s": way.compile_s, "search_s": way.search_s}
        return dataclasses.replace(nothing, stopped=stopped, advice=advice, **taken), None
    base_row = np.array([0, way.search_s, -np.inf, 0, path_length(world, way.path), way.checked])
    legs = [
        _arm_leg(world, policy, q_from, q_to, tree.capacity)
        for q_from, q_to in ((start, rest_start), (rest_end, end))
    ]
    half = dataclasses.replace(
        termination, max_iterations=np.int32(max(int(termination.max_iterations) // 2, 1))
    )
    latest = [leg.found.history[-1] for leg in legs]
    history = [_sum_of(base_row, *latest, seconds=way.search_s)]
    seconds, compile_s, alive = way.search_s, way.compile_s, [0, 1]
    while alive and seconds < time_limit_s:
        # What one leg of the arm lacks keeps all three from being a path: it goes first, and no
        # farther than to a path.
        lack = [index for index in alive if not np.isfinite(latest[index][COST])]
        for index in lack or [*alive]:
            leg = legs[index]
            enough = leg.goal.threshold if lack else half.score
            found = search(
                leg.world,
                leg.goal,
                policy,
                leg.found.tree,
                key=jax.random.fold_in(key, index),
                termination=dataclasses.replace(half, score=np.float32(enough)),
                time_limit_s=min(TURN_S, time_limit_s - seconds),
                **options,
            )
            for row in found.history[1:]:  # meanwhile the other leg waits
                latest[index] = row
                history.append(_sum_of(base_row, *latest, seconds=seconds + row[1]))
            legs[index] = dataclasses.replace(leg, found=found)
            seconds, compile_s = seconds + found.search_s, compile_s + found.compile_s
            has_first = bool(lack) and found.stopped is StopReason.REACHED
            if found.stopped is not StopReason.TIME_LIMIT and not has_first:
                alive.remove(index)
            if found.stopped is StopReason.INTERRUPTED:
                alive = []
                break
    stops = [leg.found.stopped for leg in legs]  # in turns, time is up again and again
    found = dataclasses.replace(
        legs[0].found,
        stopped=StopReason.TIME_LIMIT if alive else max(stops),
        history=np.array(history),
        compile_s=compile_s,
        search_s=seconds,
        tree=dataclasses.replace(legs[0].found.tree, iteration=np.int32(history[-1][0])),
    )
    missing = [
        name for name, row in zip(ARM_LEGS, latest, strict=True) if not np.isfinite(row[COST])
    ]
    if missing:
        advice = f"no path was found for the arm {' and '.join(missing)}: raise time_limit_s"
        return dataclasses.replace(found, advice=advice), None
    tuck, stretch = (np.asarray(policy.extract_path(leg.found.tree)) for leg in legs)
    return found, np.concatenate([tuck[:-1], way.path, stretch[1:]])


def _arm_leg(
    world: CarWorld, policy: InformedRRTStar, q_from: np.ndarray, q_to: np.ndarray, capacity: int
) -> _ArmLeg:
    """A leg between two configurations (D,) with the base in one place."""
    fixed: GridWorld = world
    # A base that stays needs no curves; a world of one's own is asked as it is.
    if type(world) is CarWorld:
        fields = dataclasses.fields(GridWorld)
        fixed = GridWorld(**{field.name: getattr(world, field.name) for field in fields})
    base = jnp.asarray(q_from[:BASE])
    fixed = dataclasses.replace(
        fixed,
        lower=world.lower.at[:BASE].set(base),
        upper=world.upper.at[:BASE].set(base),
        is_continuous=world.is_continuous.at[:BASE].set(False),
    )
    goal = ConfigurationGoal(q=jnp.asarray(q_to))
    tree = policy.init(fixed, goal, q_from[None], capacity)
    return _ArmLeg(world=fixed, goal=goal, found=no_search(policy, goal, tree))


def _sum_of(base: np.ndarray, *arms: np.ndarray, seconds: float) -> np.ndarray:
    """A row (6,) of the history of all legs, of their own latest rows."""
    row = np.sum([base, *arms], axis=0)
    row[1], row[2] = seconds, max(arm[2] for arm in arms)
    return row


def shortcut_legs(world: Space, path: np.ndarray, *, key: jax.Array, **options: Any) -> np.ndarray:
    """Shorten each leg of a decomposed path (P, D) by itself, see :func:`shorten`.

    The base's leg goes from the first to the last waypoint at which the arm rests.
    """
    at_rest = np.flatnonzero(np.all(path[:, BASE:] == REST, axis=1))
    first, last = (int(at_rest[0]), int(at_rest[-1])) if len(at_rest) else (0, 0)
    parts = path[: first + 1], path[first : last + 1], path[last:]
    short = [
        shorten(world, part, key=jax.random.fold_in(key, leg), **options)
        for leg, part in enumerate(parts)
    ]
    return np.concatenate([short[0], short[1][1:], short[2][1:]])
