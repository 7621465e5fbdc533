"""The planners of homes by name."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from nrp_jax.config import EDGE_STEPS, PlannerConfig
from nrp_jax.generators import CVAESampler
from nrp_jax.learning.models import FIRE, GLOBAL_CVAE, NEXT
from nrp_jax.planners.cvae import CVAERRT, CVAEInformedRRTStar
from nrp_jax.planners.floor_ways import floor_ways
from nrp_jax.planners.next_planner import NEXTPlanner
from nrp_jax.planners.nrp import NeuralRRT
from nrp_jax.planners.nrp_connect import NRPConnect, packaged_sampler
from nrp_jax.planners.nrp_star import NeuralRRTStar
from nrp_jax.retrieval import UNIFORM_SHARE
from nrp_jax.samplers import DiscriminatorSampler, check_fits, load_sampler, packaged_file
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.planners import RRT, BITStar, InformedRRTStar, RRTConnect, RRTStar
from vrrt_jax.core.types import ExpansionPolicy

RESTARTS, QUICK = "nrp-star-connect", "nrp-star-quick"
CONNECT = ("nrp-connect", RESTARTS, QUICK)
DECOMPOSED = "decomposed"
# NRP that asks the floor what is near; those of the second pair improve their paths.
BY_FLOOR = ("nrp-d-floor", "nrp-g-floor")
STAR_BY_FLOOR = ("nrp-star-d-floor", "nrp-star-g-floor")
# Those of the last two rows go on to improve their paths until the budget ends.
PLANNERS = (
    *("rrt", "rrt-is", "rrt-connect", "cvae-rrt", "fire", "nrp-d", "nrp-g", *BY_FLOOR),
    "nrp-connect",
    *("rrt-star", "irrt-star", "bit-star", "cvae-irrt-star", "next"),
    *("nrp-star-d", "nrp-star-g", *STAR_BY_FLOOR, RESTARTS, QUICK, "fire-star", DECOMPOSED),
)
FETCH_ONLY = ("fire", "fire-star", QUICK, DECOMPOSED)  # of a base that drives
# Of the samplers that planners need.
KINDS = {
    "cvae-rrt": GLOBAL_CVAE,
    "cvae-irrt-star": GLOBAL_CVAE,
    "next": NEXT,
    "fire": FIRE,
    "fire-star": FIRE,
    **dict.fromkeys(("nrp-d", "nrp-d-floor", "nrp-star-d", "nrp-star-d-floor"), "discriminator"),
    **dict.fromkeys(("nrp-g", "nrp-g-floor", "nrp-star-g", "nrp-star-g-floor"), "cvae"),
    **dict.fromkeys(CONNECT, "cvae"),
}
# How trees are rewired: by edges as long as those that they grow by.
REWIRING = {
    "rewire_radius": np.float32(np.inf),
    "rewire_steps": EDGE_STEPS,
    "neighbors": 24,  # by the formula of k-RRT* in eight dimensions, of 2,600 nodes
    "tries": 4,
    "ancestors": 4,
    "shortcuts": 1,
}
# As published. Its nodes have what the guide says of them, which shortcuts would have to ask for.
NEXT_REWIRING = {**REWIRING, "rewire_radius": np.float32(2.0), "shortcuts": 0}


def planners_of(task: str) -> tuple[str, ...]:
    """The names of all planners that a robot has."""
    return tuple(name for name in PLANNERS if task == "fetch" or name not in FETCH_ONLY)


def check_names(task: str, text: str | None) -> tuple[str, ...]:
    """The planners in a text such as "rrt,bit-star", each once.

    If there is none, all of a robot's that need no weights, or whose weights are packaged.

    Raises:
        ValueError: the robot has no such planner.
    """
    known = planners_of(task)
    ready = [n for n in known if n not in KINDS or packaged_file(task, KINDS[n]).is_file()]
    names = tuple(dict.fromkeys(text.split(","))) if text else tuple(ready)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"unknown planner '{unknown[0]}'; have: {', '.join(known)}")
    return names


def policy_of(
    planner: str | ExpansionPolicy,
    robot: MobileRobot,
    world: GridWorld,
    sampler: Any,
    config: PlannerConfig,
    ends: tuple[Any, Any],
) -> ExpansionPolicy:
    """The policy of a planner by name, or the object itself.

    Args:
        planner: one of :data:`PLANNERS`, or a policy.
        robot: to plan for.
        world: the robot in a home.
        sampler: of the planners that have one; the packaged one if None.
        config: settings.
        ends: start and goal (D,) in the world, for samplers that retrieve.

    Raises:
        ValueError: the sampler does not fit, or the planner is for another robot.
    """
    if not isinstance(planner, str):
        return planner
    if planner not in planners_of(robot.name):
        names = ", ".join(planners_of(robot.name))
        raise ValueError(f"planner '{planner}' is for the fetch; '{robot.name}' has: {names}")
    if planner == "rrt-connect":
        return RRTConnect(lanes=max(config.lanes, 2))
    bias = jnp.float32(config.goal_bias)
    shape = {"keep_partial": True, "lanes": config.lanes, "edge_steps": EDGE_STEPS}
    if planner in ("rrt", "rrt-is"):
        return RRT(goal_bias=bias, intermediate=planner == "rrt-is", **shape)
    if planner == "bit-star":
        return BITStar(lanes=config.lanes, edge_steps=EDGE_STEPS)
    if planner in ("rrt-star", "irrt-star", DECOMPOSED):
        make = RRTStar if planner == "rrt-star" else InformedRRTStar
        early = planner != DECOMPOSED  # whose three legs all lack a path until the last has one
        return make(goal_bias=bias, rewires_early=early, **shape, **REWIRING)
    # The others have learned samplers.
    if sampler is None:
        packaged = planner in CONNECT
        sampler = (
            packaged_sampler(robot.name) if packaged else load_sampler(robot.name, KINDS[planner])
        )
    check_fits(sampler, robot, world, KINDS[planner])
    if KINDS[planner] in (GLOBAL_CVAE, FIRE):
        share = config.uniform_share
        if KINDS[planner] == FIRE:
            share = UNIFORM_SHARE
            sampler = sampler.retrieve(world, *ends)
        drawn = {"goal_bias": bias, "sampler": sampler, **shape}
        drawn["uniform_share"] = jnp.float32(share)
        if planner in ("cvae-rrt", "fire"):
            return CVAERRT(**drawn)
        return CVAEInformedRRTStar(**drawn, **REWIRING)
    if planner == "next":
        guide = sampler.of_query(world, *ends)
        return NEXTPlanner(goal_bias=bias, guide=guide, **shape, **NEXT_REWIRING)
    if planner in CONNECT:
        return NRPConnect(sampler=sampler, lanes=max(config.lanes, 2))
    rate = jnp.float32(config.straight_rate)
    floor = floor_ways(robot, world) if planner in BY_FLOOR + STAR_BY_FLOOR else None
    if floor is not None and isinstance(sampler, DiscriminatorSampler | CVAESampler):
        sampler = dataclasses.replace(sampler, floor=floor)
    learned = {"goal_bias": bias, "sampler": sampler, "straight_rate": rate, "floor": floor}
    if planner.startswith("nrp-star"):
        return NeuralRRTStar(**learned, **shape, **REWIRING)
    return NeuralRRT(**learned, **shape)
