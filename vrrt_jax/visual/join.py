"""From a tree to a configuration beside it: by one more edge, or by RRT-Connect from the tree."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core import tree as trees
from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edge_checks import first_free_edge, num_checks
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.result import EARLY_STOPS
from vrrt_jax.core.search import SearchResult, make_termination, search
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.core.timing import timed
from vrrt_jax.core.types import Tree
from vrrt_jax.outcome import time_left
from vrrt_jax.scene.world import World

CHEAPEST, NEAREST = 96, 32  # nodes from which an edge to the goal is tried
LONGEST_EDGE = 2.8  # [rad]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Way:
    """A path from the start to a goal."""

    path: np.ndarray  # (P, D)
    tree_share: float  # of its length, what the search's tree led along; the rest is RRT-Connect's


def join(
    world: World,
    connector: RRTConnect,
    found: SearchResult,
    q_goal: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
) -> tuple[SearchResult, Way | None]:
    """A way along the tree to a goal, if there is one; the time for it is added to the search's.

    As in RRT*, the goal becomes a child of the node through which it costs least, of those from
    which the edge to it is free. If none is, RRT-Connect goes on from the tree.

    Args:
        world: robot and obstacles.
        connector: RRT-Connect.
        found: the search, with its tree.
        q_goal: (D,) free.
        key: random key.
        config: settings.
    """
    tree, steps = found.tree, num_checks(world, LONGEST_EDGE)
    (node, is_free), compile_s, join_s = timed(
        lambda: cheapest_parent(world, tree, jnp.asarray(q_goal), steps), cheapest_parent
    )
    found = dataclasses.replace(
        found, compile_s=found.compile_s + compile_s, search_s=found.search_s + join_s
    )
    if not is_free:
        return connect(world, connector, found, q_goal, key, config, tree)
    path = np.concatenate([trees.branch_path(tree, int(node)), q_goal[None]])
    return found, Way(path=path, tree_share=1.0)


@partial(host_jit, static_argnames="num_steps")
def cheapest_parent(
    world: World, tree: Tree, q_goal: jax.Array, num_steps: int
) -> tuple[jax.Array, jax.Array]:
    """The node () that a goal (D,) costs least through along a free edge, and if there is one.

    Candidates are the nodes through which it would cost least, then the nearest ones; a path has to
    lead to them.
    """
    reached = trees.occupied(tree) & (tree.cost < trees.UNREACHED)
    apart = trees.distances(world, tree, q_goal[None], reached[None])[0]
    cheapest = jax.lax.top_k(-(tree.cost + apart), min(CHEAPEST, tree.capacity))
    nearest = jax.lax.top_k(-apart, min(NEAREST, tree.capacity))
    rank, node = (jnp.concatenate(parts) for parts in zip(cheapest, nearest, strict=True))
    q_from = tree.q[node]
    edge = world.edge(q_from, jnp.broadcast_to(q_goal, q_from.shape))
    tried = (rank > -jnp.inf) & world.is_resolved(edge, num_steps)
    first, _ = first_free_edge(world, q_from, edge, num_steps, tried)
    return node[jnp.minimum(first, len(node) - 1)], first < len(node)


def connect(
    world: World,
    connector: RRTConnect,
    found: SearchResult,
    q_goal: np.ndarray,
    key: jax.Array,
    config: PlannerConfig,
    tree: Tree | None = None,
) -> tuple[SearchResult, Way | None]:
    """A way by RRT-Connect, if there is one; the time for it is added to the search's.

    If time is up meanwhile, or the user interrupts, the search has stopped for that.

    Args:
        world: robot and obstacles.
        connector: RRT-Connect.
        found: the search.
        q_goal: (D,) free.
        key: random key.
        config: settings.
        tree: to go on from; None begins with the start alone.
    """
    goal = ConfigurationGoal(q=jnp.asarray(q_goal))
    if tree is None:
        capacity = config.tree.capacity
        forest = connector.init(world, goal, np.asarray(found.tree.q[:1]), capacity)
    else:
        forest = connector.init_from(world, goal, tree, 2 * tree.capacity)
    num_old = int(forest.size)
    connection = search(
        world,
        goal,
        connector,
        forest,
        key=key,
        termination=make_termination(
            connector.goal_score(goal), max_iterations=config.budget.connect_iterations
        ),
        time_limit_s=time_left(config, found.search_s).budget.time_limit_s,
        max_capacity=config.tree.max_capacity,
    )
    found = dataclasses.replace(
        found,
        stopped=connection.stopped if connection.stopped in EARLY_STOPS else found.stopped,
        compile_s=found.compile_s + connection.compile_s,
        search_s=found.search_s + connection.search_s,
    )
    path, halves = connector.extract_path(connection.tree), connector.halves(connection.tree)
    if path is None or halves is None:
        return found, None
    return found, _way(world, path, int(np.sum(halves[0] < num_old)))


def _way(world: World, path: np.ndarray, num_old: int) -> Way:
    """A path (P, D) whose first waypoints are nodes of the search's tree."""
    whole = path_length(world, path)
    along = path_length(world, path[:num_old]) if num_old > 1 else 0.0
    return Way(path=path, tree_share=along / whole if whole > 0 else 1.0)
