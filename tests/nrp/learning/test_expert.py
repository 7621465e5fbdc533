"""The expert against plain loops: edges, shortest paths, and what the rows say."""

import heapq

import jax
import numpy as np
import pytest

from nrp_jax import batch_is_free, build_world, load_robot
from nrp_jax.homes.grid import Grid
from nrp_jax.homes.houses import generate_house
from nrp_jax.learning import expert
from nrp_jax.learning import roadmap as roadmaps
from nrp_jax.learning.edge_check import check_edges
from nrp_jax.learning.roadmap import build_roadmap
from nrp_jax.scene.robots import batch_link_features

NODES, QUERIES, WAYPOINTS = 900, 20, 8
TOLERANCE = 1e-4  # of lengths in float32, relative


@pytest.fixture(scope="module")
def robot():
    return load_robot("snake")


@pytest.fixture(scope="module")
def world(robot):
    return build_world(robot, generate_house(3).grid)


@pytest.fixture(scope="module")
def roadmap(robot, world):
    return build_roadmap(world, robot, jax.random.key(0), NODES)


@pytest.fixture(scope="module")
def rows(robot, world, roadmap):
    rng = np.random.default_rng(0)
    return expert.make_rows(world, robot, roadmap, rng, QUERIES, WAYPOINTS)


def between(world, a, b, fractions):
    """Configurations (n, D) on the straight edge from a to b."""
    step = b - a
    turns = np.where(np.asarray(world.is_continuous), np.round(step / (2 * np.pi)), 0)
    return a + np.asarray(fractions)[:, None] * (step - 2 * np.pi * turns)


def path_lengths(roadmap, goal):
    """Length of the shortest path (N,) from every node to a goal, by a plain Dijkstra."""
    lengths = np.full(len(roadmap.q), np.inf)
    lengths[goal] = 0
    queue = [(0.0, goal)]
    while queue:
        length, node = heapq.heappop(queue)
        if length > lengths[node]:
            continue
        row = slice(*roadmap.lengths.indptr[node : node + 2])
        for other, edge in zip(
            roadmap.lengths.indices[row], roadmap.lengths.data[row], strict=True
        ):
            if length + edge < lengths[other]:
                lengths[other] = length + edge
                heapq.heappush(queue, (length + edge, other))
    return lengths


def test_edges_as_a_plain_loop_finds_them(world, roadmap, rng):
    pairs = rng.integers(0, len(roadmap.q), (4000, 2))
    near = np.abs(np.diff(roadmap.q[pairs][..., :2], axis=1)).max((1, 2)) < 1.0
    pairs = pairs[near][:60].astype(np.int32)
    length, free = check_edges(world, roadmap.q, pairs)
    assert 0 < free.sum() < len(pairs) == 60
    for (a, b), found, far in zip(roadmap.q[pairs], free, length, strict=True):
        step = between(world, a, b, [1.0])[0] - a
        parts = 1
        while np.abs(step).max() / parts > float(world.resolution):
            parts += 1
        points = between(world, a, b, np.arange(1, parts) / parts)
        padded = np.concatenate([points, np.tile(a, (64 - len(points), 1))])
        assert found == bool(np.asarray(batch_is_free(world, padded)).all())
        metric = np.linalg.norm(step[:2]) + 0.167 * np.linalg.norm(step[2:])
        assert far == pytest.approx(metric, rel=TOLERANCE)


def test_edges_are_free_at_finer_steps_too(world, roadmap):
    a, b = roadmap.lengths.nonzero()
    chosen = np.random.default_rng(1).choice(len(a), 100, replace=False)
    fine = [
        between(world, roadmap.q[a[i]], roadmap.q[b[i]], np.linspace(0, 1, 160)) for i in chosen
    ]
    free = np.asarray(batch_is_free(world, np.concatenate(fine).astype(np.float32)))
    # Between checks 0.1 apart a corner may be grazed: rarely.
    assert free.reshape(100, -1).all(1).mean() > 0.85
    assert free.mean() > 0.99


def test_roadmap(robot, world, roadmap):
    q, lengths = roadmap.q, roadmap.lengths
    assert 0.5 * NODES < len(q) <= NODES
    assert np.asarray(batch_is_free(world, q)).all()
    assert not np.asarray(batch_is_free(world, roadmap.colliding)).any()
    assert abs(lengths - lengths.T).max() == 0
    a, b = lengths.nonzero()
    assert np.abs(q[a, :2] - q[b, :2]).max() < 2.0
    tips = np.asarray(batch_link_features(robot, q))[:, :, :2]
    assert np.abs(tips[b] - q[a, None, :2]).max() < 2.0
    assert np.isfinite(path_lengths(roadmap, 0)).all()


def test_candidates_are_the_pairs_with_the_least_change_of_posture(robot, world, roadmap):
    everything = roadmaps._neighbors(world, robot, roadmap.q)
    few = roadmaps.CANDIDATES
    try:
        roadmaps.CANDIDATES = 10
        chosen = roadmaps._neighbors(world, robot, roadmap.q)
    finally:
        roadmaps.CANDIDATES = few
    assert len(chosen) == 5 * len(roadmap.q) < len(everything)

    def change(pairs):
        step = between(world, roadmap.q[pairs[:, 0]], roadmap.q[pairs[:, 1]], np.ones(len(pairs)))
        return np.linalg.norm((step - roadmap.q[pairs[:, 0]])[:, 2:], axis=1)

    assert change(chosen).max() <= np.partition(change(everything), len(chosen))[len(chosen)] + 1e-3


def test_rows_say_what_the_shortest_paths_are(world, roadmap, rows):
    index = {q.tobytes(): i for i, q in enumerate(roadmap.q)}
    assert len(rows.ratio) == QUERIES * WAYPOINTS == len(rows.query)
    assert (np.bincount(rows.query) == WAYPOINTS).all()
    known = 0
    for query in range(QUERIES):
        of = np.flatnonzero(rows.query == query)
        start, goal = index[rows.q_start[of[0]].tobytes()], index[rows.q_goal[of[0]].tobytes()]
        assert start != goal and (rows.q_start[of] == rows.q_start[of[0]]).all()
        cost = path_lengths(roadmap, goal)
        assert rows.length[of] == pytest.approx(cost[start], rel=TOLERANCE)
        best = index[rows.optimal[of[0]].tobytes()]
        assert rows.ratio[of[0]] == pytest.approx(1, rel=TOLERANCE)
        assert roadmap.lengths[start, best] + cost[best] == pytest.approx(
            cost[start], rel=TOLERANCE
        )
        for row in of:
            node = index.get(rows.waypoint[row].tobytes())
            if node is None:
                assert np.isinf(rows.ratio[row])
                assert not batch_is_free(world, rows.waypoint[row][None])[0]
            elif edge := roadmap.lengths[start, node]:
                known += 1
                assert rows.ratio[row] == pytest.approx((edge + cost[node]) / cost[start], 1e-3)
    assert known > QUERIES * WAYPOINTS / 3


def test_rows_are_of_all_sorts(rows):
    ratio = rows.ratio
    assert (ratio <= expert.GOOD_RATIO).mean() > 0.2
    assert ((ratio > expert.GOOD_RATIO) & np.isfinite(ratio)).mean() > 0.15
    assert np.isinf(ratio).mean() > 0.15
    apart = np.linalg.norm(rows.q_goal[:, :2] - rows.q_start[:, :2], axis=1)
    assert apart.min() < 2 < apart.max()
    assert np.abs(rows.waypoint[:, :2] - rows.q_start[:, :2]).max() < 2.0


def test_a_wall_with_a_door_is_passed_through_the_door(robot):
    occupied = np.zeros((40, 40, 1), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[19:21, :28] = True
    world = build_world(robot, Grid(occupied=occupied))
    roadmap = build_roadmap(world, robot, jax.random.key(1), 600)
    cost = path_lengths(
        roadmap, int(np.argmin(np.linalg.norm(roadmap.q[:, :2] - [3.2, 0.8], axis=1)))
    )
    behind = np.linalg.norm(roadmap.q[:, :2] - [0.8, 0.8], axis=1).argsort()[:5]
    # Around the end of the wall at y = 2.8, there and back.
    assert (cost[behind] > 2 * np.hypot(1.1, 1.8)).all()


def test_betweenness_of_a_chain_with_a_twig():
    # 0 - 1 - 2 - 3 and 1 - 4, towards the goals 0 and 3.
    cost = np.array([[0, 1, 2, 3, 2], [3, 2, 1, 0, 3]], float)
    step = np.array([[-9999, 0, 1, 2, 1], [1, 2, 3, -9999, 1]])
    assert expert.betweenness(cost, step).tolist() == [4, 5, 4, 4, 0]


def test_a_home_that_is_full(robot):
    world = build_world(robot, Grid(occupied=np.ones((30, 30, 1), bool)))
    with pytest.raises(ValueError, match="only 0 of .* are free"):
        build_roadmap(world, robot, jax.random.key(0), 500)
