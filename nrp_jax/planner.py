"""Planning, from the outside: what users call, with every input checked on the host."""

import dataclasses
import enum
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.planners.nrp import RRT, NeuralRRT
from nrp_jax.samplers import check_fits, load_sampler
from nrp_jax.scene.exact import STEP, ExactScene, Verification, verify
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import enforce_bounds, unwrapped
from vrrt_jax.core.planners.rrt import tree_path
from vrrt_jax.core.planners.rrt_connect import RRTConnect, connection_path
from vrrt_jax.core.search import SearchResult, StopReason, interruptible, make_termination, search
from vrrt_jax.core.shortcut import padded, path_length, shortcut
from vrrt_jax.core.types import Rejection, Tree

METHODS = ("rrt", "rrt-is", "rrt-connect", "nrp-d", "nrp-g")
KINDS = {"nrp-d": "discriminator", "nrp-g": "cvae"}  # of the samplers that methods need
ARRIVED = 1e-4  # from the goal, which a node either is or is not
ATTEMPTS = 3  # each checks edges twice as finely as the one before, whose path touched something


class Status(enum.Enum):
    """How a plan ended, with what to try next."""

    SOLVED = "a path to the goal, checked with C MuJoCo"
    MAX_ITERATIONS = "the expansions ran out: raise max_expansions"
    TREE_FULL = "the tree is full: raise capacity"
    TIME_LIMIT = "the time limit passed: raise time_limit_s"
    INTERRUPTED = "interrupted"
    NOT_VERIFIED = "the path touches something between two checks: lower the world's resolution"


_UNSOLVED = {
    StopReason.REACHED: Status.MAX_ITERATIONS,
    StopReason.CONVERGED: Status.MAX_ITERATIONS,
    StopReason.ITERATIONS: Status.MAX_ITERATIONS,
    StopReason.TREE_FULL: Status.TREE_FULL,
    StopReason.TIME_LIMIT: Status.TIME_LIMIT,
    StopReason.INTERRUPTED: Status.INTERRUPTED,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanResult:
    """What became of a problem."""

    status: Status
    path: np.ndarray  # (P, D) waypoints joined by the world's edges; of a failure, the best try
    # (T, D) the same in steps of 0.02 m or rad at most; angles without limits may leave [-pi, pi)
    trajectory: np.ndarray
    raw_path: np.ndarray  # (P', D) as the tree has it
    cost: float  # length of ``path``: of the base's way, and a weight times that of the arm's [m]
    verification: Verification | None  # None if the goal was not reached
    expansions: int  # lanes tried, in all attempts
    rejected: Mapping[str, int]  # lanes lost, by reason
    timing: Mapping[str, float]  # compile_s, search_s, shortcut_s, verify_s
    # (chunks + 1, 4): iteration, seconds, distance to the goal (of rrt-connect: between its trees),
    # nodes
    history: np.ndarray
    tree: Tree

    @property
    def ok(self) -> bool:
        """Solved: the goal is reached on a verified path."""
        return self.status is Status.SOLVED

    def __str__(self) -> str:
        """One line for people."""
        times = ", ".join(f"{k.removesuffix('_s')} {v:.2f} s" for k, v in self.timing.items())
        return (
            f"{self.status.name}: cost {self.cost:.2f} m, {len(self.path)} waypoints, "
            f"{self.expansions} expansions, {int(self.tree.size)} nodes; {times}"
        )


def plan(
    robot: MobileRobot,
    grid: Grid,
    q_start: np.ndarray,
    q_goal: np.ndarray,
    *,
    key: jax.Array,
    method: str = "rrt-connect",
    sampler: Any = None,
    world: GridWorld | None = None,
    goal_bias: float = 0.3,
    straight_rate: float = 0.2,
    max_expansions: int = 32_000,
    capacity: int = 8192,
    lanes: int = 32,
    time_limit_s: float = 60.0,
    scene: ExactScene | None = None,
    on_progress: Callable[..., Any] | None = None,
) -> PlanResult:
    """Find a collision-free path between two configurations in a home.

    Should the path that was found touch something between two of the planner's checks, it plans
    again with checks twice as fine, up to twice, with what is left of the budgets.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: from :func:`nrp_jax.load_map` or a generator.
        q_start: (D,) configuration [m] and [rad].
        q_goal: (D,) configuration.
        key: random key; the same key gives the same plan on the same machine, unless time ends it.
        method: one of :data:`METHODS`.
        sampler: what proposes waypoints to "nrp-d" and "nrp-g": a pytree with ``propose(world,
            q_from, q_goal, key)``; the packaged weights by default.
        world: of this robot and grid, to save building it again.
        goal_bias: share of expansions that aim at the goal.
        straight_rate: share of expansions that go straight, for methods with a sampler.
        max_expansions: budget; one iteration of all lanes is the least.
        capacity: most nodes of the tree.
        lanes: expansions at a time; "rrt-connect" takes two at least.
        time_limit_s: wall time of the search [s].
        scene: the exact scene of this robot and grid, to save building it again.
        on_progress: called with the search state and the seconds so far.

    Raises:
        ValueError: an input makes no sense; the message says what to do.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method '{method}'; have: {', '.join(METHODS)}")
    if not (0 <= goal_bias <= 1 and 0 <= straight_rate <= 1):
        raise ValueError(
            f"goal_bias is {goal_bias}, straight_rate {straight_rate}; expected shares in [0, 1]"
        )
    if lanes < 1 or max_expansions < 1:
        raise ValueError(
            f"lanes is {lanes}, max_expansions {max_expansions}; expected 1 or more of both"
        )
    lanes = max(lanes, 2) if method == "rrt-connect" else lanes
    if capacity < lanes + 2:
        raise ValueError(
            f"capacity is {capacity}; expected at least {lanes + 2}, two more than the lanes: "
            "raise it or lower lanes"
        )
    world = build_world(robot, grid) if world is None else world
    start = check_configuration(robot, world, q_start, "start")
    goal = check_configuration(robot, world, q_goal, "goal")
    if method in KINDS:
        sampler = load_sampler(robot.name, KINDS[method]) if sampler is None else sampler
        check_fits(sampler, robot, world, KINDS[method])
    make = {"goal_bias": goal_bias, "straight_rate": straight_rate, "lanes": lanes}
    policy, tree = _setup(world, start, goal, method, sampler, make, capacity)
    scene = scene or ExactScene(robot, grid)
    tried, spent, rejected = 0, Counter(), Counter()
    results: list[PlanResult] = []
    with interruptible() as interrupted:
        for attempt in range(ATTEMPTS):
            left_s = time_limit_s - spent["search_s"]
            if attempt and (max_expansions - tried < lanes or left_s <= 0):
                break
            iterations = max((max_expansions - tried) // lanes, 1)
            found = search(
                world,
                policy,
                tree,
                key=jax.random.fold_in(key, attempt),
                stop=make_termination(ARRIVED, max_iterations=iterations),
                time_limit_s=left_s,
                on_progress=on_progress,
            )
            raw = connection_path(found.tree) if method == "rrt-connect" else tree_path(found.tree)
            reached = raw is not None and found.stopped is StopReason.REACHED
            raw = np.asarray(start)[None] if raw is None else raw
            results.append(_finish(scene, world, found, raw, reached, key, lanes))
            tried += results[-1].expansions
            spent.update(results[-1].timing)
            rejected.update(results[-1].rejected)
            if results[-1].status is not Status.NOT_VERIFIED or interrupted.is_set():
                break
            world = dataclasses.replace(world, resolution=world.resolution / 2)
    # A path that was refused tells more than a search that found none.
    result = next((r for r in reversed(results) if r.verification is not None), results[-1])
    return dataclasses.replace(
        result, timing=dict(spent), expansions=tried, rejected=dict(rejected)
    )


def check_configuration(
    robot: MobileRobot, world: GridWorld, q: np.ndarray, what: str
) -> jax.Array:
    """A configuration (D,) for the device.

    Raises:
        ValueError: wrong shape, not finite, outside the limits or not free.
    """
    q = np.asarray(q, np.float32)
    names = ", ".join(robot.joint_names)
    if q.shape != (robot.num_joints,):
        raise ValueError(f"the {what} has shape {q.shape}; expected ({robot.num_joints},): {names}")
    lower, upper, is_continuous = (
        np.asarray(a) for a in (world.lower, world.upper, world.is_continuous)
    )
    bad = ~np.isfinite(q) | (((q < lower - 1e-4) | (q > upper + 1e-4)) & ~is_continuous)
    if bad.any():
        joint = int(np.flatnonzero(bad)[0])
        place = "the map spans" if joint < 2 else "its limits are"
        raise ValueError(
            f"the {what}'s {robot.joint_names[joint]} is {q[joint]}; {place} "
            f"[{lower[joint]:.3f}, {upper[joint]:.3f}]"
        )
    inside = enforce_bounds(world, jnp.asarray(q))
    if not batch_is_free(world, inside[None])[0]:
        raise ValueError(
            f"the {what} touches the map, the floor or the robot itself: {np.round(q, 3).tolist()};"
            " choose another one"
        )
    return inside


def trajectory_of(world: GridWorld, path: np.ndarray) -> np.ndarray:
    """A path (P, D) in steps (T, D) of 0.02 m or rad at most; angles go on where they wrap."""
    if len(path) < 2:
        return np.asarray(path)
    spans = np.asarray(_spans(world, padded(path)))[: len(path) - 1]
    counts = np.maximum(np.ceil(spans / STEP), 1).astype(int)
    index = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    fraction = (within / counts[index]).astype(np.float32)
    room = 1 << int(len(index) - 1).bit_length()  # few sizes, so few compilations
    padding = (0, room - len(index))
    q_a, q_b = (np.pad(path[index + k], [padding, (0, 0)], mode="edge") for k in (0, 1))
    points = _interpolate(world, q_a, q_b, np.pad(fraction, padding))
    return unwrapped(world, np.concatenate([path[:1], np.asarray(points)[: len(index)]]))


@jax.jit
def _spans(world: GridWorld, path: jax.Array) -> jax.Array:
    return world.span(world.edge(path[:-1], path[1:]))


@jax.jit
def _interpolate(world: GridWorld, q_a, q_b, fraction) -> jax.Array:
    return world.interpolate(q_a, q_b, fraction)


def _setup(
    world: GridWorld,
    start: jax.Array,
    goal: jax.Array,
    method: str,
    sampler: Any,
    make: dict[str, Any],
    capacity: int,
) -> tuple[Any, Tree]:
    """The policy of a method, and the tree it starts from."""
    if method == "rrt-connect":
        policy = RRTConnect(lanes=make["lanes"])
        return policy, policy.forest(start, goal, capacity)
    common = {
        "goal": goal,
        "goal_bias": jnp.float32(make["goal_bias"]),
        "lanes": make["lanes"],
    }
    if method in ("rrt", "rrt-is"):
        policy = RRT(**common, intermediate=method == "rrt-is")
    else:
        rate = jnp.float32(make["straight_rate"])
        policy = NeuralRRT(**common, sampler=sampler, straight_rate=rate)
    score, payload = policy.root(world, start)
    return policy, trees.create(start[None], score[None], payload, capacity)


def _finish(
    scene: ExactScene,
    world: GridWorld,
    found: SearchResult,
    raw: np.ndarray,
    reached: bool,
    key: jax.Array,
    lanes: int,
) -> PlanResult:
    """Shorten and verify what a search found."""
    clock = [time.perf_counter()]
    path, verification = raw, None
    finer = dataclasses.replace(world, resolution=world.resolution / 2)
    if reached:
        shortcut(finer, raw, key=key, rounds=0)  # compiles, if anything has to
    clock.append(time.perf_counter())
    if reached:
        path = shortcut(finer, raw, key=key)
    clock.append(time.perf_counter())
    trajectory = trajectory_of(world, path)
    limits = {"lower": np.asarray(world.lower), "upper": np.asarray(world.upper)}
    if reached:
        verification = verify(scene, trajectory, **limits)
        if not verification.ok:
            longer = trajectory_of(world, raw)
            seen = verify(scene, longer, **limits)
            if seen.ok:
                path, trajectory, verification = raw, longer, seen
    clock.append(time.perf_counter())
    if verification is not None:
        status = Status.SOLVED if verification.ok else Status.NOT_VERIFIED
    else:
        status = _UNSOLVED[found.stopped]
    rejected = np.asarray(found.tree.rejected)
    return PlanResult(
        status=status,
        path=path,
        trajectory=trajectory,
        raw_path=raw,
        cost=path_length(world, path) if len(path) > 1 else 0.0,
        verification=verification,
        expansions=int(found.tree.iteration) * lanes,
        rejected={reason.name.lower(): int(rejected[reason]) for reason in Rejection},
        timing={
            "compile_s": found.compile_s + clock[1] - clock[0],
            "search_s": found.search_s,
            "shortcut_s": clock[2] - clock[1],
            "verify_s": clock[3] - clock[2],
        },
        history=found.history,
        tree=found.tree,
    )
