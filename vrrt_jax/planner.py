"""Planning, from the outside: what users call, with every input checked on the host."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax import checks
from vrrt_jax.config import PlannerConfig, PlanResult
from vrrt_jax.core import tree as trees
from vrrt_jax.core.planners.rrt import RRT, tree_path
from vrrt_jax.core.planners.rrt_connect import RRTConnect, connection_path
from vrrt_jax.core.search import interruptible, make_termination, search
from vrrt_jax.core.types import Status, Tree
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import Camera
from vrrt_jax.visual.finish import (
    HURRIED,
    STATUS_OF,
    finish,
    finish_visual,
    time_left,
    timed,
    with_time_of,
)
from vrrt_jax.visual.goal import Setup, Sight, visual_setup, visual_termination
from vrrt_jax.visual.policy import best_probes, forest, plant

PLANTING = 0x7FFFFFFF  # folded into the key before the search, whose iterations count from 0
ENDED = tuple(STATUS_OF[stopped] for stopped in HURRIED)  # before losses compare with others'
AGAIN = (Status.NO_MATCH, Status.NO_PATH, Status.NOT_VERIFIED)  # worth another attempt
RRT_STAR_RADIUS = 1.9  # [rad] nodes of a sparse tree in seven dimensions lie that far apart


def plan(
    robot: Robot,
    world: World,
    self_model: SelfModel,
    camera: Camera | Sequence[Camera],
    goal_image: np.ndarray | Sequence[np.ndarray],
    q_start: np.ndarray,
    *,
    key: jax.Array,
    config: PlannerConfig | None = None,
    mask: np.ndarray | Sequence[np.ndarray] | None = None,
    q_guess: np.ndarray | None = None,
    on_progress: Callable[..., Any] | None = None,
) -> PlanResult:
    """Find a collision-free path whose end looks like the goal image.

    Args:
        robot: from :func:`load_robot`.
        world: from :func:`load_world` or :func:`build_world`, for this robot.
        self_model: from :func:`load_self_model`, for this robot.
        camera: the view of the goal image; or V of them.
        goal_image: (H, W, 4) RGB and mask, or (H, W, 3) on a plain background; uint8, or float in
            [0, 1]; or V of them.
        q_start: (D,) start configuration [rad] or [m].
        key: random key; the same key gives the same plan on the same machine, unless time ends it.
        config: settings, the default ones if None.
        mask: (H, W) bool, True for the pixels of the goal image that are compared, where not all
            are: something may hide the robot; or V of them.
        q_guess: (D,) where the goal roughly is, if that is known: searched from too.
        on_progress: called with the search state and the seconds so far.

    Raises:
        ValueError: an input makes no sense; the message says what to do.
    """
    config = config or PlannerConfig()
    checks.check_config(config)
    q_start = checks.check_start(robot, world, q_start)
    sight = Sight(robot, self_model, camera, goal_image, mask)
    setup = visual_setup(sight, q_start, config)
    roots = q_start[None]
    if q_guess is not None:
        roots = np.stack([q_start, checks.check_limits(robot, q_guess, "guess")])
    with interruptible():
        result = _attempt(robot, world, setup, roots, key, config, on_progress)
        for again in range(1, config.attempts):
            rest = time_left(config, result.timing["search_s"])
            if result.status not in AGAIN or rest.time_limit_s == 0:
                break
            key = jax.random.fold_in(key, PLANTING - again)
            other = _attempt(robot, world, setup, roots, key, rest, on_progress)
            if other.status in ENDED and not other.ok:
                best = dataclasses.replace(result, status=other.status)
            else:
                best = min(result, other, key=lambda r: (not r.ok, r.loss))
            result = with_time_of(best, result, other)
    return result


def _attempt(
    robot: Robot,
    world: World,
    setup: Setup,
    roots: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
    on_progress: Callable[..., Any] | None,
) -> PlanResult:
    """Probe around the start (the first of the roots), search and finish, once."""
    tree, compile_s, plant_s = _planted(world, setup, roots, key, config)
    found = search(
        world,
        setup.policy,
        tree,
        key=key,
        stop=visual_termination(config, setup.goal_loss),
        time_limit_s=time_left(config, plant_s).time_limit_s,
        on_progress=on_progress,
    )
    found = dataclasses.replace(
        found, compile_s=found.compile_s + compile_s, search_s=found.search_s + plant_s
    )
    ends = (setup.goal_loss, setup.polishing, roots[0])
    return finish_visual(robot, world, found, *ends, key, config)


def _planted(
    world: World, setup: Setup, roots: np.ndarray, key: jax.Array, config: PlannerConfig
) -> tuple[Tree, float, float]:
    """The forest before the search, and the seconds for its compilation and for itself."""
    key = jax.random.fold_in(key, PLANTING)
    seeds = (setup.policy, setup.probing, roots, key, config.capacity)
    return timed(lambda: plant(world, *seeds), best_probes, forest)


def plan_batch(
    robot: Robot,
    world: World,
    self_model: SelfModel,
    camera: Camera | Sequence[Camera],
    goal_images: Sequence[np.ndarray | Sequence[np.ndarray]],
    q_starts: np.ndarray,
    *,
    key: jax.Array,
    config: PlannerConfig | None = None,
    on_progress: Callable[..., Any] | None = None,
) -> list[PlanResult]:
    """Solve Q problems of one robot, world and camera at once, by an outer ``vmap``.

    Problem ``i`` uses the key ``fold_in(key, i)``; each has one attempt. The search times reported
    hold the search of the whole batch. On a CPU a loop over :func:`plan` is as fast; on other
    devices the batch pays.

    Args:
        robot: from :func:`load_robot`.
        world: for this robot.
        self_model: for this robot.
        camera: the view of all goal images; or V of them.
        goal_images: Q goal images, or Q lists of V; see :func:`plan`.
        q_starts: (Q, D) start configurations.
        key: random key.
        config: settings, the default ones if None.
        on_progress: called with the batched search state and the seconds so far.

    Raises:
        ValueError: an input makes no sense; the message names the problem.
    """
    config = config or PlannerConfig()
    checks.check_config(config)
    if len(goal_images) != len(q_starts) or len(goal_images) == 0:
        raise ValueError(
            f"got {len(goal_images)} goal images and {len(q_starts)} starts; expected as many, "
            "and at least one"
        )
    starts, setups = [], []
    for i, (image, q_start) in enumerate(zip(goal_images, q_starts, strict=True)):
        try:
            starts.append(checks.check_start(robot, world, q_start))
            sight = Sight(robot, self_model, camera, image)
            setups.append(visual_setup(sight, starts[-1], config))
        except ValueError as error:
            raise ValueError(f"problem {i}: {error}") from None
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(starts)))
    with interruptible():
        forests, compile_s, plant_s = zip(
            *(
                _planted(world, setup, q_start[None], own_key, config)
                for setup, q_start, own_key in zip(setups, starts, keys, strict=True)
            ),
            strict=True,
        )
        found = search(
            world,
            _stack([setup.policy for setup in setups]),
            _stack(forests),
            key=keys,
            stop=_stack([visual_termination(config, setup.goal_loss) for setup in setups]),
            time_limit_s=time_left(config, sum(plant_s)).time_limit_s,
            batched=True,
            on_progress=on_progress,
        )
        results = []
        for i, (q_start, setup) in enumerate(zip(starts, setups, strict=True)):
            own = dataclasses.replace(
                found,
                tree=jax.tree.map(lambda leaf: leaf[i], found.tree),  # noqa: B023 - used at once
                stopped=found.stopped_each[i],
                compile_s=found.compile_s + sum(compile_s),
                search_s=found.search_s + plant_s[i],
            )
            ends = (setup.goal_loss, setup.polishing, q_start)
            results.append(finish_visual(robot, world, own, *ends, keys[i], config))
    return results


def plan_to_configuration(
    robot: Robot,
    world: World,
    q_start: np.ndarray,
    q_goal: np.ndarray,
    *,
    key: jax.Array,
    planner: str = "rrt-connect",
    config: PlannerConfig | None = None,
    goal_bias: float = 0.1,
    on_progress: Callable[..., Any] | None = None,
) -> PlanResult:
    """Find a collision-free path to a joint goal, on the kernel that Visual-RRT runs on.

    Args:
        robot: from :func:`load_robot`.
        world: for this robot.
        q_start: (D,) [rad] or [m].
        q_goal: (D,) [rad] or [m].
        key: random key.
        planner: "rrt", "rrt-star" (goes on to improve until its iterations are used up) or
            "rrt-connect".
        config: budget, capacity and lanes are used.
        goal_bias: share of lanes that aim at the goal, for "rrt" and "rrt-star".
        on_progress: called with the search state and the seconds so far.

    Raises:
        ValueError: an input makes no sense; the message says what to do.
    """
    config = config or PlannerConfig()
    checks.check_config(config)
    q_start = checks.check_start(robot, world, q_start)
    q_goal = checks.check_start(robot, world, q_goal, what="goal")
    start, goal = jnp.asarray(q_start), jnp.asarray(q_goal)
    if planner == "rrt-connect":
        policy: Any = RRTConnect(lanes=config.lanes)
        tree, stop_score = policy.forest(start, goal, config.capacity), 0.0
    elif planner in ("rrt", "rrt-star"):
        policy = RRT(
            goal=goal,
            goal_bias=jnp.float32(goal_bias),
            rewire_radius=jnp.float32(RRT_STAR_RADIUS),
            star=planner == "rrt-star",
            lanes=config.lanes,
        )
        score, payload = policy.root(world, start)
        tree = trees.create(start[None], score[None], payload, config.capacity)
        stop_score = -1.0 if policy.star else 1e-4
    else:
        raise ValueError(f"unknown planner '{planner}'; have: rrt, rrt-star, rrt-connect")
    stop = make_termination(stop_score, max_iterations=config.max_iterations)
    found = search(
        world,
        policy,
        tree,
        key=key,
        stop=stop,
        time_limit_s=config.time_limit_s,
        on_progress=on_progress,
    )
    path = connection_path(found.tree) if planner == "rrt-connect" else tree_path(found.tree)
    loss = float(jnp.min(found.tree.score))
    goal_loss = max(stop_score, 1e-4)
    result = finish(robot, world, found, path, q_goal, loss, goal_loss, key, config, q_start)
    if path is None:
        result = dataclasses.replace(result, status=STATUS_OF[found.stopped])
    return result


def _stack(items: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)
