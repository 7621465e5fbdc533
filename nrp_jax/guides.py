"""NEXT's guides: where to go from a configuration, and how far the goal is from there.

A guide plans once for a query, outside of the search; the planner then asks it about many
configurations. Letters: ``n`` configurations, ``K`` candidates of each, ``D`` joints.
"""

from typing import Any

import jax
import jax.numpy as jnp

from nrp_jax.learning import features
from nrp_jax.learning.batches import describe
from nrp_jax.learning.checkpoint import build_module
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.network_inputs import network_inputs
from nrp_jax.learning.next_network import PlanningNetwork
from nrp_jax.scene.robots import MobileRobot, batch_link_features
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import pytree, static


@pytree
class QueryGuide:
    """NEXT's network, told a map and a goal."""

    robot: MobileRobot
    variables: Any  # weights, flax variables
    plan: jax.Array  # (1, W, A, G) on the small map
    goal: jax.Array  # (1, E) features
    center: jax.Array  # (2,) origin of the network's frame in the map [m]
    sigma: Any  # () standard deviation of steps around the network's [m] and [rad]
    config: ModelConfig = static()

    def predict(self, world: GridWorld, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Steps (n, D) to take from configurations (n, D), and minus the lengths (n,) left [m]."""
        local = features.to_local(q, self.center)
        points = batch_link_features(self.robot, local)
        seen = describe(self.config, self.robot, local[None], points[None])
        module: Any = build_module(self.config, q.shape[-1])
        action, value = module.apply(
            self.variables, self.plan, self.goal, seen, method=PlanningNetwork.read
        )
        return action[0], value[0]

    def draw(
        self, world: GridWorld, q: jax.Array, action: jax.Array, num: int, key: jax.Array
    ) -> jax.Array:
        """Where to go (n, num, D) from ``q`` (n, D), for steps (n, D) of :meth:`predict`."""
        noise = jax.random.normal(key, (len(q), num, q.shape[1]))
        return (q + action)[:, None] + self.sigma * noise


@pytree
class NEXTGuide:
    """NEXT's network: makes a :class:`QueryGuide` for each query."""

    robot: MobileRobot
    variables: Any  # weights, flax variables
    sigma: Any = 0.3  # () standard deviation of steps around the network's [m] and [rad]
    config: ModelConfig = static()
    num_outputs: int = static()  # joints

    @single_precision
    def of_query(self, world: GridWorld, q_start: Any, q_goal: Any) -> QueryGuide:
        """Plan on the map of a world for a query from ``q_start`` (D,) to ``q_goal`` (D,)."""
        return _look(self, world, jnp.asarray(q_start), jnp.asarray(q_goal))


@jax.jit
def _look(guide: NEXTGuide, world: GridWorld, q_start: jax.Array, q_goal: jax.Array) -> QueryGuide:
    config, robot = guide.config, guide.robot
    inputs = network_inputs(config, robot, world, q_start[None], q_goal[None])
    module: Any = build_module(config, guide.num_outputs)
    plan = module.apply(guide.variables, inputs.image, inputs.goal, method=PlanningNetwork.look)
    return QueryGuide(
        robot=robot,
        variables=guide.variables,
        plan=plan,
        goal=inputs.goal,
        center=inputs.center[0],
        sigma=guide.sigma,
        config=config,
    )


@pytree
class UniformGuide:
    """Knows nothing: every step is as likely, every configuration as good. What NEXT is without it.

    It is its own guide for each query.
    """

    reach: Any = 2.0  # () longest step of each joint [m] and [rad]

    def of_query(self, world: GridWorld, q_start: Any, q_goal: Any) -> "UniformGuide":
        """The same for all queries."""
        return self

    def predict(self, world: GridWorld, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """No step (n, D), and a value (n,) of 0."""
        return jnp.zeros_like(q), jnp.zeros(len(q), q.dtype)

    def draw(
        self, world: GridWorld, q: jax.Array, action: jax.Array, num: int, key: jax.Array
    ) -> jax.Array:
        """Where to go (n, num, D) from ``q`` (n, D), anywhere within reach."""
        reach = jnp.minimum(self.reach, (world.upper - world.lower) / 2)
        return q[:, None] + reach * jax.random.uniform(
            key, (len(q), num, q.shape[1]), minval=-1.0, maxval=1.0
        )
