"""Execution times: of a drive by its formula, of legs and their ratios by hand, and the command."""

import numpy as np
import pytest

import nrp_jax
from nrp_jax.bench.execution import ratios, times
from nrp_jax.scene.execution_time import BASE_LIMITS, RISE_S, execution_time

pytestmark = pytest.mark.light_compilation
Q = np.array([0.5, 1.0, 0.0, 0.1, 0, 0, 0, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def fetch():
    return nrp_jax.load_robot("fetch")


@pytest.fixture(scope="module")
def floor():
    return nrp_jax.Grid(occupied=np.zeros((40, 40, 20), bool))


def test_a_drive_takes_what_its_limits_say(fetch, floor):
    world = nrp_jax.build_world(fetch, floor)
    ahead, turned = Q.copy(), Q.copy()
    ahead[0] += 3.0
    (fast, faster), _ = BASE_LIMITS
    there = 3.0 / fast + fast / faster + RISE_S
    assert execution_time(world, np.stack([Q, ahead])) == pytest.approx(there, rel=1e-3)
    # There and back, with a stop in between, and around a corner, with one or without.
    back = np.stack([Q, ahead, Q])
    assert execution_time(world, back) == pytest.approx(2 * there, rel=1e-3)
    beside = ahead.copy()
    beside[1] += 2.0
    around = [execution_time(world, np.stack([Q, ahead, beside]), t) for t in (0.01, 0.0)]
    assert there < 0.98 * around[1] and 0.5 * around[1] < around[0] < 0.98 * around[1]
    # The arm may move meanwhile; alone the slowest joint decides, the torso at 0.1 m/s.
    turned[0], turned[3], turned[4] = ahead[0], 0.3, 0.2
    assert execution_time(world, np.stack([Q, turned])) == pytest.approx(there, rel=1e-3)
    turned[0] = Q[0]
    lifted = 0.2 / 0.1 + 0.1 / 0.5 + RISE_S
    assert execution_time(world, np.stack([Q, turned])) == pytest.approx(lifted, rel=1e-2)
    assert execution_time(world, Q[None]) == 0.0


def test_times_and_ratios_of_legs():
    def row(planner, leg, seconds):
        return {"planner": planner, "query": leg, "solved": seconds > 0, "execution_s": seconds}

    rows = [row("a", 0, 2.0), row("a", 0, 4.0), row("a", 1, 5.0), row("b", 0, 6.0), row("b", 1, 0)]
    found = times(rows, ("a", "b", "c"), ("x", "y"), "execution_s")
    np.testing.assert_array_equal(found, [[3, 6, np.nan], [5, np.nan, np.nan]])
    assert ratios(found[:, :2], ("a", "b")) == {"a / b": 0.5}
    assert ratios(found, ("a", "b", "c")) == {"a / c": None, "b / c": None}
