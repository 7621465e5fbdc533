"""Pose goals: inverse kinematics from many places at once, then one search to all that are free."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax import checks
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.core.fields import check_loaded
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import PlanResult, Status
from vrrt_jax.core.rigid import rigid
from vrrt_jax.core.search import no_search
from vrrt_jax.joint import plan_to_goal
from vrrt_jax.outcome import Chosen, Progress, finish
from vrrt_jax.robots.bodies import moving_body
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.verify import contacts
from vrrt_jax.scene.world import World, batch_is_free, rooms
from vrrt_jax.visual.distinct import distances_to, distinct

REACHED_M = 1e-4  # a link this near to its pose is there
REACHED_RAD = 1e-3
GOALS = 8  # solutions that one search is made to
SEEDS = 64  # configurations that descend at a time
ROUNDS = 4  # of so many seeds, until one ends at the pose and is free
STEPS = 40  # of Levenberg and Marquardt, at most
ARM_M = 0.3  # a turn of 1 rad counts like this way: the reach of a hand
_MAX_STEP = 0.5  # [rad] or [m] of a joint


class Unreached(ValueError):
    """No free configuration takes the link to the pose."""

    def __init__(self, message: str, nearest: np.ndarray):
        """Remember the configuration (D,) that comes nearest."""
        super().__init__(message)
        self.nearest = nearest


@single_precision
def inverse_kinematics(
    robot: Robot,
    world: World,
    pose: np.ndarray,
    link: str | None = None,
    *,
    key: jax.Array,
    q_near: np.ndarray | None = None,
    num: int = GOALS,
) -> np.ndarray:
    """Free configurations that take a link to a pose, those near a configuration first.

    Levenberg-Marquardt from many places at once, inside the limits.

    Args:
        robot: from :func:`load_robot`.
        world: for this robot.
        pose: (4, 4) of the link in the world's frame [m].
        link: a moving body of the robot, such as "hand"; the last of ``robot.link_names`` if None.
        key: random key.
        q_near: (D,) where to begin and what to stay near; the robot's home if None.
        num: at most so many, which differ by more than 0.3 rad.

    Returns:
        (n, D), with 0.1 mm and 1 mrad to the pose at most.

    Raises:
        ValueError: an input makes no sense.
        Unreached: there is none; a ValueError that says how near the link gets, or that all are in
            collision.
    """
    if not (isinstance(num, int | np.integer) and num >= 1):
        raise ValueError(f"num is {num!r}; expected a whole number, at least 1")
    return _solutions(robot, (world,), pose, link, key, q_near, num)


def _solutions(
    robot: Robot,
    wary: Sequence[World],
    pose: np.ndarray,
    link: str | None,
    key: jax.Array,
    q_near: np.ndarray | None,
    num: int,
) -> np.ndarray:
    """See :func:`inverse_kinematics`; of a round's solutions those free in the first of the worlds.

    If there are none, those free in the second, and so on.

    Args:
        robot: whose kinematics it is.
        wary: worlds that differ in their margins, the most wanted first.
        pose: (4, 4) [m].
        link: a moving body, or None.
        key: random key.
        q_near: (D,) or None.
        num: at most so many.
    """
    check_loaded(robot, "the robot", "vrrt_jax.load_robot")
    check_loaded(wary[0], "the world", "vrrt_jax.build_world or vrrt_jax.load_world")
    link = robot.link_names[-1] if link is None else link
    index, in_link = moving_body(robot, link)
    target = jnp.asarray(rigid(pose, "the pose") @ np.linalg.inv(in_link), jnp.float32)
    q_near = robot.home if q_near is None else checks.check_limits(robot, q_near, "q_near")
    nearest, least = q_near, np.inf
    reached = 0
    for k in range(ROUNDS):
        places = _places(wary[0], jnp.asarray(q_near), jax.random.fold_in(key, k), k == 0)
        q, meters, radians = (
            np.asarray(a) for a in _descend(wary[0], target, jnp.int32(index), places)
        )
        there = (meters <= REACHED_M) & (radians <= REACHED_RAD)
        reached += int(np.sum(there))
        for room in wary:
            rows = np.flatnonzero(there & np.asarray(batch_is_free(room, q)))
            if len(rows):
                rows = rows[np.argsort(distances_to(room, q[rows], q_near), kind="stable")]
                return q[distinct(room, q, rows, num)]
        away = meters + ARM_M * radians + 1e3 * ~there * np.any(there)
        if np.min(away) < least:
            nearest, least = q[np.argmin(away)], np.min(away)
            missed = f"{meters[np.argmin(away)]:.3g} m and {radians[np.argmin(away)]:.3g} rad"
    if not reached:
        told = f"'{link}' stays {missed} from the pose; move it to where the arm reaches"
        raise Unreached(told, nearest)
    touching = contacts(robot, wary[-1], nearest) or contacts(
        robot, wary[-1], nearest, geometry="polytopes"
    )
    raise Unreached(
        f"all {reached} configurations that take '{link}' there are in collision, one of them: "
        f"{'; '.join(touching[:4]) or 'within the margin'}; move the obstacles or the pose",
        nearest,
    )


@single_precision
def plan_to_pose(
    robot: Robot,
    world: World,
    q_start: np.ndarray,
    pose: np.ndarray,
    link: str | None = None,
    *,
    key: jax.Array,
    config: PlannerConfig | None = None,
    on_progress: Progress = None,
) -> PlanResult:
    """Find a collision-free path to where a link has a pose.

    :func:`inverse_kinematics` proposes up to 8 configurations, and RRT-Connect searches for a path
    to any of them.

    Args:
        robot: from :func:`load_robot`.
        world: for this robot.
        q_start: (D,) [rad] or [m].
        pose: (4, 4) of the link in the world's frame [m].
        link: a moving body of the robot, such as "hand"; the last of ``robot.link_names`` if None.
        key: random key.
        config: budget, capacity, lanes and margin are used.
        on_progress: called with the search state and the seconds so far.

    Returns:
        A result whose ``target`` is the configuration that the path ends at. The status is NO_MATCH
        where no free configuration has the pose; ``advice`` says why.

    Raises:
        ValueError: an input makes no sense; the message says what to do.
    """
    config = PlannerConfig() if config is None else config
    q_start = checks.check_start(robot, world, q_start)
    policy = RRTConnect.for_world(world, lanes=config.tree.lanes)
    key_goals, key = jax.random.split(key)
    # Goals with room around them are better, if there are any.
    wary = rooms(world, q_start[None], config.path.margin)
    try:
        goals = _solutions(robot, wary, pose, link, key_goals, q_start, GOALS)
    except Unreached as error:
        goal = ConfigurationGoal(q=jnp.asarray(q_start))
        tree = policy.init(world, goal, q_start[None], config.tree.capacity)
        chosen = Chosen(path=None, target=error.nearest, loss=np.inf, threshold=1.0)
        found = no_search(policy, goal, tree)
        result = finish(robot, world, found, chosen, q_start, key, config)
        return dataclasses.replace(result, status=Status.NO_MATCH, advice=str(error))
    # As many every time, so that nothing compiles anew: the rest repeat the nearest.
    goals = np.concatenate([goals, np.repeat(goals[:1], GOALS - len(goals), axis=0)])
    goal = ConfigurationGoal(q=jnp.asarray(goals))
    return plan_to_goal(robot, world, goal, policy, q_start, key, config, on_progress)


def _places(world: World, q_near: jax.Array, key: jax.Array, with_near: bool) -> jax.Array:
    """Where to begin (S, D): a configuration, places around it, and any."""
    key_near, key_far = jax.random.split(key)
    shape = (SEEDS, len(q_near))
    around = q_near + 0.5 * jax.random.normal(key_near, shape)
    around = jnp.where(jnp.arange(SEEDS)[:, None] == 0, q_near, around) if with_near else around
    anywhere = jax.random.uniform(key_far, shape, minval=world.lower, maxval=world.upper)
    return jnp.where(jnp.arange(SEEDS)[:, None] < SEEDS // 4, around, anywhere)


@host_jit
def _descend(
    world: World, pose: jax.Array, link: jax.Array, q: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Levenberg-Marquardt from (S, D): ends, and their errors [m] and [rad]."""

    def residual(q: jax.Array) -> jax.Array:
        # Matrices in place of angles: no turn is singular.
        off = link_poses(world.chain, q)[link] - pose
        return jnp.concatenate([off[:3, 3], ARM_M / jnp.sqrt(2.0) * off[:3, :3].reshape(-1)])

    def errors(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        off = jax.vmap(residual)(q)
        turned = jnp.linalg.norm(off[:, 3:], axis=1) / ARM_M  # 2 sin(angle / 2)
        return jnp.linalg.norm(off[:, :3], axis=1), 2 * jnp.arcsin(jnp.minimum(turned / 2, 1.0))

    def goes_on(state) -> jax.Array:
        step, q, _ = state
        meters, radians = errors(q)
        # A part of the seeds ends in places that have no way on: nobody waits for these.
        there = (meters <= REACHED_M / 4) & (radians <= REACHED_RAD / 4)
        return (step < STEPS) & (jnp.sum(there) < 3 * len(q) // 4)

    def descend(state):
        step, q, damping = state
        off, slope = jax.vmap(residual)(q), jax.vmap(jax.jacfwd(residual))(q)
        matrix = jnp.einsum("nri,nrj->nij", slope, slope)
        ridge = damping[:, None, None] * jnp.eye(q.shape[1])
        change = -jnp.linalg.solve(matrix + ridge, jnp.einsum("nri,nr->ni", slope, off)[..., None])
        change = jnp.clip(change[..., 0], -_MAX_STEP, _MAX_STEP)
        tried = jax.vmap(lambda q: enforce_bounds(world, q))(q + change)
        better = jnp.sum(jax.vmap(residual)(tried) ** 2, axis=1) < jnp.sum(off**2, axis=1)
        damping = jnp.clip(damping * jnp.where(better, 0.2, 5.0), 1e-7, 1e2)
        return step + 1, jnp.where(better[:, None], tried, q), damping

    damping = jnp.full(len(q), 1e-3)
    q = jax.lax.while_loop(goes_on, descend, (jnp.int32(0), q, damping))[1]
    return q, *errors(q)
