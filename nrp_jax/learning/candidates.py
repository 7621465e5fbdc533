"""Candidates: random configurations around starts, among which a discriminator chooses.

NRP-d draws them where it plans, and the expert judges some of the same kind, so that a
discriminator is trained on what it will be asked about. Letters: ``B`` lanes, ``C`` candidates of a
lane, ``D`` joints, ``F`` link frames, ``n`` rows.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.homes.grid import RESOLUTION
from nrp_jax.learning import features
from nrp_jax.learning.batches import read_image
from nrp_jax.learning.expert import Rows
from nrp_jax.learning.local_map import SIDE
from nrp_jax.learning.models import ModelConfig
from nrp_jax.learning.network_inputs import NetworkInputs, network_inputs
from nrp_jax.learning.optimality import make_queries, optimality
from nrp_jax.learning.roadmap import Roadmap
from nrp_jax.scene.robots import MobileRobot, batch_link_features
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.edges import difference, enforce_bounds
from vrrt_jax.core.precision import single_precision

HALF_WINDOW = SIDE / 2 * RESOLUTION  # from the center of a local window to its sides [m]
POSTURES = 16  # drawn between a start's posture and a goal's
POSTURE_NOISE = 1.0  # largest deviation of a joint from these postures [rad] or [m]
DRAWN = 256  # for a lane, a multiple of ``POSTURES``
MAX_SCORED = 96  # of the drawn candidates, those that a network scores
_QUERIES = 50  # whose candidates are drawn at once


def draw_candidates(
    robot: MobileRobot,
    world: GridWorld,
    inputs: NetworkInputs,
    q_from: jax.Array,
    q_goal: jax.Array,
    key: jax.Array,
    *,
    num: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Draw configurations anywhere in the local windows, in postures between start and goal.

    Args:
        robot: whose configurations they are.
        world: the robot in a home.
        inputs: of the same starts and goals; its frame is theirs.
        q_from: (B, D) starts.
        q_goal: (B, D) goals, which are the first candidates.
        key: random key.
        num: of a lane besides the goal, a multiple of ``POSTURES``.

    Returns:
        Candidates (B, 1 + num, D) and their link frames (B, 1 + num, F, 3), both local; and which
        count (B, 1 + num): all, but the goal only where it lies in the window.
    """
    key_posture, key_place = jax.random.split(key)
    shape = (len(q_from), round(num / POSTURES), POSTURES)
    place = jax.random.uniform(key_place, (*shape, 2), minval=-HALF_WINDOW, maxval=HALF_WINDOW)
    q = _postures(robot, world, q_from, q_goal, key_posture)
    # Kinematics once a posture: at another place, the same posture's frames only shift.
    points = jax.vmap(batch_link_features, (None, 0))(robot, q)
    q = jnp.broadcast_to(q[:, None], (*shape, q.shape[-1])).at[..., :2].set(place)
    points = points[:, None] + jnp.pad(place, [(0, 0)] * 3 + [(0, 1)])[..., None, :]
    q, points = jax.tree.map(
        lambda x: x.reshape(len(x), shape[1] * POSTURES, *x.shape[3:]), (q, points)
    )
    # Candidates are drawn around the start. A window is centered there; a whole map is not.
    if inputs.image.shape[1] != SIDE:
        shift = jnp.pad(features.to_local(q_from, inputs.center)[:, :2], ((0, 0), (0, 1)))
        q = q.at[..., :2].add(shift[:, None, :2])
        points = points + shift[:, None, None]
    q = jnp.concatenate([inputs.ends[:, 1:], q], axis=1)
    points = jnp.concatenate([inputs.end_points[:, 1:], points], axis=1)
    near = jnp.max(jnp.abs(q_goal - q_from)[:, :2], axis=1) < HALF_WINDOW
    return q, points, jnp.ones(q.shape[:2], bool).at[:, 0].set(near)


def drop_colliding(
    robot: MobileRobot,
    inputs: NetworkInputs,
    q: jax.Array,
    points: jax.Array,
    possible: jax.Array,
    num: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Keep ``num`` of what :func:`draw_candidates` returned, first what is in no solid cell."""
    standing = jax.vmap(jax.vmap(functools.partial(features.standing_points, robot)))
    clearance = jax.vmap(read_image)(inputs.image, standing(q, points))
    blocked = jnp.min(clearance, axis=-1) <= 0
    rank = jnp.where(possible, jnp.where(blocked, 1.0, 2.0), 0.0)
    _, kept = jax.lax.top_k(rank, num)
    return jax.vmap(lambda kept, arrays: jax.tree.map(lambda x: x[kept], arrays))(
        kept, (q, points, possible)
    )


def _postures(
    robot: MobileRobot, world: GridWorld, q_from: jax.Array, q_goal: jax.Array, key: jax.Array
) -> jax.Array:
    """Configurations (B, POSTURES, D) at the origin, with arms between the starts' and the goals'.

    A base that turns gets a random heading.
    """
    step = difference(world, q_from, q_goal)[:, None]
    q = q_from[:, None] + jnp.linspace(0.0, 1.0, POSTURES)[:, None] * step
    key_noise, key_scale = jax.random.split(key)
    noise = jax.random.uniform(key_noise, q.shape, minval=-1.0, maxval=1.0)
    # Small deviations are more frequent than large ones: the scale is a squared uniform number.
    scale = POSTURE_NOISE * jax.random.uniform(key_scale, (*q.shape[:2], 1)) ** 2
    base = jnp.arange(q.shape[-1]) < robot.base_dim
    q = jnp.where(base, jnp.pi * noise, q + scale * noise)
    return enforce_bounds(world, q.at[..., :2].set(0.0)).at[..., :2].set(0.0)


@single_precision
def make_candidate_rows(
    world: GridWorld,
    robot: MobileRobot,
    roadmap: Roadmap,
    rng: np.random.Generator,
    num_queries: int,
    num_waypoints: int,
) -> Rows:
    """Ask the expert for random ones of those candidates that NRP-d would score.

    Args:
        world: the robot in a home.
        robot: the robot.
        roadmap: of that home.
        rng: where the choices come from.
        num_queries: starts with a goal each, drawn as for waypoints.
        num_waypoints: candidates of a query.

    Returns:
        Rows whose ``waypoint`` and ``optimal`` are the candidate.
    """
    queries = make_queries(world, robot, roadmap, num_queries, rng)
    start, goal = roadmap.q[queries.start], roadmap.q[queries.goals[queries.goal]]
    waypoints = []
    for first in range(0, num_queries, _QUERIES):
        some = np.arange(first, first + _QUERIES) % num_queries  # batches of one size
        key = jax.random.key(int(rng.integers(2**31)))
        waypoints.append(_draw(robot, world, start[some], goal[some], key, num_waypoints))
    waypoint = np.concatenate(waypoints)[:num_queries].reshape(-1, start.shape[1])
    query = np.repeat(np.arange(num_queries, dtype=np.int32), num_waypoints)
    score = optimality(world, robot, roadmap, queries.take(query), waypoint)
    with np.errstate(divide="ignore"):
        ratio = (1 / score).astype(np.float32)
    shortest = queries.cost[queries.goal, queries.start].astype(np.float32)
    return Rows(
        q_start=start[query],
        q_goal=goal[query],
        waypoint=waypoint,
        optimal=waypoint,
        ratio=ratio,
        length=shortest[query],
        query=query,
    )


@functools.partial(jax.jit, static_argnums=5)
def _draw(robot, world: GridWorld, q_from, q_goal, key: jax.Array, num: int) -> jax.Array:
    """Candidates (B, num, D) in the map; not the goal, which each query near it would have."""
    config = ModelConfig.default(robot.name, "discriminator")
    inputs = network_inputs(config, robot, world, q_from, q_goal)
    key_drawn, key_chosen = jax.random.split(key)
    drawn = draw_candidates(robot, world, inputs, q_from, q_goal, key_drawn, num=DRAWN)
    q, points, possible = (x[:, 1:] for x in drawn)
    scored = drop_colliding(robot, inputs, q, points, possible, max(num, MAX_SCORED))
    q = jax.random.permutation(key_chosen, scored[0], axis=1)[:, :num]
    return enforce_bounds(world, features.to_world(q, inputs.center[:, None]))
