"""Samplers that generate: a CVAE's decoder makes configurations of random latents.

NRP-g's generates waypoints near starts. A global one generates configurations along whole paths.
Letters: ``B`` lanes, ``C`` latents of a lane, ``D`` joints.
"""

from typing import Any

import jax
import jax.numpy as jnp

from nrp_jax.learning import features
from nrp_jax.learning.checkpoint import build_module
from nrp_jax.learning.edge_check import first_free
from nrp_jax.learning.models import CVAE, ModelConfig
from nrp_jax.learning.network_inputs import network_inputs
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.core.types import PytreeSubclasses, pytree, static


@pytree
class Generator(PytreeSubclasses):
    """A trained CVAE of any kind."""

    robot: MobileRobot
    variables: Any  # weights, flax variables
    config: ModelConfig = static()
    num_outputs: int = static()  # features that the decoder writes

    def generate(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, num: int, key: jax.Array
    ) -> jax.Array:
        """Configurations (B, num, D) inside the limits, for starts and goals (B, D)."""
        inputs = network_inputs(self.config, self.robot, world, q_from, q_goal)
        z = jax.random.normal(key, (len(q_from), num, self.config.latent))
        module: Any = build_module(self.config, self.num_outputs)
        made = module.apply(
            self.variables, inputs.image, inputs.start, inputs.goal, z, method=CVAE.decode
        )
        q = features.to_configuration(self.config, self.robot, made)
        return enforce_bounds(world, features.to_world(q, inputs.center[:, None]))


@pytree
class CVAESampler(Generator):
    """NRP-g: the CVAE's decoder makes waypoints of random latents."""

    # So many waypoints are made, and their edges checked; the longest that is free is taken.
    num_edge_checked: int = static(default=8)
    edge_checks: int = static(default=12)  # configurations checked along each of these edges
    floor: Any = None  # FloorWays, by which the nearest to the goal is taken instead

    def propose(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> jax.Array:
        """See :class:`nrp_jax.samplers.Sampler`."""
        return self.propose_and_count(world, q_from, q_goal, key)[0]

    def propose_and_count(
        self, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Waypoints as :meth:`propose` makes them, and how many configurations it checked."""
        q = self.generate(world, q_from, q_goal, self.num_edge_checked, key)
        if self.num_edge_checked > 1:
            if self.floor is None:
                rank = -world.length(world.edge(jnp.broadcast_to(q_from[:, None], q.shape), q))
            else:
                rank = self.floor.between(q, q_goal[:, None])
            q = jnp.take_along_axis(q, jnp.argsort(rank, axis=1)[..., None], axis=1)
        return first_free(world, q_from, q, self.edge_checks)


@pytree
class GlobalCVAESampler(Generator):
    """Configurations along near-optimal paths of a whole map (Ichter, Harrison and Pavone 2018)."""

    def draw(
        self, world: GridWorld, q_start: jax.Array, q_goal: jax.Array, num: int, key: jax.Array
    ) -> jax.Array:
        """Draw configurations that the path between two others may pass.

        Args:
            world: the robot in a home.
            q_start: (D,) where the path begins.
            q_goal: (D,) where it ends.
            num: how many (static).
            key: random key.

        Returns:
            (num, D) configurations inside the limits; they may collide.
        """
        return self.generate(world, q_start[None], q_goal[None], num, key)[0]
