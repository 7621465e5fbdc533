"""From a tree to a configuration beside it: the cheapest free edge, or RRT-Connect."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edge_checks import free_prefix, num_checks
from vrrt_jax.core.planners import RRTConnect
from vrrt_jax.core.search import SearchResult, StopReason, make_termination, search
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.visual.join import connect, join

Q_LEFT = np.array([1.0, 0.6, 0.0, -1.6, 0.0, 2.2, 0.8], np.float32)  # of the wall, beside it
Q_RIGHT = np.array([-1.0, 0.6, 0.0, -1.6, 0.0, 2.2, 0.8], np.float32)
CONFIG = vrrt_jax.PlannerConfig()
KEY = jax.random.key(0)


def is_path_free(world, path):
    steps = num_checks(world, 3.0)
    edge = world.edge(jnp.asarray(path[:-1]), jnp.asarray(path[1:]))
    return bool(jnp.all(free_prefix(world, jnp.asarray(path[:-1]), edge, steps)[0] == steps))


def grown(world, iterations):
    """The search of a plain RRT from the left of the wall, which aims at nothing."""
    policy = vrrt_jax.RRT.for_world(world, goal_bias=0.0)
    goal = vrrt_jax.ConfigurationGoal(q=jnp.asarray(Q_RIGHT))
    return search(
        world,
        goal,
        policy,
        policy.init(world, goal, Q_LEFT[None], 4096),
        key=KEY,
        termination=make_termination(-np.inf, max_iterations=iterations),
    )


def test_the_goal_becomes_a_child_of_the_node_it_costs_least_through(wall_world):
    found = grown(wall_world, 24)
    tree, size = found.tree, int(found.tree.size)
    q = np.asarray(tree.q[:size])
    goal = q[-1] + np.float32(0.1) * np.sign(Q_LEFT - q[-1])
    assert bool(wall_world.is_free(jnp.asarray(goal)))
    after, way = join(wall_world, RRTConnect.for_world(wall_world), found, goal, KEY, CONFIG)
    assert way is not None and way.tree_share == 1.0 and after.search_s >= found.search_s
    np.testing.assert_array_equal(way.path[0], Q_LEFT)
    np.testing.assert_array_equal(way.path[-1], goal)
    assert is_path_free(wall_world, way.path)
    # No other node with a free edge would be cheaper.
    through = np.asarray(tree.cost[:size]) + np.linalg.norm(q - goal, axis=1)
    assert path_length(wall_world, way.path) <= through[-1] + 1e-4
    cheaper = np.flatnonzero(through < path_length(wall_world, way.path) - 1e-3)
    for node in cheaper[np.argsort(through[cheaper])][:20]:
        assert not is_path_free(wall_world, np.stack([q[node], goal]))


@pytest.mark.parametrize("iterations", [0, 3])
def test_where_no_edge_is_free_rrt_connect_goes_on_from_the_tree(wall_world, iterations):
    found = grown(wall_world, iterations)
    _, way = join(wall_world, RRTConnect.for_world(wall_world), found, Q_RIGHT, KEY, CONFIG)
    assert way is not None and is_path_free(wall_world, way.path)
    assert 0.0 <= way.tree_share < 1.0
    old = {row.tobytes() for row in np.asarray(found.tree.q[: int(found.tree.size)])}
    shared = [row.tobytes() in old for row in way.path]
    assert shared[0] and sorted(shared, reverse=True) == shared
    along = path_length(wall_world, way.path[: sum(shared)]) if sum(shared) > 1 else 0.0
    assert way.tree_share == pytest.approx(along / path_length(wall_world, way.path), abs=1e-5)


def test_rrt_connect_takes_over_what_a_path_leads_to(wall_world):
    q = np.stack([Q_LEFT, Q_RIGHT, Q_LEFT + 0.1, Q_RIGHT + 0.1, Q_LEFT + 0.2]).astype(np.float32)
    tree = trees.create(q, jnp.zeros(5), None, 16, trees.root_costs(5))
    step = wall_world.distance(jnp.asarray(q[0]), jnp.asarray(q[2]))
    # 0 -> 2 -> 4, and 1 -> 3, to which no path is known
    parent = tree.parent.at[jnp.array([2, 3, 4])].set(jnp.array([0, 1, 2]))
    cost = tree.cost.at[jnp.array([2, 3, 4])].set(jnp.array([step, 1e3 + step, 2 * step]))
    tree = vrrt_jax.Tree(**{**vars_of(tree), "parent": parent, "cost": cost})
    goal = vrrt_jax.ConfigurationGoal(q=jnp.asarray(Q_RIGHT))
    forest = RRTConnect.for_world(wall_world).init_from(wall_world, goal, tree, 64)
    assert int(forest.size) == 4
    np.testing.assert_array_equal(forest.q[:4], np.stack([Q_LEFT, Q_RIGHT, q[2], q[4]]))
    assert forest.parent[:4].tolist() == [-1, -1, 0, 2]
    np.testing.assert_allclose(forest.cost[:4], [0, 0, step, 2 * step], rtol=1e-6)
    assert forest.payload.side[:4].tolist() == [0, 1, 0, 0]
    assert forest.payload.meets[:4].tolist() == [-1] * 4


def vars_of(tree):
    return {name: getattr(tree, name) for name in tree.__dataclass_fields__}


def test_a_goal_behind_walls_has_no_way(slider):
    box = vrrt_jax.Obstacle(name="box", kind="box", position=(0, 0, 0), size=(0.05, 0.05, 0.05))
    world = vrrt_jax.build_world(slider, [box], engine="closed_form")
    tree = trees.create(jnp.float32([[-0.5]]), jnp.zeros(1), None, 8)
    found = SearchResult(
        tree=tree, stopped=StopReason.CONVERGED, history=np.zeros((1, 6)), compile_s=0, search_s=0
    )
    few = CONFIG.changed({"tree.lanes": 4, "tree.capacity": 64, "budget.connect_iterations": 5})
    goal = np.array([0.5], np.float32)
    assert join(world, RRTConnect.for_world(world), found, goal, KEY, few)[1] is None
    assert connect(world, RRTConnect.for_world(world), found, goal, KEY, few)[1] is None
