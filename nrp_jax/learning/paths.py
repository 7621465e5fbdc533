"""Expert data of whole paths: states along shortest paths, from which a global CVAE learns.

A row's waypoint is a state on the shortest path of its query, wherever that is in the home. The
states of a query lie evenly along the path, as in the data that the Neural Randomized Planner's
authors train their CVAE-RRT on (Lu et al. 2024, section VI; Ichter, Harrison and Pavone 2018).
Letters: ``N`` nodes, ``D`` joints, ``n`` rows.
"""

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.learning.edge_check import POINT_BATCH, pad_rows
from nrp_jax.learning.expert import Rows, ShortestPaths, choose_start, shortest_paths
from nrp_jax.learning.roadmap import Extents, Roadmap
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.precision import single_precision


@single_precision
def make_path_rows(
    world: GridWorld,
    robot: MobileRobot,
    roadmap: Roadmap,
    rng: np.random.Generator,
    num_queries: int,
    num_states: int,
) -> Rows:
    """Lay states along shortest paths; starts and goals are drawn as for waypoints.

    Args:
        world: the robot in a home.
        robot: the robot.
        roadmap: of that home.
        rng: where the choices come from.
        num_queries: starts with a goal each.
        num_states: rows of a query. They part its path into equal lengths; its ends are none.

    Returns:
        Rows whose ``waypoint`` is a state and whose ``ratio`` is 1.
    """
    paths = shortest_paths(rng, roadmap, num_queries)
    extents = Extents(robot, roadmap.q)
    rows, ends, fractions = [], [], []
    for query in range(num_queries):
        g = paths.index_of(query)
        goal, cost = paths.goals[g], paths.cost[g]
        nodes = path_nodes(rng, paths, extents, query)
        start = nodes[0]
        # From the start on: the length to each node, and the edge that each state is on.
        along = cost[start] - cost[nodes]
        wanted = along[-1] * np.arange(1, num_states + 1) / (num_states + 1)
        edge = np.clip(np.searchsorted(along, wanted, side="right") - 1, 0, len(nodes) - 2)
        fractions.append((wanted - along[edge]) / (along[edge + 1] - along[edge]))
        ends.append(np.take(nodes, np.stack([edge, edge + 1], axis=1)))
        rows += [(start, goal, nodes[1], cost[start], query)] * num_states
    start, goal, optimal, length, query = (np.array(column) for column in zip(*rows, strict=True))
    states = _states(world, roadmap.q, np.concatenate(ends), np.concatenate(fractions))
    return Rows(
        q_start=roadmap.q[start],
        q_goal=roadmap.q[goal],
        waypoint=states,
        optimal=roadmap.q[optimal],
        ratio=np.ones(len(states), np.float32),
        length=length.astype(np.float32),
        query=query.astype(np.int32),
    )


def path_nodes(
    rng: np.random.Generator, paths: ShortestPaths, extents: Extents, query: int
) -> list[int]:
    """The nodes of a query's shortest path, whose start is drawn."""
    goal, step = paths.goals[paths.index_of(query)], paths.step[paths.index_of(query)]
    near_goal = extents.inside(goal, slice(len(paths.critical)))
    nodes = [choose_start(rng, near_goal, paths.critical, goal)]
    while nodes[-1] != goal:
        nodes.append(int(step[nodes[-1]]))
    return nodes


def _states(world: GridWorld, q: np.ndarray, ends: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """States (n, D) at fractions (n,) of the edges between nodes ``ends`` (n, 2)."""
    made = []
    for first in range(0, len(ends), POINT_BATCH):
        part = slice(first, first + POINT_BATCH)
        batch, at = (pad_rows(rows[part], POINT_BATCH) for rows in (ends, fraction))
        states = states_on(world, jnp.asarray(q[batch]), jnp.asarray(at, jnp.float32))
        made.append(np.asarray(states)[: len(ends[part])])
    return np.concatenate(made)


@jax.jit
def states_on(world: GridWorld, ends: jax.Array, fraction: jax.Array) -> jax.Array:
    """States (n, D) at fractions (n,) of the edges between configurations (n, 2, D)."""
    edge = world.truncate(world.edge(ends[:, 0], ends[:, 1]), fraction)
    return world.normalize(world.end(ends[:, 0], edge))
