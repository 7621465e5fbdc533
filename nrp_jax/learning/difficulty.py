"""How hard a home is: the share of long queries that a plain RRT-IS solves.

RRT-IS is RRT that extends a node until it hits something and inserts every sub-step of the
extension as a node (Lu et al. 2024). Training needs fair homes, neither too hard nor too easy. A
home is fair if it is about as hard as the paper's: RRT-IS solves 20 to 60 % of its long queries
within 300 expansions. :func:`fair_house` looks for one.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from nrp_jax.homes.grid import Grid
from nrp_jax.homes.houses import House, floor, generate_house
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world
from vrrt_jax.core.planners.rrt import sample_configurations

EXPANSIONS = 300  # of RRT-IS for a query
MIN_GEODESIC = 5.0  # shortest path of the base from start to goal in a long query [m]
GOAL_BIAS = 0.1  # share of expansions that aim at the goal
FAIR = (0.2, 0.6)  # difficulty of a fair home
_CAPACITY = 1 << 13  # nodes of a tree
_SUB_STEPS = 160  # of an extension, at most
_CHUNK = 16  # sub-steps checked at a time


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
    world = build_world(robot, grid)
    starts, goals = long_queries(robot, world, grid, num, seed)
    keys = jax.random.split(jax.random.key(seed), num)
    solved = [rrt_is(world, *query) for query in zip(starts, goals, keys, strict=True)]
    return float(np.mean(solved))


def fair_house(robot: MobileRobot, seed: int) -> House:
    """Generate the first fair home of a seed.

    The paper's figures are those of the snake, a planar robot. Homes for other robots are taken as
    they come: for the Fetch RRT-IS solves hardly any query, not even in rooms without clutter.

    Raises:
        RuntimeError: all of 20 homes are too hard or too easy.
    """
    for variant in range(20):
        house = generate_house(seed, robot.name, variant=variant)
        if not robot.planar or FAIR[0] <= difficulty(robot, house.plan()) <= FAIR[1]:
            return house
    raise RuntimeError(f"no home of seed {seed} is neither too hard nor too easy; take another")


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
    graph, pairs = _floor_graph(index, grid.resolution), []
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


def _floor_graph(index: np.ndarray, resolution: float) -> sparse.csr_matrix:
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
        edges.append((a[both], b[both], length))
    a, b, length = (np.concatenate(part) for part in zip(*edges, strict=True))
    n = index.max() + 1
    half = sparse.coo_matrix((length, (a, b)), (n, n))
    return (half + half.T).tocsr()


@jax.jit
def rrt_is(world: GridWorld, q_start: jax.Array, q_goal: jax.Array, key: jax.Array) -> jax.Array:
    """Whether RRT-IS reaches the goal (D,) from the start (D,) within 300 expansions, () bool.

    One extension after the other, as the paper counts expansions. The planner's RRT-IS
    (:class:`vrrt_jax.core.planners.rrt.RRT`) extends many nodes at a time and would measure another
    difficulty; homes of data sets depend on this one.
    """
    nodes = jnp.zeros((_CAPACITY, q_start.shape[0])).at[0].set(q_start)
    step = jnp.arange(1, _SUB_STEPS + 1)

    def goes_on(state):
        _, size, expansion, reached = state
        return ~reached & (expansion < EXPANSIONS) & (size < _CAPACITY)

    def expand(state):
        nodes, size, expansion, _ = state
        # The node nearest to a random configuration, or to the goal.
        key_q, key_bias = jax.random.split(jax.random.fold_in(key, expansion))
        aims = jax.random.uniform(key_bias) < GOAL_BIAS
        target = jnp.where(aims, q_goal, sample_configurations(world, key_q, 1)[0])
        among = (jnp.arange(_CAPACITY) < size)[None]
        nearest = nodes[jnp.argmin(world.distances(nodes, target[None], among)[0])]
        # The sub-steps from there to the target, and how many of them come before a collision.
        edge = world.edge(nearest, target)
        num = jnp.minimum(world.parts(edge, _SUB_STEPS), _SUB_STEPS)
        points = jax.vmap(
            lambda f: world.normalize(world.end(nearest, world.truncate(edge, f)))
        )(step / num)  # fmt: skip
        passed = _free_steps(world, points, num)
        # All of these become nodes.
        slot = jnp.where(step <= passed, size + step - 1, _CAPACITY)
        nodes = nodes.at[slot].set(points, mode="drop")
        return nodes, size + passed, expansion + 1, aims & (passed == num)

    state = (nodes, jnp.int32(1), jnp.int32(0), jnp.array(False))
    return jax.lax.while_loop(goes_on, expand, state)[3]


def _free_steps(world: GridWorld, points: jax.Array, num: jax.Array) -> jax.Array:
    """How many of the first ``num`` () points (S, D) come before the first that collides.

    :func:`vrrt_jax.core.edges.free_prefix` checks all sub-steps of many edges in one batch. Here
    is a single edge, most of whose sub-steps lie behind the first collision: chunks are faster.
    """

    def goes_on(state):
        checked, passed = state
        return (checked == passed) & (checked < num)

    def check(state):
        checked, passed = state
        free = jax.vmap(world.is_free)(jax.lax.dynamic_slice_in_dim(points, checked, _CHUNK))
        free &= checked + jnp.arange(1, _CHUNK + 1) <= num
        return checked + _CHUNK, passed + jnp.sum(jnp.cumprod(free))

    return jax.lax.while_loop(goes_on, check, (jnp.int32(0), jnp.int32(0)))[1]
