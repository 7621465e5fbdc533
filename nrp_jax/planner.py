"""Planning, from the outside: what users call, with every input checked on the host."""

import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.config import EDGE_STEPS, PlannerConfig
from nrp_jax.homes.grid import Grid
from nrp_jax.planners.nrp import NeuralRRT
from nrp_jax.samplers import check_fits, load_sampler
from nrp_jax.scene.exact import STEP, ExactScene, verify
from nrp_jax.scene.nearest import advice, refusal, shifted, working_world
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world
from vrrt_jax.core.check_protocols import check_extracted_path, check_policy
from vrrt_jax.core.edges import nearest_turn, unwrapped
from vrrt_jax.core.goal import ConfigurationGoal, starts_at
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.planners import RRT, RRTConnect
from vrrt_jax.core.postprocess import CheckedPath, plan_result, postprocess, unchecked
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import STATUS_OF, PlanResult, Status
from vrrt_jax.core.search import SearchResult, make_termination, no_search, search
from vrrt_jax.core.settings import check_settings
from vrrt_jax.core.shortcut import padded
from vrrt_jax.core.types import ExpansionPolicy

PLANNERS = ("rrt", "rrt-is", "rrt-connect", "nrp-d", "nrp-g")
KINDS = {"nrp-d": "discriminator", "nrp-g": "cvae"}  # of the samplers that planners need
ATTEMPTS = 3  # each checks edges twice as finely as the one before, whose path touched something
MOST_TURNS = 100  # beyond so many turns float32 is too coarse for angles
ADVICE = {
    Status.SOLVED: "",
    Status.NO_MATCH: "raise max_expansions",
    Status.NO_PATH: "raise max_expansions",
    Status.MAX_ITERATIONS: "raise max_expansions",
    Status.TREE_FULL: "raise max_capacity",
    Status.TIME_LIMIT: "raise time_limit_s",
    Status.INTERRUPTED: "run it again",
    Status.NOT_VERIFIED: "lower the world's resolution",
}


@single_precision
def plan(
    robot: MobileRobot,
    grid: Grid,
    q_start: np.ndarray,
    q_goal: np.ndarray | ConfigurationGoal,
    *,
    key: jax.Array,
    planner: str | ExpansionPolicy = "rrt-connect",
    method: str | None = None,
    sampler: Any = None,
    world: GridWorld | None = None,
    scene: ExactScene | None = None,
    config: PlannerConfig | None = None,
    on_progress: Callable[..., Any] | None = None,
    **settings: Any,
) -> PlanResult:
    """Find a collision-free path between two configurations in a home.

    Should the path that was found touch something between two of the planner's checks, it plans
    again with checks twice as fine, up to twice, with what is left of the budgets.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: from :func:`nrp_jax.load_map` or a generator.
        q_start: (D,) configuration [m] and [rad].
        q_goal: (D,) configuration, or a goal that holds one.
        key: random key; the same key gives the same plan on the same machine, unless time ends it.
        planner: one of :data:`PLANNERS`, or a policy of the kernel, see
            :class:`~vrrt_jax.core.types.ExpansionPolicy`.
        method: another word for ``planner``.
        sampler: what proposes waypoints to "nrp-d" and "nrp-g": a pytree with ``propose(world,
            q_from, q_goal, key)``; the packaged weights by default.
        world: of this robot and grid, to save building it again; its ``is_free`` is obeyed.
        scene: the exact scene of this robot and grid, to save building it again.
        config: settings, the default ones if None.
        on_progress: called with the search state and the seconds so far.
        settings: fields of :class:`~nrp_jax.config.PlannerConfig` to change, such as
            ``max_expansions=3200``.

    Raises:
        ValueError: an input makes no sense; the message says what to do.
    """
    config = _config(config, settings)
    planner = _planner(planner, method)
    world = build_world(robot, grid) if world is None else world
    start = check_configuration(robot, world, q_start, "start")
    goal = q_goal if isinstance(q_goal, ConfigurationGoal) else ConfigurationGoal(q=q_goal)
    goal = dataclasses.replace(goal, q=check_configuration(robot, world, goal.q, "goal"))
    world, corner = working_world(world)
    policy = _policy(planner, robot, world, sampler, config)
    if config.capacity < policy.lanes + 2:
        raise ValueError(
            f"capacity is {config.capacity}; expected at least {policy.lanes + 2}, two more than "
            "the lanes: raise it or lower lanes"
        )
    tree = policy.init(world, goal, np.asarray(start)[None], config.capacity)
    scene = scene or ExactScene(robot, grid)
    if starts_at(goal, world, start):
        found = no_search(policy, tree)
        at_goal = np.asarray(start)[None]
        return _moved(_finish(scene, world, corner, goal, at_goal, found, key), corner)
    tried, spent, rejected = 0, Counter(), Counter()
    results: list[PlanResult] = []
    with interruptible() as interrupted:
        for attempt in range(ATTEMPTS):
            left_s = config.time_limit_s - spent["search_s"]
            if attempt and (config.max_expansions - tried < policy.lanes or left_s <= 0):
                break
            iterations = max((config.max_expansions - tried) // policy.lanes, 1)
            found = search(
                world,
                goal,
                policy,
                tree,
                key=jax.random.fold_in(key, attempt),
                termination=make_termination(policy.goal_score(goal), max_iterations=iterations),
                time_limit_s=left_s,
                max_capacity=config.max_capacity,
                on_progress=on_progress,
            )
            path = policy.extract_path(found.tree)
            check_extracted_path(policy, path, np.asarray(start))
            raw = np.asarray(start)[None] if path is None else path
            results.append(_finish(scene, world, corner, goal, raw, found, key))
            tried += results[-1].expansions
            spent.update(results[-1].timing)
            rejected.update(results[-1].rejected)
            if results[-1].status is not Status.NOT_VERIFIED or interrupted.is_set():
                break
            world = dataclasses.replace(world, resolution=world.resolution / 2)
    # A path that was refused tells more than a search that found none.
    result = next((r for r in reversed(results) if r.verification is not None), results[-1])
    result = dataclasses.replace(
        result,
        timing=dict(spent),
        expansions=tried,
        refused=sum(r.refused for r in results),
        rejected=dict(rejected),
    )
    return _moved(result, corner)


def _moved(result: PlanResult, corner: np.ndarray) -> PlanResult:
    """A result whose places were measured from a corner (2,), in the map."""
    names = ("path", "trajectory", "raw_path", "target", "alternatives")
    places = {name: shifted(getattr(result, name), corner) for name in names}
    tree = dataclasses.replace(result.tree, q=shifted(np.asarray(result.tree.q), corner))
    return dataclasses.replace(result, tree=tree, **places)


def _planner(planner: str | ExpansionPolicy, method: str | None) -> str | ExpansionPolicy:
    """The planner that is asked for.

    Raises:
        ValueError: two are, the name is unknown, or the object is no policy.
    """
    if method is not None:
        if planner != "rrt-connect":
            raise ValueError("got both planner and method; expected one of them")
        planner = method
    if not isinstance(planner, str):
        check_policy(planner)
    elif planner not in PLANNERS:
        raise ValueError(f"unknown planner '{planner}'; have: {', '.join(PLANNERS)}")
    return planner


def _config(config: PlannerConfig | None, settings: dict[str, Any]) -> PlannerConfig:
    """The settings of a plan, those given by name included."""
    config = PlannerConfig() if config is None else config
    known = [field.name for field in dataclasses.fields(config)]
    if unknown := sorted({*settings} - {*known}):
        raise ValueError(f"unknown settings {', '.join(unknown)}; have: {', '.join(known)}")
    config = dataclasses.replace(config, **settings)
    check_settings(config)
    return config


def check_shape(robot: MobileRobot, q: Any, what: str) -> np.ndarray:
    """Numbers as float64 (D,), which places far from a map's origin need.

    Raises:
        ValueError: they are none, or not one for each joint.
    """
    try:
        q = np.asarray(q, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"the {what} is {q!r}; expected numbers, one for each joint") from None
    if q.shape != (robot.num_joints,):
        names = ", ".join(robot.joint_names)
        raise ValueError(f"the {what} has shape {q.shape}; expected ({robot.num_joints},): {names}")
    return q


def check_configuration(
    robot: MobileRobot, world: GridWorld, q: np.ndarray, what: str
) -> jax.Array:
    """A configuration (D,) for the device, in the planners' own world, see ``working_world``.

    Raises:
        ValueError: wrong shape, not finite, outside the limits or not free; the message names the
            nearest free configuration.
    """
    q = check_shape(robot, q, what)
    if world.lower.shape != (robot.num_joints,):
        raise ValueError(
            f"the world is of a robot with {len(world.lower)} joints, and '{robot.name}' has "
            f"{robot.num_joints}: build the world for it"
        )
    inner, corner = working_world(world)
    local = shifted(q, -corner)
    lower, upper = (np.asarray(a, np.float64) for a in (inner.lower, inner.upper))
    is_continuous = np.asarray(inner.is_continuous)
    outside = (local < lower - 1e-4) | (local > upper + 1e-4)
    bad = ~np.isfinite(q) | (outside & ~is_continuous)
    if bad.any():
        joint = int(np.flatnonzero(bad)[0])
        place = "the map spans" if joint < 2 else "its limits are"
        instead = f"; {advice(robot, world, q)}" if np.isfinite(q).all() and joint > 1 else ""
        raise ValueError(
            f"the {what}'s {robot.joint_names[joint]} is {q[joint]}; {place} "
            f"[{shifted(lower, corner)[joint]:.3f}, {shifted(upper, corner)[joint]:.3f}]{instead}"
        )
    if turned := [*np.flatnonzero(is_continuous & (np.abs(q) > 2 * np.pi * MOST_TURNS))]:
        raise ValueError(
            f"the {what}'s {robot.joint_names[turned[0]]} is {q[turned[0]]:.4g} rad, more than "
            f"{MOST_TURNS} turns from zero; expected less: take whole turns of 2 pi off"
        )
    # Only what rounding has put beyond a limit is put onto it: joints stay in their turn.
    inside = np.where(is_continuous, local, np.clip(local, lower, upper)).astype(np.float32)
    if not batch_is_free(inner, inside[None])[0]:
        raise ValueError(refusal(robot, world, q, what))
    return jnp.asarray(inside)


def trajectory_of(world: GridWorld, path: np.ndarray) -> np.ndarray:
    """A path (P, D) in steps (T, D) of 0.02 m or rad at most; angles go on where they wrap."""
    return _trajectory(world, path)[0]


def _trajectory(world: GridWorld, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """See :func:`trajectory_of`; and where on it (P,) the waypoints are."""
    if len(path) < 2:
        return np.asarray(path), np.arange(len(path))
    spans = np.asarray(_spans(world, padded(path)))[: len(path) - 1]
    counts = np.maximum(np.ceil(spans / STEP), 1).astype(int)
    index = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    fraction = (within / counts[index]).astype(np.float32)
    room = 1 << int(len(index) - 1).bit_length()  # few sizes, so few compilations
    padding = (0, room - len(index))
    q_a, q_b = (np.pad(path[index + k], [padding, (0, 0)], mode="edge") for k in (0, 1))
    points = _interpolate(world, q_a, q_b, np.pad(fraction, padding))
    steps = unwrapped(world, np.concatenate([path[:1], np.asarray(points)[: len(index)]]))
    return steps, np.concatenate([[0], np.cumsum(counts)])


@jax.jit
def _spans(world: GridWorld, path: jax.Array) -> jax.Array:
    return world.span(world.edge(path[:-1], path[1:]))


@jax.jit
def _interpolate(world: GridWorld, q_a, q_b, fraction) -> jax.Array:
    return world.interpolate(q_a, q_b, fraction)


def _policy(
    planner: str | ExpansionPolicy,
    robot: MobileRobot,
    world: GridWorld,
    sampler: Any,
    config: PlannerConfig,
) -> ExpansionPolicy:
    """The policy of a planner by name, or the object itself.

    Raises:
        ValueError: the sampler does not fit.
    """
    if not isinstance(planner, str):
        return planner
    if planner == "rrt-connect":
        return RRTConnect(lanes=max(config.lanes, 2))
    bias = jnp.float32(config.goal_bias)
    shape = {"keep_partial": True, "lanes": config.lanes, "edge_steps": EDGE_STEPS}
    if planner in ("rrt", "rrt-is"):
        return RRT(goal_bias=bias, intermediate=planner == "rrt-is", **shape)
    sampler = load_sampler(robot.name, KINDS[planner]) if sampler is None else sampler
    check_fits(sampler, robot, world, KINDS[planner])
    rate = jnp.float32(config.straight_rate)
    return NeuralRRT(goal_bias=bias, sampler=sampler, straight_rate=rate, **shape)


def _finish(
    scene: ExactScene,
    world: GridWorld,
    corner: np.ndarray,
    goal: ConfigurationGoal,
    raw: np.ndarray,
    found: SearchResult,
    key: jax.Array,
) -> PlanResult:
    """Shorten and verify what a search found, ``raw`` (P, D)."""
    loss, threshold = float(goal.loss(world, jnp.asarray(raw[-1]))), float(goal.threshold)

    def check(path: np.ndarray) -> CheckedPath:
        trajectory, waypoints = _trajectory(world, path)
        # Waypoints in the turns that the robot is in by then, so that they can be interpolated.
        path = nearest_turn(world, path, trajectory[waypoints])
        lower, upper = (shifted(np.asarray(a), corner) for a in (world.lower, world.upper))
        verification = verify(scene, shifted(trajectory, corner), lower=lower, upper=upper)
        return CheckedPath(path=path, trajectory=trajectory, verification=verification)

    if loss <= threshold:
        finer = dataclasses.replace(world, resolution=world.resolution / 2)
        done = postprocess(finer, raw, check, key=key)
        status = Status.SOLVED if done.is_verified else Status.NOT_VERIFIED
    else:
        done = unchecked(raw, trajectory_of(world, raw))
        status = STATUS_OF.get(found.stopped, Status.NO_PATH)
    return plan_result(
        world,
        found,
        done,
        status=status,
        advice=ADVICE[status],
        target=nearest_turn(world, np.asarray(goal.q), done.checked.path[-1]),
        loss=loss,
        match_threshold=threshold,
    )
