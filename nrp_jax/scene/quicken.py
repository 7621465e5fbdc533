"""Quicken a path: the same way for the arm and nearly the same for the base, in less time.

A planner's paths are short, and their turns are on the smallest circle: at each the base all but
stops. Here parts of a path are replaced by wider turns at random, and what takes less time and
touches nothing is kept, as shortcuts are (Hauser and Ng-Thow-Hing 2010 do so for arms).
"""

import dataclasses

import jax
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene.car_world import CarWorld
from nrp_jax.scene.exact import ExactScene, verify
from nrp_jax.scene.execution_time import rough_time, time_along
from nrp_jax.scene.nearest import shifted, working_world
from nrp_jax.scene.odometry import configurations_along, odometry, poses_along
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.wide_turns import propose
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world
from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.result import PlanResult, Verification
from vrrt_jax.core.shortcut import padded

PROPOSALS = 20_000
FEW_PROPOSALS = 3000  # to compare paths by
PATIENCE = 5000  # it ends after so many proposals in a row that hardly pay
_GAIN_S = 0.02  # smallest gain worth a change
_PAYS = 2e-3  # share of the time; changes that gain less count as idle


@dataclasses.dataclass(frozen=True, kw_only=True)
class QuickPath:
    """A path that takes less time. Letters: ``n`` corners, ``T`` configurations, ``D`` joints."""

    corners: np.ndarray  # (n, D - 1) as :func:`nrp_jax.scene.odometry.odometry` tells them
    trajectory: np.ndarray  # (T, D) configurations, 0.02 m or rad apart at most
    verification: Verification  # of the trajectory
    duration_s: float  # from rest to rest, see :func:`nrp_jax.scene.execution_time.execution_time`
    planned_s: float  # the same of the path that was given


def quicken(
    robot: MobileRobot,
    grid: Grid,
    path: np.ndarray | PlanResult,
    *,
    key: jax.Array,
    world: GridWorld | None = None,
    scene: ExactScene | None = None,
    proposals: int = PROPOSALS,
) -> QuickPath:
    """Give a robot whose base drives like a car a path that takes it less time.

    Where the base stands while the arm moves it still does so. The exact check has passed all that
    comes out. The path may be longer in the planner's metric.

    Args:
        robot: the Fetch.
        grid: the home.
        path: a solved plan, or (P, D) waypoints of one.
        key: random key.
        world: of this robot and grid, to save building it again.
        scene: the exact scene of this robot and grid, likewise.
        proposals: what may replace a part of the path, so many at most.

    Raises:
        ValueError: the robot's base does not drive like a car, the plan is not solved, or the path
            touches something.
    """
    world = build_world(robot, grid) if world is None else world
    if not isinstance(world, CarWorld):
        raise ValueError(f"'{robot.name}' has no base that drives; expected the fetch")
    if isinstance(path, PlanResult):
        if not path.ok:
            raise ValueError(f"the plan ended as {path.status.name}; expected a solved plan")
        path = path.path
    path, scene = np.asarray(path, float), scene or ExactScene(robot, grid)
    inner, corner = working_world(world)
    lower, upper = (shifted(np.asarray(limit), corner) for limit in (inner.lower, inner.upper))

    def check(q: np.ndarray) -> Verification:
        if overrides_is_free(world):  # which the exact check knows nothing of
            free = np.asarray(batch_is_free(inner, padded(shifted(q, -corner))))
            if not free.all():
                contact = f"refused by {type(world).__name__}.is_free"
                return Verification(ok=False, checked=len(q), contact=contact)
        return verify(scene, q, lower=lower, upper=upper)

    corners = odometry(world, path)
    kept = [_joined(np.diff(corners, axis=0))]
    if len(kept[0]):
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        kept += _quicker(path[0], kept[0], check, float(inner.radius), rng, proposals)
    # What was checked part by part is checked as a whole.
    for steps in reversed(kept):
        trajectory = configurations_along(path[0], steps)
        verification = check(trajectory)
        if verification.ok:
            break
    else:
        raise ValueError(
            f"the path is not free: {verification.contact}; expected that of a solved plan in this "
            "home"
        )
    found = np.concatenate([corners[:1], corners[0] + np.cumsum(steps, axis=0)])
    return QuickPath(
        corners=found,
        trajectory=trajectory,
        verification=verification,
        duration_s=time_along(found),
        planned_s=time_along(corners),
    )


def _quicker(q, steps, check, radius, rng, proposals) -> list[np.ndarray]:
    """Ever quicker steps (n, D - 1) from a configuration (D,), in the order they were found."""
    found, idle = [], 0
    poses, seconds = poses_along(q[:3], steps), rough_time(steps)
    for _ in range(proposals):
        idle += 1
        if idle > PATIENCE:
            break
        proposal = propose(steps, poses, radius, rng)
        if proposal is None:
            continue
        trial = _joined(proposal.steps)
        gain = seconds - rough_time(trial)
        if gain < _GAIN_S:
            continue
        # From the beginning of what is new to the end of the step that it changes behind it.
        begin = np.concatenate(
            [poses_along(q[:3], proposal.before)[-1], q[3:] + proposal.before[:, 2:].sum(axis=0)]
        )
        part = np.concatenate([proposal.new, proposal.after[:1]])
        if check(configurations_along(begin, part)).ok:
            if gain > _PAYS * seconds:
                idle = 0
            steps, seconds = trial, seconds - gain
            poses = poses_along(q[:3], steps)
            found.append(steps)
    return found


def _joined(steps: np.ndarray) -> np.ndarray:
    """Steps (n, D - 1) in one and the same direction as one, those of no length left out."""
    length = np.linalg.norm(steps, axis=1)
    steps = steps[length > 1e-6]
    if not len(steps):
        return steps
    direction = steps / length[length > 1e-6, None]
    begins = np.linalg.norm(np.diff(direction, axis=0), axis=1) > 1e-6
    return np.add.reduceat(steps, np.append(0, np.flatnonzero(begins) + 1))
