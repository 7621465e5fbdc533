"""NRP-Connect: two trees that grow towards each other, with learned waypoints where it is hard."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np

from nrp_jax.samplers import Sampler, check_fits, load_sampler, proposed
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.rrt_connect import ConnectNode, RRTConnect
from vrrt_jax.core.search import SearchResult, StopReason, Termination, search
from vrrt_jax.core.types import Proposals, Tree, pytree, static

# The trees check the edges to waypoints themselves, and keep the free parts of them: the sampler
# proposes one a lane, without a check.
UNCHECKED: dict[str, Any] = {"num_edge_checked": 1}


@pytree
class NRPConnect(RRTConnect):
    """RRT-Connect whose extending lanes go to proposed waypoints.

    Such a lane draws a sample as in RRT-Connect, and extends the nearest node v of its tree to the
    waypoint that the sampler proposes for v and the sample. A waypoint that is reached is driven
    towards the other tree in the next iteration, as any new node is. One call of the networks
    serves all these lanes.

    :func:`search_connect` begins with plain RRT-Connect, so that queries which straight edges solve
    never ask a network, nor compile one.
    """

    sampler: Any  # a pytree with ``propose(world, q_from, q_goal, key) -> (B, D)``
    straight_iterations: Any = 16  # () iterations of RRT-Connect before the networks are asked
    # Edges are short, so that few checks suffice for the world's resolution.
    edge_steps: int = static(default=32)

    def straight(self) -> RRTConnect:
        """RRT-Connect with the same edges and lanes; its trees are this planner's too."""
        return RRTConnect(margin=self.margin, lanes=self.lanes, edge_steps=self.edge_steps)

    def propose(
        self, world: GridWorld, goal: ConfigurationGoal, tree: Tree[ConnectNode], key: jax.Array
    ) -> Proposals:
        """As RRT-Connect does, but extend by way of waypoints."""
        key_straight, key_sampler = jax.random.split(key)
        proposals = super().propose(world, goal, tree, key_straight)
        # The first half of the lanes extends; the other half drives nodes to the other tree, or
        # extends straight on where no node is left to drive.
        half = self.lanes - self.lanes // 2
        q_from = tree.q[proposals.parent[:half]]
        waypoint, checked = proposed(
            self.sampler, world, q_from, proposals.target[:half], key_sampler
        )
        return dataclasses.replace(
            proposals, target=proposals.target.at[:half].set(waypoint), checked=checked
        )


def search_connect(
    world: GridWorld,
    goal: ConfigurationGoal,
    policy: NRPConnect,
    tree: Tree[ConnectNode],
    *,
    termination: Termination,
    time_limit_s: float,
    **options: Any,
) -> SearchResult:
    """Search by straight edges first, and go on with learned waypoints where that was not enough.

    Args:
        world: the robot in a home.
        goal: where to.
        policy: the planner.
        tree: from ``policy.init``.
        termination: when to end.
        time_limit_s: wall time of both searches without compilation [s].
        options: of :func:`vrrt_jax.core.search.search`.
    """
    limit = np.minimum(np.int32(policy.straight_iterations), termination.max_iterations)
    first = search(
        world,
        goal,
        policy.straight(),
        tree,
        termination=dataclasses.replace(termination, max_iterations=limit),
        time_limit_s=time_limit_s,
        **options,
    )
    if first.stopped is not StopReason.ITERATIONS or limit == termination.max_iterations:
        return first
    then = search(
        world,
        goal,
        policy,
        first.tree,
        termination=termination,
        time_limit_s=time_limit_s - first.search_s,
        **options,
    )
    # One search, whose clock goes on.
    later = then.history[1:] + first.search_s * (np.arange(then.history.shape[1]) == 1)
    return dataclasses.replace(
        then,
        history=np.concatenate([first.history, later]),
        compile_s=first.compile_s + then.compile_s,
        search_s=first.search_s + then.search_s,
    )


@functools.cache
def packaged_sampler(task: str) -> Sampler:
    """The packaged CVAE of a robot, for two trees; read once.

    Raises:
        ValueError: there is none for such a robot.
    """
    return load_sampler(task, "cvae", **UNCHECKED)


def default_planner(robot: MobileRobot, world: GridWorld) -> str:
    """Name "nrp-connect" where the packaged networks fit robot and map, else "rrt-connect"."""
    try:
        check_fits(packaged_sampler(robot.name), robot, world, "cvae")
    except ValueError:
        return "rrt-connect"
    return "nrp-connect"
