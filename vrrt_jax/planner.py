"""Planning, from the outside: what users call, with every input checked on the host."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax import checks
from vrrt_jax.config import PlannerConfig, PlanResult
from vrrt_jax.core import tree as trees
from vrrt_jax.core.kinematics import batch_link_poses
from vrrt_jax.core.rrt import RRT, RRTConnect, connection_path, tree_path
from vrrt_jax.core.search import SearchResult, Stopped, make_stop, search
from vrrt_jax.core.shortcut import path_length, shortcut
from vrrt_jax.core.types import Rejection, Status
from vrrt_jax.core.verify import verify_path
from vrrt_jax.core.world import World, obstacle_list
from vrrt_jax.robots.robot import Robot
from vrrt_jax.splat.goal import prepare_goal
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.raster import Windows, choose_windows
from vrrt_jax.splat.types import Camera, SplatModel
from vrrt_jax.visual import Probing, VisualPolicy, plant

STATUS_OF = {
    Stopped.CONVERGED: Status.NO_MATCH,
    Stopped.ITERATIONS: Status.BUDGET,
    Stopped.TREE_FULL: Status.TREE_FULL,
    Stopped.TIME_LIMIT: Status.TIME_LIMIT,
    Stopped.INTERRUPTED: Status.INTERRUPTED,
}


PLANTING = 0x7FFFFFFF  # folded into the key before the search, whose iterations count from 0
HYPOTHESES = 3  # matched configurations that are tried before there is no path
DISTINCT = 0.3  # [rad] distance at which they count as different
SAME_LOSS = 1.05  # losses within this factor are the same match
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
    policy, probing, goal_loss = visual_policy(
        robot, self_model, camera, goal_image, q_start, config, mask=mask
    )
    roots = q_start[None]
    if q_guess is not None:
        roots = np.stack([q_start, checks.check_limits(robot, q_guess, "guess")])
    seeds = (world, policy, probing, jnp.asarray(roots), jax.random.fold_in(key, PLANTING))
    programs = _plant._cache_size()
    tree, plant_s = _timed(_plant, *seeds, config.capacity)
    compile_s = 0.0
    if _plant._cache_size() > programs:
        compile_s = plant_s
        tree, plant_s = _timed(_plant, *seeds, config.capacity)
    found = search(
        world,
        policy,
        tree,
        key=key,
        stop=_visual_stop(config, goal_loss),
        time_limit_s=config.time_limit_s,
        on_progress=on_progress,
    )
    found = dataclasses.replace(
        found,
        compile_s=found.compile_s + max(compile_s - plant_s, 0.0),
        search_s=found.search_s + plant_s,
    )
    return _finish_visual(robot, world, found, goal_loss, q_start, key, config)


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

    Problem ``i`` uses the key ``fold_in(key, i)``. The search times reported are those of the whole
    batch. On a CPU a loop over :func:`plan` is as fast; on other devices the batch pays.

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
    starts, policies, goal_losses = [], [], []  # policies with their probing
    for i, (image, q_start) in enumerate(zip(goal_images, q_starts, strict=True)):
        try:
            starts.append(checks.check_start(robot, world, q_start))
            *policy, loss = visual_policy(robot, self_model, camera, image, starts[-1], config)
        except ValueError as error:
            raise ValueError(f"problem {i}: {error}") from None
        policies.append(policy)
        goal_losses.append(loss)
    policies, probings = _stack(policies)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(starts)))
    started = time.perf_counter()
    plants = jax.vmap(_plant, (None, 0, 0, 0, 0, None))
    seeds = jax.vmap(jax.random.fold_in, (0, None))(keys, PLANTING)
    tree = jax.block_until_ready(
        plants(
            world,
            policies,
            probings,
            jnp.asarray(np.stack(starts))[:, None],
            seeds,
            config.capacity,
        )
    )
    compile_s = time.perf_counter() - started
    found = search(
        world,
        policies,
        tree,
        key=keys,
        stop=_stack([_visual_stop(config, loss) for loss in goal_losses]),
        time_limit_s=config.time_limit_s,
        batched=True,
        on_progress=on_progress,
    )
    results = []
    for i, (q_start, loss) in enumerate(zip(starts, goal_losses, strict=True)):
        own_tree = jax.tree.map(lambda leaf: leaf[i], found.tree)  # noqa: B023 - used at once
        own = dataclasses.replace(found, tree=own_tree, compile_s=found.compile_s + compile_s)
        results.append(_finish_visual(robot, world, own, loss, q_start, keys[i], config))
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
        config: budget, capacity, lanes and rewiring radius are used.
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
    stop = make_stop(stop_score, max_iterations=config.max_iterations)
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
    return _finish(robot, world, found, path, q_goal, loss, goal_loss, key, config, q_start)


def visual_policy(
    robot: Robot,
    self_model: SelfModel,
    camera: Camera | Sequence[Camera],
    goal_image: Any,
    q_start: np.ndarray,
    config: PlannerConfig,
    mask: Any = None,
) -> tuple[VisualPolicy, Probing, float]:
    """The policy, where to look before the search, and the loss that counts as matched."""
    checks.check_self_model(robot, self_model)
    if isinstance(camera, Camera):
        camera, goal_image, mask = [camera], [goal_image], None if mask is None else [mask]
    goal, cameras = prepare_goal(goal_image, camera, config.image_px, mask)
    level = self_model.level_for(goal.coverage.shape[1])
    checks.check_cameras(robot, level.splats, cameras, q_start)
    covered = float(jnp.sum(goal.valid * goal.coverage) / jnp.sum(goal.valid))
    goal_loss = config.match_scale * level.match_bar * covered
    numbers = {
        "alpha": config.alpha,
        "epsilon": config.epsilon,
        "kappa": config.kappa,
        "eta": config.eta,
        "exploration": config.exploration,
        "beta1": config.beta1,
        "beta2": config.beta2,
        "anneal_loss": config.anneal * goal_loss,
        "rewire_radius": config.rewire_radius,
    }
    splats, windows = _windowed(robot, level.splats, cameras)
    policy = VisualPolicy(
        splats=splats,
        windows=windows,
        cameras=cameras,
        goal=goal,
        **{name: jnp.float32(value) for name, value in numbers.items()},
        inherit=jnp.asarray(config.inherit),
        rewiring=config.rewiring,
        lanes=config.lanes,
    )
    coarse_goal, coarse_cameras = prepare_goal(goal_image, camera, config.probe_px, mask)
    level = self_model.level_for(coarse_goal.coverage.shape[1])
    splats, windows = _windowed(robot, level.splats, coarse_cameras)
    coarse = dataclasses.replace(
        policy,
        alpha=jnp.float32(config.probe_alpha),
        splats=splats,
        windows=windows,
        cameras=coarse_cameras,
        goal=coarse_goal,
    )
    probing = Probing(
        policy=coarse,
        radius=jnp.float32(config.probe_radius),
        steps=jnp.int32(config.probe_steps),
        num=config.probes,
        kept=min(config.probes, config.probes_kept),
    )
    return policy, probing, goal_loss


def _windowed(
    robot: Robot, splats: SplatModel, cameras: Camera
) -> tuple[SplatModel, Windows | None]:
    """The splats in clusters, with windows of the image that hold most of them in every view."""
    rng = np.random.default_rng(0)
    q = jnp.asarray(rng.uniform(robot.lower, robot.upper, (64, robot.num_joints)), jnp.float32)
    poses = batch_link_poses(robot.chain, q)
    found = [
        choose_windows(splats, poses, jax.tree.map(lambda leaf: leaf[view], cameras))  # noqa: B023
        for view in range(len(cameras.focal))
    ]
    if any(windows is None for _, windows in found):
        return splats, None
    return max(found, key=lambda pair: pair[1].px if pair[1] is not None else 0)


_plant = jax.jit(plant, static_argnums=5)


def _visual_stop(config: PlannerConfig, goal_loss: float):
    return make_stop(
        goal_loss,
        settle=config.settle,
        max_iterations=config.max_iterations,
        patience=config.patience,
        min_improvement=config.min_improvement,
        min_ratio=config.min_ratio,
    )


def _finish_visual(
    robot: Robot,
    world: World,
    found: SearchResult,
    goal_loss: float,
    q_start: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
) -> PlanResult:
    """Choose where to end, and connect it to the start if its tree is not the start's."""
    score, q = np.asarray(found.tree.score), np.asarray(found.tree.q)
    if score.min() > goal_loss:  # nothing matches: the best that a path leads to
        score = np.where(np.asarray(found.tree.cost) < trees.UNREACHED, score, np.inf)
    for best in _hypotheses(world, score, q, q_start, goal_loss):
        path = tree_path(found.tree, best)
        if np.array_equal(path[0], q_start) or score[best] > goal_loss:
            break
        connection = _connect(world, q_start, q[best], key, config)
        path = connection_path(connection.tree)
        found = dataclasses.replace(
            found,
            compile_s=found.compile_s + connection.compile_s,
            search_s=found.search_s + connection.search_s,
        )
        if path is not None:
            break
    else:
        best, path = int(np.argmin(score)), None
    target, loss = q[best], float(score[best])
    return _finish(robot, world, found, path, target, loss, goal_loss, key, config, q_start)


def _hypotheses(
    world: World, score: np.ndarray, q: np.ndarray, q_start: np.ndarray, goal_loss: float
) -> Iterator[int]:
    """Nodes to end at: as good as the best, nearest to the start first; then other matches."""
    wraps = np.asarray(world.wraps)

    def apart(nodes: np.ndarray, q_other: np.ndarray) -> np.ndarray:
        step = q[nodes] - q_other
        return np.linalg.norm(step - 2 * np.pi * np.round(step / (2 * np.pi)) * wraps, axis=1)

    open_nodes = np.flatnonzero(score <= max(goal_loss, score.min()))
    for _ in range(HYPOTHESES):
        if len(open_nodes) == 0:
            return
        # Nodes just under the bar would be nearer still, but only as they are not there yet.
        equal = open_nodes[score[open_nodes] <= SAME_LOSS * score[open_nodes].min()]
        best = int(equal[np.argmin(apart(equal, q_start))])
        yield best
        open_nodes = open_nodes[apart(open_nodes, q[best]) > DISTINCT]


def _connect(
    world: World, q_start: np.ndarray, q_goal: np.ndarray, key: jax.Array, config: PlannerConfig
) -> SearchResult:
    policy = RRTConnect(lanes=config.lanes)
    tree = policy.forest(jnp.asarray(q_start), jnp.asarray(q_goal), config.capacity)
    stop = make_stop(0.0, max_iterations=config.connect_iterations)
    return search(world, policy, tree, key=key, stop=stop, time_limit_s=config.time_limit_s)


def _finish(
    robot: Robot,
    world: World,
    found: SearchResult,
    raw_path: np.ndarray | None,
    target: np.ndarray,
    loss: float,
    goal_loss: float,
    key: jax.Array,
    config: PlannerConfig,
    q_start: np.ndarray,
) -> PlanResult:
    """Shorten and verify; if the shortened path fails the exact check, fall back on the raw one.

    Without a path the result is the start alone.
    """
    has_path = raw_path is not None
    raw_path = q_start[None] if raw_path is None else raw_path
    _, shortcut_compile_s = _timed(shortcut, world, raw_path, key=key, rounds=0)
    started = time.perf_counter()
    path = shortcut(world, raw_path, key=key, rounds=config.shortcut_rounds)
    shortcut_s = time.perf_counter() - started

    started = time.perf_counter()
    obstacles = obstacle_list(world)
    verification = verify_path(robot, obstacles, path, step=config.verify_step)
    if not verification.ok:
        raw = verify_path(robot, obstacles, raw_path, step=config.verify_step)
        if raw.ok:
            path, verification = raw_path, raw
    verify_s = time.perf_counter() - started

    if not has_path:
        status = Status.NO_PATH
    elif loss > goal_loss:
        status = STATUS_OF.get(found.stopped, Status.NO_MATCH)
    else:
        status = Status.SOLVED if verification.ok else Status.NOT_VERIFIED
    rejected = np.asarray(found.tree.rejected)
    return PlanResult(
        status=status,
        path=path,
        raw_path=raw_path,
        target=target,
        loss=loss,
        goal_loss=goal_loss,
        cost=path_length(world, path),
        verification=verification,
        rejected={reason.name.lower(): int(rejected[reason]) for reason in Rejection},
        iterations=int(found.tree.iteration),
        timing={
            "compile_s": found.compile_s + shortcut_compile_s,
            "search_s": found.search_s,
            "shortcut_s": shortcut_s,
            "verify_s": verify_s,
        },
        history=found.history,
        tree=found.tree,
    )


def _timed(function: Callable, *args: Any, **kwargs: Any) -> tuple[Any, float]:
    """The result, and the seconds it took; of a first call, most of them are compilation."""
    started = time.perf_counter()
    result = jax.block_until_ready(function(*args, **kwargs))
    return result, time.perf_counter() - started


def _stack(items: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)
