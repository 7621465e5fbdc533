"""Rows of a data set as arrays on the device, and batches of them as the networks see them.

Rows are grouped by query, so that the image around a start is cut out and encoded once for all
waypoints of the query. Configurations and points are *local*: in a frame at the center of the
image, with the map's axes. Letters: ``Q`` queries, ``W`` waypoints of a query, ``H`` homes, ``n``
queries of a batch, ``D`` joints, ``F`` link frames, ``E`` features.
"""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import RESOLUTION, Grid
from nrp_jax.homes.houses import CELLS
from nrp_jax.learning import features, local_map
from nrp_jax.learning.expert import GOOD_RATIO
from nrp_jax.learning.models import MAP_KINDS, WAYPOINT_KINDS, ModelConfig
from nrp_jax.learning.optimality import progress
from nrp_jax.scene.field import DistanceField, make_field
from nrp_jax.scene.robots import MobileRobot, batch_link_features
from nrp_jax.scene.world import build_world
from vrrt_jax.core.types import pytree

if TYPE_CHECKING:  # data sets are made with what is here
    from nrp_jax.learning.data import Dataset

FULL_PROGRESS = 2.0  # a candidate so much nearer to the goal could not be better [m]
# Each query that is turned by itself is turned by all quarters, of which one is kept.
LARGE_IMAGE = 100_000  # cells
LIMITS = np.array([[4], [2]])  # of quarter turns, and of mirrors


@pytree
class Examples:
    """Training rows on the device, in the frame of the map."""

    maps: jax.Array  # (H, X + 40, Y + 40, Z) float16, see :func:`surrounding_map`
    home: jax.Array  # (Q,) i32
    q: jax.Array  # (Q, 2 + W, D) start, goal and waypoints
    points: jax.Array  # (Q, 2 + W, F, 3) positions of their link frames [m]
    target: jax.Array  # (Q, W) how good each waypoint is, 0 to 1
    weight: jax.Array  # (Q, W) of each waypoint in the loss, 0 where a query has fewer waypoints


@pytree
class Batch:
    """What the networks see of n queries."""

    image: jax.Array  # (n, X, Y, Z) surroundings of the starts
    start: jax.Array  # (n, E) features
    goal: jax.Array  # (n, E') features
    waypoints: jax.Array  # (n, W, E) features
    relation: jax.Array  # (n, W, R), see :func:`relations`
    target: jax.Array  # (n, W) how good each waypoint is, 0 to 1
    weight: jax.Array  # (n, W) in the loss


def surrounding_map(config: ModelConfig, field: DistanceField) -> jax.Array:
    """The map from which images are cut, (X + 40, Y + 40, Z), with a border of solid cells.

    Cells hold the distance to the nearest obstacle [m], 0 if solid. For the published models they
    hold 1 if solid and 0 if free.
    """
    distances = features.surroundings(field)
    half = local_map.SIDE // 2
    border = ((half, half), (half, half), (0, 0))
    distances = jnp.pad(distances, border)
    return jnp.where(distances > 0, 0.0, 1.0) if config.paper else distances


def local_image(
    config: ModelConfig, padded: jax.Array, q: jax.Array, resolution: jax.Array, origin: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Cut out what a model sees from a start ``q`` (D,).

    Args:
        config: of the model; its scope says whether it sees a window or the whole map.
        padded: from :func:`surrounding_map`.
        q: (D,) start.
        resolution: () side of a cell [m].
        origin: (2,) corner of the map's first cell [m].

    Returns:
        The image (X', Y', Z), and the origin (2,) of the local frame in the map [m]: the center of
        the image.
    """
    if config.scope == "window":
        image = local_map.window(padded, q, resolution, origin)
        return image, local_map.center(q, resolution, origin)
    # The whole map. Images have one size: smaller maps are filled up, larger maps are cropped.
    side, half = CELLS[config.task], local_map.SIDE // 2
    size = np.array(padded.shape[:2]) - 2 * half
    missing = np.maximum(side - size, 0)
    solid = 1.0 if config.paper else 0.0
    image = jnp.pad(
        padded[half:-half, half:-half],
        [(missing[0] // 2, missing[0] - missing[0] // 2)]
        + [(missing[1] // 2, missing[1] - missing[1] // 2), (0, 0)],
        constant_values=solid,
    )
    first = np.maximum(size - side, 0) // 2
    image = image[first[0] : first[0] + side, first[1] : first[1] + side]
    corner = first - missing // 2
    return image, origin[:2] + (jnp.asarray(corner) + side / 2) * resolution


def load_examples(
    config: ModelConfig, robot: MobileRobot, dataset: "Dataset", *, soft: bool = True
) -> Examples:
    """Put those rows of a data set on the device that a model learns from.

    A discriminator learns from all rows, a CVAE from the good waypoints alone.

    Args:
        config: of the model to train.
        robot: whose configurations they are.
        dataset: from :func:`nrp_jax.learning.data.load_dataset`.
        soft: the target of a discriminator is how much nearer to the goal a candidate is, 1 from
            ``FULL_PROGRESS`` on; or falls off exponentially with the detour of a waypoint.
            Otherwise it is 1 for good ones and 0 for others.

    Raises:
        ValueError: the data set is of another task, or of rows that such a model does not learn
            from.
    """
    if dataset.settings.task != config.task:
        raise ValueError(
            f"the data set is of task '{dataset.settings.task}', the model of '{config.task}'; "
            "give another data set, or the other --task"
        )
    kinds = {"paths": MAP_KINDS, "waypoints": WAYPOINT_KINDS, "candidates": ("discriminator",)}
    holds = dataset.settings.holds
    if config.kind not in kinds.get(holds, ()):
        wanted = [name for name, learning in kinds.items() if config.kind in learning]
        raise ValueError(
            f"the data set holds {holds}, but a '{config.kind}' learns from {' or '.join(wanted)}; "
            "give one that nrp data wrote with the option of that name (waypoints: with none), or "
            "another --model"
        )
    rows = dataset.rows
    grids = [grid.flatten() if robot.planar else grid for grid in dataset.grids]
    # Which rows, and how good their waypoints are.
    good = rows["ratio"] <= GOOD_RATIO
    if config.kind != "discriminator":
        rows = {name: column[good] for name, column in rows.items()}
        target = weight = np.ones(good.sum())
    elif soft and holds == "candidates":
        target = np.minimum(progress(build_world(robot, grids[0]), rows) / FULL_PROGRESS, 1.0)
        weight = np.ones(len(good))
    else:
        detour = np.maximum(rows["ratio"] - 1.0, 0.0)
        target = np.exp(-detour / (GOOD_RATIO - 1.0)) if soft else good.astype(np.float32)
        weight = np.ones(len(good))
    return make_examples(config, robot, grids, rows, target=target, weight=weight)


def make_examples(
    config: ModelConfig,
    robot: MobileRobot,
    grids: Sequence[Grid],
    rows: dict[str, np.ndarray],
    *,
    target: np.ndarray,
    weight: np.ndarray,
) -> Examples:
    """Put rows on the device, grouped by query.

    Args:
        config: of the model to train.
        robot: whose configurations they are.
        grids: H homes, planar for a planar robot; their maps begin at (0, 0).
        rows: ``q_start``, ``q_goal``, ``waypoint`` (n, D), ``home`` and ``query`` (n,).
        target: (n,) how good the waypoints are.
        weight: (n,) in the loss.
    """
    maps = stacked_maps(config, grids)
    # Number the queries of all homes; ``group`` (n,) is the query of each row.
    _, first, group, counts = np.unique(
        rows["home"].astype(np.int64) << 32 | rows["query"].astype(np.int64),
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    # A table (Q, W) of row indices. Empty slots repeat a query's first row, with weight 0.
    order = np.argsort(group, kind="stable")
    slot = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    table = np.repeat(first[:, None], counts.max(), axis=1)
    table[group[order], slot] = order
    filled = np.arange(counts.max()) < counts[:, None]
    ends = np.stack([rows["q_start"][first], rows["q_goal"][first]], axis=1)
    q = np.concatenate([ends, rows["waypoint"][table]], axis=1).astype(np.float32)
    # Link frames are computed once: kinematics inside the training step compile very slowly.
    points = batch_link_features(robot, q.reshape(-1, q.shape[-1]))
    return Examples(
        maps=jnp.asarray(maps),
        home=jnp.asarray(rows["home"][first], jnp.int32),
        q=jnp.asarray(q),
        points=points.reshape(*q.shape[:2], *points.shape[1:]),
        target=jnp.asarray(target[table], jnp.float32),
        weight=jnp.asarray(weight[table] * filled, jnp.float32),
    )


def stacked_maps(config: ModelConfig, grids: Sequence[Grid]) -> np.ndarray:
    """Maps of homes of several sizes as one array (H, X, Y, Z), filled up with solid cells."""
    maps = [surrounding_map(config, make_field(grid)) for grid in grids]
    size = np.max([one.shape for one in maps], axis=0)
    stacked = np.full((len(maps), *size), 1.0 if config.paper else 0.0, np.float16)
    for k, one in enumerate(maps):
        stacked[k, : one.shape[0], : one.shape[1], : one.shape[2]] = np.asarray(one)
    return stacked


def make_batch(
    config: ModelConfig,
    robot: MobileRobot,
    examples: Examples,
    chosen: jax.Array,
    key: jax.Array | None = None,
) -> Batch:
    """Images and features of chosen queries.

    Args:
        config: of the model to train.
        robot: whose configurations they are.
        examples: training rows.
        chosen: (n,) indices of queries.
        key: turns and mirrors each query at random, if given; queries with images of more than
            ``LARGE_IMAGE`` cells all alike. Homes have no preferred direction, so that a query
            stands for eight.
    """
    image, q, points = local_queries(config, robot, examples, chosen, key)
    described = describe(config, robot, q, points)
    return Batch(
        image=image,
        start=described[:, 0],
        goal=jax.vmap(lambda q, p: features.goal_features(config, robot, q, p))(
            q[:, 1], points[:, 1]
        ),
        waypoints=described[:, 2:],
        relation=jax.vmap(functools.partial(relations, robot))(image, q, points),
        target=examples.target[chosen],
        weight=examples.weight[chosen],
    )


def local_queries(
    config: ModelConfig,
    robot: MobileRobot,
    examples: Any,
    chosen: jax.Array,
    key: jax.Array | None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Images (n, X, Y, Z), configurations (n, K, D) and link frames (n, K, F, 3), all local.

    Arguments are those of :func:`make_batch`; examples have ``maps``, ``home``, ``q`` (Q, K, D) and
    ``points`` (Q, K, F, 3), as :class:`Examples` do.
    """
    image, q, points = jax.vmap(lambda index: _local(config, examples, index))(chosen)
    if key is not None:
        # One of the eight symmetries of a square for each query.
        alike = image[0].size > LARGE_IMAGE
        symmetry = jax.random.randint(key, (2, 1 if alike else len(chosen)), 0, LIMITS)
        symmetry = symmetry[0], symmetry[1] == 1
        if alike:
            image = jax.vmap(lambda one: features.turn_image(one, *(s[0] for s in symmetry)))(image)
        else:
            image = jax.vmap(features.turn_image)(image, *symmetry)
        quarter, mirror = (jnp.broadcast_to(s, len(chosen)) for s in symmetry)
        q = jax.vmap(lambda *a: features.turn_configuration(robot, *a))(q, quarter, mirror)
        points = jax.vmap(features.turn_points)(points, quarter, mirror)
    return image, q, points


def empty_batch(config: ModelConfig, robot: MobileRobot, examples: Examples) -> Batch:
    """A batch of one query that holds zeros, to initialize networks with its shapes."""
    shapes = jax.eval_shape(
        lambda examples: make_batch(config, robot, examples, jnp.zeros(1, jnp.int32)), examples
    )
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


def describe(config: ModelConfig, robot: MobileRobot, q: jax.Array, points: jax.Array) -> jax.Array:
    """Features (n, C, E) of local configurations (n, C, D) with link frames (n, C, F, 3)."""
    one = functools.partial(features.configuration_features, config, robot)
    return jax.vmap(jax.vmap(one))(q, points)


def _local(config: ModelConfig, examples: Any, index: jax.Array):
    """Image, configurations (K, D) and link frames of one query, in its local frame."""
    home, q, points = examples.home[index], examples.q[index], examples.points[index]
    if config.scope == "window":
        image = local_map.stacked_window(examples.maps, home, q[0])
        center = local_map.center(q[0])
    else:
        image, center = local_image(
            config, examples.maps[home], q[0], jnp.float32(RESOLUTION), jnp.zeros(2)
        )
    points = points - jnp.append(center, 0.0)
    return image.astype(jnp.float32), features.to_local(q, center), points


def relations(robot: MobileRobot, image: jax.Array, q: jax.Array, points: jax.Array) -> jax.Array:
    """Numbers that relate candidates to the surroundings, the start and the goal.

    Args:
        robot: whose configurations they are.
        image: (X, Y, Z) around the start.
        q: (2 + C, D) start, goal and candidates, local.
        points: (2 + C, F, 3) their link frames [m].

    Returns:
        (C, R) for each candidate: what the image holds at points of the robot on its path from the
        start to the candidate; and the distances of base and arm from the start and to the goal.
    """
    standing = jax.vmap(functools.partial(features.standing_points, robot))(q, points)
    passed = jax.vmap(features.passed_points, (None, 0))(standing[0], standing[2:])
    parts = [read_image(image, passed), *(features.steps(robot, q[2:], end) for end in q[:2])]
    return jnp.concatenate(parts, axis=-1)


def read_image(image: jax.Array, points: jax.Array) -> jax.Array:
    """What an image (X, Y, Z) holds in the cells of local points (..., 3) [m], (...)."""
    return image.reshape(-1)[features.cells(points, image.shape, RESOLUTION)]
