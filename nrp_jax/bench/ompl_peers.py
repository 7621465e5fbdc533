"""Planners of OMPL on the same queries: the same checks of edges, the same exact check.

A state of OMPL is the base beside the arm, in the planners' own metric: the way of the base, for
the Fetch along Reeds-Shepp curves, plus the weighted way of the arm. Joints that turn for ever are
intervals here. OMPL asks for one edge at a time. It is checked in one compiled call, twice as
finely as the planners do, as nothing is planned again where the exact check refuses a path; that
call, from Python, is most of a peer's time.
"""

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.scene.exact import ExactScene, verify
from nrp_jax.scene.nearest import shifted, working_world
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.trajectory import with_waypoints
from nrp_jax.scene.world import TURNING_RADIUS, GridWorld, batch_is_free
from vrrt_jax.core.peers import load_ompl
from vrrt_jax.core.postprocess import CheckedPath, postprocess
from vrrt_jax.core.shortcut import path_length

PEERS = ("RRTConnect", "AORRTC", "BITstar", "InformedRRTstar")  # the first ends with its first path
RANGE = 1.0  # [m] longest edge of those that have one; OMPL's own, a fifth of the space, is blocked
_BLOCK = 32  # configurations of an edge that are checked together


def solve(
    robot: MobileRobot,
    world: GridWorld,
    scene: ExactScene,
    q_start: np.ndarray,
    q_goal: np.ndarray,
    *,
    name: str,
    budget_s: float,
    key: jax.Array,
) -> dict[str, Any]:
    """Plan once with a planner of OMPL, and check its path exactly.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        world: the robot in a home.
        scene: of both.
        q_start: (D,) free configuration [m] and [rad].
        q_goal: (D,) free configuration.
        name: one of :data:`PEERS`.
        budget_s: of the search [s].
        key: of the shortcuts; OMPL goes on with its own random numbers in each process.

    Returns:
        What :func:`nrp_jax.bench.curve_rows.run_item` tells of a planner; an expansion is an edge
        that was checked.
    """
    ompl = load_ompl(0)
    # Arms do not turn for ever here: their joints begin within half a turn.
    world, corner = working_world(world)
    ends = [shifted(q, -corner).astype(np.float32) for q in (q_start, q_goal)]
    ends = [np.asarray(world.normalize(jnp.asarray(q)), float) for q in ends]
    is_base = np.arange(robot.num_joints) < robot.base_dim
    world = dataclasses.replace(
        world, is_continuous=world.is_continuous & is_base, resolution=world.resolution / 2
    )
    setup, planner, log = _setup(ompl, robot, world, ends, name)
    log.begin(planner)
    setup.solve(ompl.base.timedPlannerTerminationCondition(budget_s))
    searched_s = log.seconds()
    # The search and its validator hold each other, and are never freed unless they are parted.
    setup.getSpaceInformation().setMotionValidator(_idle_validator())
    row = {
        "solved": False,
        "status": "TIME_LIMIT",
        "cost": None,
        "search_s": round(searched_s, 4),
        "expansions": log.edges,
        "checks": log.checks,
        "refused": 0,
    }
    if setup.haveExactSolutionPath():
        states = setup.getSolutionPath().getStates()
        raw = np.array([_numbers(robot, state) for state in states], np.float32)
        log.note(path_length(world, raw), searched_s)
        done = postprocess(world, raw, functools.partial(_checked, world, scene, corner), key=key)
        row |= {"status": "NOT_VERIFIED", "refused": done.refused}
        if done.is_verified:
            cost = round(float(path_length(world, done.checked.path)), 4)
            row |= {"solved": True, "status": "SOLVED", "cost": cost}
    return row | {"steps": np.round(np.reshape(log.steps, (-1, 4)), 4).tolist()}


@functools.cache
def _idle_validator() -> Any:
    """A validator of edges that nothing asks."""
    base = load_ompl(0).base
    return base.ReedsSheppMotionValidator(base.SpaceInformation(base.ReedsSheppStateSpace(1.0)))


class _Log:
    """What a planner has done so far; its best path is looked for after each edge."""

    def __init__(self):
        self.edges = self.checks = 0
        self.steps: list[tuple[float, int, int, float]] = []
        self._best, self._planner, self._started = np.inf, None, 0.0

    def begin(self, planner: Any) -> None:
        """Start the clock; a planner that tells no cost ends with its first path."""
        self.edges = self.checks = 0
        self._planner = planner if hasattr(planner, "bestCost") else None
        self._started = time.perf_counter()

    def seconds(self) -> float:
        """Since the clock was started."""
        return time.perf_counter() - self._started

    def count(self, edges: int, checks: int) -> None:
        """Add edges and configurations that were checked."""
        self.edges, self.checks = self.edges + edges, self.checks + checks
        if self._planner is not None:
            self.note(self._planner.bestCost().value(), self.seconds())

    def note(self, cost: float, seconds: float) -> None:
        """A path of this cost; kept if it is shorter than all before."""
        if cost < self._best - 1e-6:
            self._best = cost
            self.steps.append((seconds, self.edges, self.checks, float(cost)))


def _setup(
    ompl: Any, robot: MobileRobot, world: GridWorld, ends: list[np.ndarray], name: str
) -> tuple[Any, Any, _Log]:
    """Space, checks, start, goal and planner; all programs are compiled by then."""
    base, dim = ompl.base, robot.base_dim
    log = _Log()
    # The base beside the arm, in the metric of the world.
    place = (
        base.RealVectorStateSpace(2)
        if dim == 2
        else base.ReedsSheppStateSpace(float(getattr(world, "radius", TURNING_RADIUS)))
    )
    arm = base.RealVectorStateSpace(robot.num_joints - dim)
    lower, upper = (np.asarray(limits, float) for limits in (world.lower, world.upper))
    for part, joints in ((place, slice(2)), (arm, slice(dim, None))):
        bounds = base.RealVectorBounds(len(lower[joints]))
        for j, (low, high) in enumerate(zip(lower[joints], upper[joints], strict=True)):
            bounds.setLow(j, low)
            bounds.setHigh(j, high)
        part.setBounds(bounds)
    space = base.CompoundStateSpace()
    space.addSubspace(place, 1.0)
    space.addSubspace(arm, float(world.arm_weight))
    # Checks of states and edges, with the world's own.
    setup = ompl.geometric.SimpleSetup(space)
    own = setup.getSpaceInformation()

    def is_free(state: Any) -> bool:
        log.count(0, 1)
        return bool(batch_is_free(world, np.array([_numbers(robot, state)], np.float32))[0])

    class Edges(base.MotionValidator):
        def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802
            pair = np.array([_numbers(robot, s) for s in (first, second)], np.float32)
            free, checks = _check_edge(world, pair)
            log.count(1, int(checks))
            return bool(free)

    setup.setStateValidityChecker(is_free)
    own.setMotionValidator(Edges(own))
    own.setup()  # before states are made of numbers
    states = []
    for q in ends:
        state = space.allocState()
        # An end on a limit is beyond it by a rounding error, which OMPL would refuse.
        space.copyFromReals(state, np.clip(q, lower, upper).tolist())
        states.append(state)
    setup.setStartAndGoalStates(*states)
    # Informed samples of a compound space are those that OMPL rejects by their cost: a sum of one
    # objective has them, path length itself has not.
    objective = base.MultiOptimizationObjective(own)
    objective.addObjective(base.PathLengthOptimizationObjective(own), 1.0)
    objective.lock()
    setup.setOptimizationObjective(objective)
    planner = getattr(ompl.geometric, name)(own)
    if hasattr(planner, "setRange"):
        planner.setRange(RANGE)
    setup.setPlanner(planner)
    setup.setup()
    is_free(states[0])
    own.checkMotion(*states)
    return setup, planner, log


def _numbers(robot: MobileRobot, state: Any) -> list[float]:
    """The configuration (D,) of a state."""
    place, arm = state[0], state[1]
    first = place[0:2] if robot.base_dim == 2 else (place.getX(), place.getY(), place.getYaw())
    return [*first, *arm[0 : robot.num_joints - robot.base_dim]]


@jax.jit
def _check_edge(world: GridWorld, pair: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whether the edge between a pair (2, D) is free, () bool; and how many checks that took."""
    edge = world.edge(pair[0], pair[1])
    num = jnp.maximum(jnp.ceil(world.span(edge) / world.resolution), 1.0)

    def check(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        fraction = jnp.minimum((state[0] + jnp.arange(1.0, _BLOCK + 1)) / num, 1.0)
        q = jax.vmap(lambda part: world.end(pair[0], world.truncate(edge, part)))(fraction)
        return state[0] + _BLOCK, jnp.all(jax.vmap(world.is_free)(q))

    first = (jnp.float32(0.0), jnp.bool_(True))
    done, free = jax.lax.while_loop(lambda s: (s[0] < num) & s[1], check, first)
    return free, jnp.minimum(done, num)


def _checked(
    world: GridWorld, scene: ExactScene, corner: np.ndarray, path: np.ndarray
) -> CheckedPath:
    """A path (P, D) of the planners' own world, checked exactly in the map."""
    trajectory, _ = with_waypoints(world, path)
    lower, upper = (shifted(np.asarray(limits), corner) for limits in (world.lower, world.upper))
    verdict = verify(scene, shifted(trajectory, corner), lower=lower, upper=upper)
    return CheckedPath(path=path, trajectory=trajectory, verification=verdict)
