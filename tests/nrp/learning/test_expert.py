"""The expert against plain loops: shortest paths, and what the rows say."""

import numpy as np
import pytest
from nrp_synthetic import path_lengths

from nrp_jax import batch_is_free
from nrp_jax.learning import expert

QUERIES, WAYPOINTS = 20, 8
TOLERANCE = 1e-4  # of lengths in float32, relative


@pytest.fixture(scope="module")
def rows(robot, world, roadmap):
    rng = np.random.default_rng(0)
    return expert.make_rows(world, robot, roadmap, rng, QUERIES, WAYPOINTS)


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


def test_betweenness_of_a_chain_with_a_twig():
    # 0 - 1 - 2 - 3 and 1 - 4, towards the goals 0 and 3.
    cost = np.array([[0, 1, 2, 3, 2], [3, 2, 1, 0, 3]], float)
    step = np.array([[-9999, 0, 1, 2, 1], [1, 2, 3, -9999, 1]])
    assert expert.betweenness(cost, step).tolist() == [4, 5, 4, 4, 0]
