"""What NEXT learns from: states of paths, each with a step along its path and the length left.

The paths to one goal stand together: the network plans once for all of them. Letters: ``G`` goals,
``n`` goals of a batch, ``P`` paths to a goal, ``K`` states of a path with both ends, ``H`` homes,
``D`` joints, ``F`` link frames, ``E`` features.
"""

import dataclasses
from functools import partial
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
    home: jax.Array  # (G,) i32
    q: jax.Array  # (G, P K, D), path by path from the start to the goal, evenly
    points: jax.Array  # (G, P K, F, 3) positions of their link frames [m]
    length: jax.Array  # (G, P) of the paths [m], 0 where a goal has fewer


@pytree
class PathBatch:
    """What the network sees of n goals, and what it should answer; ``C`` is P (K - 1)."""

    image: jax.Array  # (n, X, Y, Z) the maps
    goal: jax.Array  # (n, E) features
    q: jax.Array  # (n, C, E) features of all states but the goals
    action: jax.Array  # (n, C, D) steps along the paths
    value: jax.Array  # (n, C) minus the lengths that are left [m]
    weight: jax.Array  # (n, C) in the loss, 0 where a goal has fewer paths


def path_examples(
    config: ModelConfig, robot: MobileRobot, dataset: Dataset, room: int
) -> tuple[PathExamples, int]:
    """Put the paths of a data set on the device, with room for more; and how many goals they have.

    Args:
        config: of the model to train.
        robot: whose configurations they are.
        dataset: from :func:`nrp_jax.learning.data.load_dataset`, of paths.
        room: for so many more goals.

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
    start, goal, home, length = (rows[k][first] for k in ("q_start", "q_goal", "home", "length"))
    paths = np.concatenate([start[:, None], inner, goal[:, None]], axis=1)
    # A table (G, P) of the paths to each goal; where it has fewer, its first again, of length 0.
    _, group, counts = np.unique(
        np.column_stack([home, goal]), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(group.reshape(-1), kind="stable")
    slot = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    group = group.reshape(-1)[order]
    table = np.repeat(order[slot == 0][:, None], counts.max(), axis=1)
    filled = np.arange(counts.max()) < counts[:, None]
    table[group, slot] = order
    # Empty places for all, then these paths.
    (num, most), states = table.shape, paths.shape[1]
    grids = [grid.flatten() if robot.planar else grid for grid in dataset.grids]
    room, size = room + num, most * states
    empty = PathExamples(
        maps=jnp.asarray(stacked_maps(config, grids)),
        home=jnp.zeros(room, jnp.int32),
        q=jnp.zeros((room, size, robot.num_joints)),
        points=jnp.zeros((room, size, len(robot.feature_link), 3)),
        length=jnp.zeros((room, most)),
    )
    length = np.where(filled, length[table], 0.0)
    return with_paths(robot, empty, 0, home[table[:, 0]], paths[table], length), num


def with_paths(
    robot: MobileRobot,
    examples: PathExamples,
    first: int,
    home: np.ndarray,
    q: np.ndarray,
    length: np.ndarray,
) -> PathExamples:
    """Write the paths to m goals to the places from ``first`` on.

    Args:
        robot: whose configurations they are.
        examples: with room for P paths to each goal.
        first: goal.
        home: (m,) of each goal.
        q: (m, P', K, D) paths, P' of P.
        length: (m, P') [m].
    """
    if not len(q):
        return examples
    place = slice(first, first + len(q))
    missing = examples.length.shape[1] - q.shape[1]
    length = np.pad(length, [(0, 0), (0, missing)])
    q = np.pad(q, [(0, 0), (0, missing), (0, 0), (0, 0)], "edge").astype(np.float32)
    q = q.reshape(len(q), -1, q.shape[-1])
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
    step: float,
    key: jax.Array | None = None,
) -> PathBatch:
    """Features and answers of chosen goals (n,); a key turns and mirrors each at random.

    Steps lead ``step`` [m] on along a path, or to the goal if that is nearer.
    """
    image, q, points = local_queries(config, robot, examples, chosen, key)
    length = examples.length[chosen]
    shape = (*length.shape, -1)
    described = describe(config, robot, q, points)
    goal = described[:, -1]
    described, q = (x.reshape(*shape, x.shape[-1]) for x in (described, q))  # (n, P, K, ...)
    action = jax.vmap(jax.vmap(partial(steps_along, robot, step=step)))(q, length)
    num = q.shape[2] - 1
    left = 1.0 - jnp.arange(num) / num
    weight = jnp.broadcast_to(length[..., None] > 0, action.shape[:-1])
    return PathBatch(
        image=image,
        goal=goal,
        q=described[:, :, :-1].reshape(len(q), -1, goal.shape[-1]),
        action=action.reshape(len(q), -1, q.shape[-1]),
        value=(-length[..., None] * left).reshape(len(q), -1),
        weight=weight.reshape(len(q), -1).astype(jnp.float32),
    )


def steps_along(robot: MobileRobot, q: jax.Array, length: jax.Array, step: float) -> jax.Array:
    """Steps (K - 1, D) from even states (K, D) of a path to where it is ``step`` [m] further on.

    Joints move evenly between states. The last steps end at the goal.

    Args:
        robot: whose configurations they are.
        q: (K, D) states that part the path into equal lengths.
        length: () of the path [m].
        step: () along the path [m].
    """
    between = short_way(q[1:] - q[:-1], robot.is_continuous)  # (K - 1, D)
    num = len(between)
    end = jnp.arange(num) + step * num / jnp.maximum(length, 1e-9)
    # How much of the way from each state to the next a step covers.
    covered = jnp.clip(end[:, None] - jnp.arange(num), 0.0, 1.0)
    return jnp.triu(covered) @ between


def next_loss(
    module: PlanningNetwork, variables: Any, batch: PathBatch, value_weight: float
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """The loss (), and the mean squared errors of actions and of values, both ()."""
    answers: Any = module.apply(variables, batch.image, batch.goal, batch.q)
    action, value = answers
    of_action = jnp.mean((action - batch.action) ** 2, axis=-1)
    errors = jnp.stack([of_action, (value - batch.value) ** 2])
    of_action, of_value = jnp.sum(batch.weight * errors, axis=(1, 2)) / jnp.sum(batch.weight)
    return of_action + value_weight * of_value, (of_action, of_value)
