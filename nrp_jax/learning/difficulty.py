"""How hard a home is: the share of long queries that a plain RRT-IS solves.

RRT-IS is RRT that extends a node until it hits something and inserts every sub-step of the
extension as a node (Lu et al. 2024). Training needs fair homes, neither too hard nor too easy. A
home is fair if it is about as hard as the paper's: RRT-IS solves 20 to 60 % of its long queries
within 300 expansions. :func:`fair_house` looks for one.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from nrp_jax.config import EDGE_STEPS
from nrp_jax.homes.grid import Grid
from nrp_jax.homes.houses import House, floor, generate_house
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.planners.rrt import RRT, sample_configurations
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.search import StopReason, initial_state, make_termination, run_chunk

EXPANSIONS = 300  # of RRT-IS for a query
MIN_GEODESIC = 5.0  # shortest path of the base from start to goal in a long query [m]
GOAL_BIAS = 0.1  # share of expansions that aim at the goal
FAIR = (0.2, 0.6)  # difficulty of a fair home
CAPACITY = 1 << 13  # nodes of a tree
RRT_IS = RRT(
    goal_bias=GOAL_BIAS, keep_partial=True, intermediate=True, lanes=1, edge_steps=EDGE_STEPS
)


@single_precision
def difficulty(robot: MobileRobot, grid: Grid, num: int = 20, seed: int = 0) -> float:
    """Measure the share of random long queries in a home that RRT-IS solves; lower is harder.

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        grid: the home.
        num: queries.
        seed: of queries and search.

    Raises:
        ValueError: the home has no two free places 5 m apart.
    """
    return float(np.mean(list(_answers(robot, grid, num, seed))))


@single_precision
def is_fair(robot: MobileRobot, grid: Grid, num: int = 20, seed: int = 0) -> bool:
    """Tell whether the difficulty of a home is within ``FAIR``, from as few queries as tell it.

    Arguments and errors are those of :func:`difficulty`.
    """
    low, high = FAIR
    solved = failed = 0
    least, most = 0.0, 1.0  # what the difficulty may still be
    for answer in _answers(robot, grid, num, seed):
        solved, failed = solved + answer, failed + (not answer)
        least, most = solved / num, (num - failed) / num
        if least > high or most < low or (low <= least and most <= high):
            break
    return low <= least and most <= high


def _answers(robot: MobileRobot, grid: Grid, num: int, seed: int) -> Iterator[bool]:
    """Ask random long queries, one after the other; yield whether each is solved."""
    world = build_world(robot, grid)
    starts, goals = long_queries(robot, world, grid, num, seed)
    keys = jax.random.split(jax.random.key(seed), num)
    for query in zip(starts, goals, keys, strict=True):
        yield bool(is_solved(world, *query))


@single_precision
def fair_house(robot: MobileRobot, seed: int) -> House:
    """Generate the first fair home of a seed.

    The paper's figures are those of the snake, a planar robot. Homes for other robots are taken as
    they come: for the Fetch RRT-IS solves hardly any query, not even in rooms without clutter.

    Raises:
        RuntimeError: all of 20 homes are too hard or too easy.
    """
    for variant in range(20):
        house = generate_house(seed, robot.name, variant=variant)
        if not robot.planar or is_fair(robot, house.plan()):
            return house
    raise RuntimeError(f"no home of seed {seed} is neither too hard nor too easy; take another")


@single_precision
def long_queries(
    robot: MobileRobot, world: GridWorld, grid: Grid, num: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draw free starts and goals (num, D), at least 5 m apart along the floor.

    Raises:
        ValueError: there are none.
    """
    # Random free configurations, and the floor cell of each base.
    q = sample_configurations(world, jax.random.key(seed), 4096)
    q = np.asarray(q)[np.asarray(batch_is_free(world, q))]
    index = np.full(grid.occupied.shape[:2], -1)
    ground = floor(grid, robot.name)
    index[ground] = np.arange(ground.sum())
    cell = np.floor((q[:, :2] - grid.origin[:2]) / grid.resolution).astype(int)
    node = index[tuple(cell.T)]
    q, node = q[node >= 0], node[node >= 0]
    # Random starts, each with a random goal that is far along the floor but can be reached.
    rng = np.random.default_rng(seed)
    graph, pairs = floor_graph(index, grid.resolution), []
    for start in rng.integers(0, len(q), 20 * num) if len(q) else ():
        geodesic = csgraph.dijkstra(graph, indices=node[start])[node]
        far = np.flatnonzero((geodesic >= MIN_GEODESIC) & np.isfinite(geodesic))
        if len(far):
            pairs.append((start, rng.choice(far)))
        if len(pairs) == num:
            start, goal = np.array(pairs).T
            return q[start], q[goal]
    raise ValueError(
        f"no {num} pairs of free places at least {MIN_GEODESIC} m apart: the map is too small or "
        "too full"
    )


def floor_graph(index: np.ndarray, resolution: float) -> sparse.csr_matrix:
    """Lengths [m] of steps from floor cells to their eight neighbors, a graph.

    Args:
        index: (X, Y) number of each floor cell, -1 elsewhere.
        resolution: side of a cell [m].
    """
    edges = []
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a, b = index[: len(index) - i], index[i:]
        a, b = (a[:, : a.shape[1] - j], b[:, j:]) if j >= 0 else (a[:, 1:], b[:, :-1])
        both = (a >= 0) & (b >= 0)
        length = np.full(both.sum(), resolution * np.hypot(i, j))
        edges += [(a[both], b[both], length), (b[both], a[both], length)]
    a, b, length = (np.concatenate(part) for part in zip(*edges, strict=True))
    n = index.max() + 1
    return sparse.csr_matrix((length, (a, b)), (n, n))


@jax.jit
def is_solved(world: GridWorld, q_start: jax.Array, q_goal: jax.Array, key: jax.Array) -> jax.Array:
    """Whether RRT-IS reaches the goal (D,) from the start (D,) within 300 expansions, () bool.

    It is the planner "rrt-is" with a single lane: one expansion after the other, as the paper
    counts them.
    """
    goal, policy = ConfigurationGoal(q=q_goal), RRT_IS
    tree = policy.init(world, goal, q_start[None], CAPACITY)
    termination = make_termination(policy.goal_score(goal), max_iterations=EXPANSIONS)
    state = initial_state(tree)
    state, reason = run_chunk(world, goal, policy, state, termination, key, jnp.int32(EXPANSIONS))
    return reason == StopReason.REACHED
