"""What NEXT learns from: paths as states, each with the next state and the length that is left.

Letters: ``Q`` queries, ``n`` queries of a batch, ``K`` states of a path with both ends, ``H``
homes, ``D`` joints, ``F`` link frames, ``E`` features.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.learning.batches import describe, local_queries, stacked_maps
from nrp_jax.learning.data import Dataset
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.next_network import PlanningNetwork
from nrp_jax.learning.paths import states_on
from nrp_jax.scene.robots import MobileRobot, batch_link_features
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edges import short_way
from vrrt_jax.core.types import pytree


@pytree
class PathExamples:
    """Paths on the device, in the frame of the map; there is room for more than there are."""

    maps: jax.Array  # (H, X + 40, Y + 40, Z) float16, see ``batches.surrounding_map``
    home: jax.Array  # (Q,) i32
    q: jax.Array  # (Q, K, D) from the start to the goal, evenly
    points: jax.Array  # (Q, K, F, 3) positions of their link frames [m]
    length: jax.Array  # (Q,) of the paths [m]


@pytree
class PathBatch:
    """What the network sees of n paths, and what it should answer."""

    image: jax.Array  # (n, X, Y, Z) the maps
    goal: jax.Array  # (n, E) features
    q: jax.Array  # (n, K - 1, E) features of all states but the goal
    action: jax.Array  # (n, K - 1, D) steps to the next states
    value: jax.Array  # (n, K - 1) minus the lengths that are left [m]


def path_examples(
    config: ModelConfig, robot: MobileRobot, dataset: Dataset, room: int
) -> PathExamples:
    """Put the paths of a data set on the device, with room for more.

    Args:
        config: of the model to train.
        robot: whose configurations they are.
        dataset: from :func:`nrp_jax.learning.data.load_dataset`, of paths.
        room: for so many more paths.

    Raises:
        ValueError: the data set is of another task, or holds no paths.
    """
    settings, rows = dataset.settings, dataset.rows
    if settings.task != config.task or not settings.paths:
        holds = "paths" if settings.paths else "waypoints"
        raise ValueError(
            f"the data set holds {holds} of task '{settings.task}'; expected paths of "
            f"'{config.task}': nrp data --task {config.task} --paths"
        )
    inner = rows["waypoint"].reshape(-1, settings.waypoints, robot.num_joints)
    first = slice(None, None, settings.waypoints)
    ends = [rows[name][first][:, None] for name in ("q_start", "q_goal")]
    empty = PathExamples(
        maps=jnp.asarray(
            stacked_maps(config, [g.flatten() if robot.planar else g for g in dataset.grids])
        ),
        home=jnp.zeros(len(inner) + room, jnp.int32),
        q=jnp.zeros((len(inner) + room, settings.waypoints + 2, robot.num_joints)),
        points=jnp.zeros(
            (
                len(inner) + room,
                settings.waypoints + 2,
                len(robot.feature_link),
                3,
            )
        ),
        length=jnp.zeros(len(inner) + room),
    )
    paths = np.concatenate([ends[0], inner, ends[1]], axis=1)
    return with_paths(robot, empty, 0, rows["home"][first], paths, rows["length"][first])


def with_paths(
    robot: MobileRobot,
    examples: PathExamples,
    first: int,
    home: np.ndarray,
    q: np.ndarray,
    length: np.ndarray,
) -> PathExamples:
    """Write paths (m, K, D) of homes (m,) and lengths (m,) to the places from ``first`` on."""
    if not len(q):
        return examples
    place = slice(first, first + len(q))
    q = q.astype(np.float32)
    points = batch_link_features(robot, q.reshape(-1, q.shape[-1]))
    return dataclasses.replace(
        examples,
        home=examples.home.at[place].set(home.astype(np.int32)),
        q=examples.q.at[place].set(q),
        points=examples.points.at[place].set(points.reshape(*q.shape[:2], *points.shape[1:])),
        length=examples.length.at[place].set(length.astype(np.float32)),
    )


def even_states(world: GridWorld, path: np.ndarray, num: int) -> tuple[np.ndarray, float]:
    """States (num, D) that part a path (P, D) into equal lengths, its ends included; its length."""
    steps = np.asarray(jax.vmap(world.distance)(jnp.asarray(path[:-1]), jnp.asarray(path[1:])))
    along = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = along[-1] * np.arange(1, num - 1) / (num - 1)
    edge = np.clip(np.searchsorted(along, wanted, side="right") - 1, 0, len(path) - 2)
    fraction = (wanted - along[edge]) / np.maximum(steps[edge], 1e-9)
    ends = np.stack([path[edge], path[edge + 1]], axis=1)
    inner = states_on(world, jnp.asarray(ends), jnp.asarray(fraction, jnp.float32))
    return np.concatenate([path[:1], np.asarray(inner), path[-1:]]), float(along[-1])


def path_batch(
    config: ModelConfig,
    robot: MobileRobot,
    examples: PathExamples,
    chosen: jax.Array,
    key: jax.Array | None = None,
) -> PathBatch:
    """Features and answers of chosen paths (n,); a key turns and mirrors each at random."""
    image, q, points = local_queries(config, robot, examples, chosen, key)
    described = describe(config, robot, q, points)
    left = 1.0 - jnp.arange(q.shape[1] - 1) / (q.shape[1] - 1)
    return PathBatch(
        image=image,
        goal=described[:, -1],
        q=described[:, :-1],
        action=short_way(q[:, 1:] - q[:, :-1], robot.is_continuous),
        value=-examples.length[chosen, None] * left,
    )


def next_loss(
    module: PlanningNetwork, variables: Any, batch: PathBatch, value_weight: float
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """The loss (), and the mean squared errors of actions and of values, both ()."""
    answers: Any = module.apply(variables, batch.image, batch.goal, batch.q)
    action, value = answers
    of_action = jnp.mean((action - batch.action) ** 2)
    of_value = jnp.mean((value - batch.value) ** 2)
    return of_action + value_weight * of_value, (of_action, of_value)
