"""Planners of OMPL on the same problems: the same collision spheres, the same exact check.

OMPL's wheel has no robots. Its states are checked here by C MuJoCo, with the robot's spheres.
"""

import copy
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from vrrt_jax.bench.arm_trials import Trial
from vrrt_jax.core.peers import load_ompl, ompl_version
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.verify import verify_path

RESOLUTION = 1 / 32  # [rad] between two checks of an edge
RANGE = 1.0  # [rad] longest edge of RRTConnect
# Seconds that each planner has. RRTConnect ends with its first path, which is then simplified; the
# others improve theirs until the time is up.
PEERS = {"RRTConnect": 10.0, "AORRTC": 1.0, "BITstar": 1.0}


def settings() -> dict[str, Any]:
    """What the peers' numbers depend on.

    Raises:
        ModuleNotFoundError: OMPL is not installed; the message says how.
    """
    return {
        "ompl": ompl_version(),
        "resolution_rad": RESOLUTION,
        "range_rad": RANGE,
        "time_limit_s": PEERS,
    }


def solve(robot: Robot, trial: Trial, *, name: str, seed: int) -> dict[str, Any]:
    """Plan once with a planner of OMPL, and check its path exactly.

    Joints that turn forever have bounds of a half turn either way here.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        trial: what to plan.
        name: one of :data:`PEERS`.
        seed: of OMPL, for the whole process: only the first one counts.

    Returns:
        A row as that of :func:`vrrt_jax.bench.arm_trials.solve`. ``solved`` means that the exact
        check found the path free; ``found``, that OMPL has one. ``raw_cost`` is that before it was
        simplified. The exact check is no part of the times.
    """
    ompl = load_ompl(seed)
    setup = _setup(robot, trial, ompl)
    own = setup.getSpaceInformation()
    peer = getattr(ompl.geometric, name)(own)
    if name == "RRTConnect":
        peer.setRange(RANGE)
    setup.setPlanner(peer)
    started = time.perf_counter()
    setup.solve(PEERS[name])
    searched_s = time.perf_counter() - started
    stages = {"search": searched_s, "shortcut": 0.0}
    found = setup.haveExactSolutionPath()
    verified, cost, raw_cost, status = False, None, None, "no path"
    if found:
        raw_cost = setup.getSolutionPath().length()
        if name == "RRTConnect":
            started = time.perf_counter()
            setup.simplifySolution()
            stages["shortcut"] = time.perf_counter() - started
        cost = setup.getSolutionPath().length()
        states = setup.getSolutionPath().getStates()
        path = np.array([state[0 : robot.num_joints] for state in states])
        checked = verify_path(robot, trial.world, path)
        verified = checked.ok
        status = "solved" if verified else f"not verified: {checked.contact}"
    return {
        "index": trial.index,
        "status": status,
        "solved": verified,
        "found": found,
        "refused_paths": int(found and not verified),
        "wall_ms": 1e3 * sum(stages.values()),
        "stages_ms": {stage: 1e3 * seconds for stage, seconds in stages.items()},
        "raw_cost": raw_cost if verified else None,
        "cost": cost if verified else None,
    }


def _setup(robot: Robot, trial: Trial, ompl: Any) -> Any:
    """Space, checker, start and goal, for any planner."""
    space = ompl.base.RealVectorStateSpace(robot.num_joints)
    bounds = ompl.base.RealVectorBounds(robot.num_joints)
    for j, (low, high) in enumerate(zip(robot.lower, robot.upper, strict=True)):
        bounds.setLow(j, float(low))
        bounds.setHigh(j, float(high))
    space.setBounds(bounds)
    setup = ompl.geometric.SimpleSetup(space)
    setup.setStateValidityChecker(_checker(robot, trial))
    own = setup.getSpaceInformation()
    own.setStateValidityCheckingResolution(RESOLUTION / space.getMaximumExtent())
    ends = []
    for q in (trial.q_start, trial.q_goal):
        state = space.allocState()
        # An end on a limit is beyond it by a rounding error, which OMPL would refuse.
        state[0 : robot.num_joints] = np.clip(q, robot.lower, robot.upper).tolist()
        ends.append(state)
    setup.setStartAndGoalStates(*ends)
    return setup


def _checker(robot: Robot, trial: Trial) -> Callable[[Any], bool]:
    """Whether the robot's spheres and what it holds are free at a state, by C MuJoCo."""
    scene = exact_scene(robot, trial.world, geometry="spheres")
    # A model of its own, where only what touches is a contact.
    model = copy.copy(scene.model)
    model.geom_margin[:] = model.pair_margin[:] = 0.0
    data, num_joints = mujoco.MjData(model), robot.num_joints

    def is_free(state: Any) -> bool:
        data.qpos[:] = state[0:num_joints]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        # A held object may touch its support: the scene knows how deep.
        return data.ncon == 0 or bool(scene.attached and not scene.touching(data.qpos))

    return is_free
