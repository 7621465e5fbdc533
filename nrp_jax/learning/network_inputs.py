"""What the networks are told about starts and goals while planning.

Training batches come from :mod:`nrp_jax.learning.batches`; the numbers are computed alike. Letters:
``B`` lanes, ``D`` joints, ``E`` features, ``F`` link frames.
"""

import jax
import jax.numpy as jnp

from nrp_jax.learning import features
from nrp_jax.learning.batches import describe, local_image, surrounding_map
from nrp_jax.learning.models import ModelConfig
from nrp_jax.scene.robots import MobileRobot, batch_link_features
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.types import pytree


@pytree
class NetworkInputs:
    """Surroundings and features of B starts and goals.

    Local means: in the frame whose origin is ``center`` and whose axes are the map's.
    """

    image: jax.Array  # (B, X, Y, Z) surroundings of the starts
    center: jax.Array  # (B, 2) origins of the local frames in the map [m]
    start: jax.Array  # (B, E) features of the starts
    goal: jax.Array  # (B, E') features of the goals
    ends: jax.Array  # (B, 2, D) starts and goals, local
    end_points: jax.Array  # (B, 2, F, 3) their link frames, local [m]


def network_inputs(
    config: ModelConfig, robot: MobileRobot, world: GridWorld, q_from: jax.Array, q_goal: jax.Array
) -> NetworkInputs:
    """Compute what a model sees of starts (B, D) and goals (B, D).

    Args:
        config: of the model; it says whether the image is a window or the whole map.
        robot: whose configurations they are.
        world: the robot in a home.
        q_from: (B, D) starts in the map.
        q_goal: (B, D) goals in the map.
    """
    # The image around each start.
    padded = surrounding_map(config, world.field)
    resolution = world.field.resolution
    origin = world.corner[0]
    image, center = jax.vmap(lambda q: local_image(config, padded, q, resolution, origin))(q_from)
    # Both ends in the local frame, so that a model learns one place for all.
    ends = jnp.stack([q_from, q_goal], axis=1)
    ends = features.to_local(ends, center[:, None])
    points = jax.vmap(batch_link_features, (None, 0))(robot, ends)
    return NetworkInputs(
        image=image,
        center=center,
        start=describe(config, robot, ends[:, :1], points[:, :1])[:, 0],
        goal=jax.vmap(lambda q, p: features.goal_features(config, robot, q, p))(
            ends[:, 1], points[:, 1]
        ),
        ends=ends,
        end_points=points,
    )
