"""Planning, from the outside: what users call, with every input checked on the host."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.config import PlannerConfig
from nrp_jax.homes.grid import Grid
from nrp_jax.homes.top_view import TopView
from nrp_jax.planners.by_drive import search_by_drive
from nrp_jax.planners.by_name import DECOMPOSED, PLANNERS, QUICK, RESTARTS, policy_of
from nrp_jax.planners.decomposed import search_decomposed, shortcut_legs
from nrp_jax.planners.drive import folded_postures
from nrp_jax.planners.nrp_connect import NRPConnect, default_planner
from nrp_jax.planners.one_tree import plan_one_tree
from nrp_jax.planners.restarts import search_with_restarts
from nrp_jax.planners.shorten import shorten, shorten_parts
from nrp_jax.scene.configurations import check_configuration
from nrp_jax.scene.exact import ExactScene, verify
from nrp_jax.scene.nearest import shifted, working_world
from nrp_jax.scene.quicken import FEW_PROPOSALS, quicken
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.trajectory import trajectory_of, with_waypoints
from nrp_jax.scene.world import GridWorld, build_world
from vrrt_jax.core.check_protocols import check_extracted_path, check_policy
from vrrt_jax.core.edges import nearest_turn
from vrrt_jax.core.goal import ConfigurationGoal, starts_at
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.planners import RRT
from vrrt_jax.core.postprocess import CheckedPath, plan_result, postprocess, unchecked
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import STATUS_OF, PlanResult, Status
from vrrt_jax.core.search import SearchResult, make_termination, no_search, search
from vrrt_jax.core.settings import check_settings
from vrrt_jax.core.types import ExpansionPolicy

ATTEMPTS = 3  # each checks edges twice as finely as the one before, whose path touched something
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
    planner: str | ExpansionPolicy | None = None,
    method: str | None = None,
    sampler: Any = None,
    world: GridWorld | None = None,
    scene: ExactScene | None = None,
    config: PlannerConfig | None = None,
    on_progress: Callable[..., Any] | None = None,
    **settings: Any,
) -> PlanResult:
    """Find a collision-free path between two configurations in a home.

    Planners with "star" in their names improve their paths until ``max_expansions`` or
    ``time_limit_s``, whichever ends first; column 4 of ``history`` is the length of the path over
    time.

    Should the path that was found touch something between two of the planner's checks, those with
    one tree cut the edges off that do, and go on. The others plan again with checks twice as fine,
    up to twice. Both take what is left of the budgets.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: from :func:`nrp_jax.load_map` or a generator.
        q_start: (D,) configuration [m] and [rad].
        q_goal: (D,) configuration, or a goal that holds one.
        key: random key; the same key gives the same plan on the same machine, unless time ends it.
        planner: one of :data:`PLANNERS`, or a policy of the kernel, see
            :class:`~vrrt_jax.core.types.ExpansionPolicy`. By default "nrp-connect" where the
            packaged networks fit robot and map, otherwise "rrt-connect".
        method: another word for ``planner``.
        sampler: what proposes waypoints to the "nrp-" planners: a pytree with ``propose(world,
            q_from, q_goal, key)``. For the "cvae-" planners, what draws samples: a pytree with
            ``draw(world, q_start, q_goal, num, key)``; for "fire" and "fire-star", what has
            ``retrieve(world, q_start, q_goal)``, which returns such a one. The packaged weights by
            default.
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
    planner = default_planner(robot, world) if planner is None else planner
    goal = q_goal if isinstance(q_goal, ConfigurationGoal) else ConfigurationGoal(q=q_goal)
    q_start, q_goal = check_inputs(robot, world, q_start, goal.q)
    # All that follows is in the planners' own world.
    of_map, (world, corner) = world, working_world(world, goal)
    places = _Places(grid=grid, world=of_map, corner=corner, start=q_start)
    start, goal_q = (jnp.asarray(shifted(q, -corner), jnp.float32) for q in (q_start, q_goal))
    goal = dataclasses.replace(goal, q=goal_q)
    policy = policy_of(planner, robot, world, sampler, config, (start, goal_q))
    if config.capacity < policy.lanes + 2:
        raise ValueError(
            f"capacity is {config.capacity}; expected at least {policy.lanes + 2}, two more than "
            "the lanes: raise it or lower lanes"
        )
    tree = policy.init(world, goal, np.asarray(start)[None], config.capacity)
    is_plain = tree.payload is None and planner != DECOMPOSED
    one_tree = policy if isinstance(policy, RRT) and is_plain else None
    # Shorter paths keep closer to obstacles, and a planner that goes on until its budget ends has
    # none left to plan again: its checks are twice as fine from the first.
    if policy.goal_score(goal) == -np.inf and one_tree is None:
        world = dataclasses.replace(world, resolution=world.resolution / 2)
    shorter = shortcut_legs if planner == DECOMPOSED else shorten
    scene = scene or ExactScene(robot, grid)
    if starts_at(goal, world, start):
        found = no_search(policy, goal, tree)
        at_goal = np.asarray(start)[None]
        return _moved(_finish(scene, world, places, goal, at_goal, found, key), places)

    def finish(world: GridWorld, found: SearchResult, path: np.ndarray | None) -> PlanResult:
        check_extracted_path(policy, path, np.asarray(start))
        raw = np.asarray(start)[None] if path is None else path
        return _finish(scene, world, places, goal, raw, found, key, shorter)

    accept = functools.partial(_is_free_part, scene, world, places)
    most = max(config.max_expansions // policy.lanes, 1)
    options = {"max_capacity": config.max_capacity, "on_progress": on_progress}
    if one_tree is not None:
        with interruptible():
            result = plan_one_tree(
                world,
                goal,
                one_tree,
                tree,
                finish=finish,
                accept=accept,
                key=jax.random.fold_in(key, 0),
                termination=make_termination(policy.goal_score(goal), max_iterations=most),
                time_limit_s=config.time_limit_s,
                **options,
            )
        return _moved(result, places)
    tried, spent, rejected = 0, Counter(), Counter()
    results: list[PlanResult] = []
    with interruptible() as interrupted:
        for attempt in range(ATTEMPTS):
            left_s = config.time_limit_s - spent["search_s"]
            left = most - tried // policy.lanes
            if attempt and (left < 1 or left_s <= 0):
                break
            found, path = _searched(
                planner,
                robot,
                world,
                goal,
                policy,
                tree,
                places,
                scene,
                accept=accept,
                key=jax.random.fold_in(key, attempt),
                termination=make_termination(policy.goal_score(goal), max_iterations=left),
                time_limit_s=left_s,
                **options,
            )
            results.append(finish(world, found, path))
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
    return _moved(result, places)


def check_inputs(
    robot: MobileRobot, world: GridWorld, q_start: np.ndarray, q_goal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Start and goal (D,), if both make sense.

    Raises:
        ValueError: one does not.
    """
    return (
        check_configuration(robot, world, q_start, "start"),
        check_configuration(robot, world, q_goal, "goal"),
    )


def _searched(
    planner: str | ExpansionPolicy,
    robot: MobileRobot,
    world: Any,
    goal: Any,
    policy: Any,
    tree: Any,
    places: "_Places",
    scene: ExactScene,
    *,
    accept: Callable[[np.ndarray], bool],
    **options: Any,
) -> tuple[SearchResult, np.ndarray | None]:
    """What a planner finds, and the path (P, D) if there is one."""
    if planner == DECOMPOSED:
        return search_decomposed(world, goal, policy, tree, grid=places.local_grid(), **options)
    if isinstance(policy, NRPConnect):
        options["folded"] = folded_postures(robot.name)
        if planner not in (RESTARTS, QUICK):
            return search_by_drive(world, goal, policy, tree, **options)

        def seconds(path: np.ndarray) -> float:
            key, path = jax.random.key(0), places.of_path(path)
            known = {"world": places.world, "scene": scene, "proposals": FEW_PROPOSALS}
            try:
                return quicken(robot, places.grid, path, key=key, **known).duration_s
            except ValueError:  # it touches something where other steps along it did not
                return np.inf

        options["measure"] = seconds if planner == QUICK else None
        return search_with_restarts(world, goal, policy, tree, accept=accept, **options)
    found = search(world, goal, policy, tree, **options)
    return found, policy.extract_path(found.tree)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Places:
    """The way back from the planners' own world to the map."""

    grid: Grid  # the map
    world: GridWorld  # of the map
    corner: np.ndarray  # (2,) of the map [m]
    start: np.ndarray  # (D,) as it was given

    def local_grid(self) -> Grid:
        """The map where the planners' own world has it."""
        x, y = np.array(self.grid.origin[:2]) - self.corner
        return dataclasses.replace(self.grid, origin=(float(x), float(y), self.grid.origin[2]))

    def of(self, q: np.ndarray) -> np.ndarray:
        """Configurations (..., D) in the map."""
        return shifted(q, self.corner)

    def of_path(self, path: np.ndarray) -> np.ndarray:
        """A path (P, D) in the map; it begins exactly where it was told to."""
        path = self.of(path)
        path[0] = self.start
        return path


def _moved(result: PlanResult, places: _Places) -> PlanResult:
    """A result of the planners' own world, in the map."""
    paths = {n: places.of_path(getattr(result, n)) for n in ("path", "trajectory", "raw_path")}
    ends = {n: places.of(getattr(result, n)) for n in ("target", "alternatives")}
    tree = dataclasses.replace(result.tree, q=places.of(np.asarray(result.tree.q)))
    return dataclasses.replace(result, tree=tree, draw=TopView(places.grid), **paths, **ends)


def _planner(
    planner: str | ExpansionPolicy | None, method: str | None
) -> str | ExpansionPolicy | None:
    """The planner that is asked for, None for the default.

    Raises:
        ValueError: two are, the name is unknown, or the object is no policy.
    """
    if method is not None:
        if planner is not None:
            raise ValueError("got both planner and method; expected one of them")
        planner = method
    if planner is not None and not isinstance(planner, str):
        check_policy(planner)
    elif planner not in (None, *PLANNERS):
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


def _checked(scene: ExactScene, world: GridWorld, places: _Places, path: np.ndarray) -> CheckedPath:
    """What the exact check says of a path (P, D) of the planners' own world."""
    trajectory, waypoints = with_waypoints(world, path)
    # Waypoints in the turns that the robot is in by then, so that they can be interpolated.
    path = nearest_turn(world, path, trajectory[waypoints])
    lower, upper = (places.of(np.asarray(a)) for a in (world.lower, world.upper))
    verification = verify(scene, places.of_path(trajectory), lower=lower, upper=upper)
    return CheckedPath(path=path, trajectory=trajectory, verification=verification)


def _is_free_part(scene: ExactScene, world: GridWorld, places: _Places, path: np.ndarray) -> bool:
    """Whether the exact check passes a path (P, D), or a part of one that begins elsewhere."""
    begins = dataclasses.replace(places, start=places.of(path[0]))
    verification = _checked(scene, world, begins, path).verification
    return verification is not None and verification.ok


def _finish(
    scene: ExactScene,
    world: GridWorld,
    places: _Places,
    goal: ConfigurationGoal,
    raw: np.ndarray,
    found: SearchResult,
    key: jax.Array,
    shorter: Callable[..., np.ndarray] = shorten,
) -> PlanResult:
    """Shorten and verify what a search found, ``raw`` (P, D)."""
    loss, threshold = float(goal.loss(world, jnp.asarray(raw[-1]))), float(goal.threshold)
    check = functools.partial(_checked, scene, world, places)
    if loss <= threshold:
        finer = dataclasses.replace(world, resolution=world.resolution / 2)
        done = postprocess(finer, raw, check, key=key, shorten=shorter)
        if done.is_verified and done.refused:  # of a raw path some parts may still be shortened
            accept = functools.partial(_is_free_part, scene, world, places)
            parts = shorten_parts(finer, done.raw_path, accept, key=key, how=shorter)
            together = None if parts is None else dataclasses.replace(done, checked=check(parts))
            if together is not None and together.is_verified:
                done = together
        status = Status.SOLVED if done.is_verified else Status.NOT_VERIFIED
    else:
        done = unchecked(raw, trajectory_of(world, raw))
        status = STATUS_OF.get(found.stopped, Status.NO_PATH)
    return plan_result(
        world,
        found,
        done,
        status=status,
        advice=found.advice or ADVICE[status],
        target=nearest_turn(world, np.asarray(goal.q), done.checked.path[-1]),
        loss=loss,
        match_threshold=threshold,
    )
