"""Experiences for FIRE: the corners of shortened paths, where solving took a decision.

Rows are those of waypoints, see :class:`nrp_jax.learning.expert.Rows`: each waypoint is a corner of
a path that shortcuts have made as straight as they can (Chamzas et al. 2022, section IV).
"""

import jax
import numpy as np

from nrp_jax.learning.expert import Rows, shortest_paths
from nrp_jax.learning.paths import path_nodes
from nrp_jax.learning.roadmap import Extents, Roadmap
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.shortcut import path_length, shortcut


@single_precision
def make_experience_rows(
    world: GridWorld,
    robot: MobileRobot,
    roadmap: Roadmap,
    rng: np.random.Generator,
    num_queries: int,
    num_waypoints: int,
) -> Rows:
    """Solve queries and keep the corners of their shortened paths.

    Starts and goals are drawn as for waypoints, and solved on the roadmap.

    Args:
        world: the robot in a home.
        robot: the robot.
        roadmap: of that home.
        rng: where the choices come from.
        num_queries: starts with a goal each.
        num_waypoints: rows of a query, at most; of more corners some are left out, evenly.

    Returns:
        Rows whose ``waypoint`` is a corner, ``optimal`` the one after it, and ``ratio`` 1. A query
        that a straight edge solves has none.
    """
    paths, extents = shortest_paths(rng, roadmap, num_queries), Extents(robot, roadmap.q)
    rows = []
    for query in range(num_queries):
        path = roadmap.q[path_nodes(rng, paths, extents, query)]
        path = shortcut(world, path, key=jax.random.key(int(rng.integers(2**31))))
        inner = np.arange(1, len(path) - 1)
        if len(inner) > num_waypoints:
            inner = inner[np.linspace(0, len(inner) - 1, num_waypoints).round().astype(int)]
        length = path_length(world, path)
        rows += [(path[0], path[-1], path[k], path[k + 1], length, query) for k in inner]
    if not rows:
        raise ValueError("straight edges solve all queries of this home; expected harder ones")
    start, goal, waypoint, after, length, query = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    return Rows(
        q_start=start,
        q_goal=goal,
        waypoint=waypoint,
        optimal=after,
        ratio=np.ones(len(rows), np.float32),
        length=length.astype(np.float32),
        query=query.astype(np.int32),
    )
