"""Quickened paths: proposals lead to where the path led, and what comes out is quicker and free."""

import dataclasses

import jax
import numpy as np
import pytest

import nrp_jax
from nrp_jax.scene.execution_time import rough_time, time_along
from nrp_jax.scene.odometry import configurations_along, odometry, poses_along
from nrp_jax.scene.wide_turns import propose
from nrp_jax.scene.world import TURNING_RADIUS
from vrrt_jax.core.result import Status

pytestmark = pytest.mark.light_compilation
REST = (0.02, 1.1708, 1.4708, -0.4, 1.6708, 0.0, 1.5708, 0.0)


def configuration(x, y, heading, arm=REST):
    return np.array([x, y, heading, *arm])


# From room to room, with two waypoints in the door; the arm moves first, and at the end.
RAISED = (0.1, *REST[1:-1], 0.8)
PATH = np.stack(
    [
        configuration(0.8, 1.0, 0.5, RAISED),
        configuration(0.8, 1.0, 0.5),
        configuration(1.2, 2.6, 1.0),
        configuration(2.0, 3.0, 0.0),
        configuration(2.8, 2.6, -1.2),
        configuration(3.2, 1.0, -2.0),
        configuration(3.2, 1.0, -2.0, RAISED),
    ]
)


@pytest.fixture(scope="module")
def fetch():
    return nrp_jax.load_robot("fetch")


@pytest.fixture(scope="module")
def grid():
    """A wall across the room, with a door."""
    occupied = np.zeros((40, 40, 20), bool)
    occupied[19:21] = True
    occupied[19:21, 26:35] = False
    return nrp_jax.Grid(occupied=occupied, origin=(0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def steps(fetch, grid):
    return np.diff(odometry(nrp_jax.build_world(fetch, grid), PATH), axis=0)


def test_proposals_lead_to_the_end_of_the_path(steps):
    rng, poses = np.random.default_rng(0), poses_along(PATH[0, :3], steps)
    drawn = [propose(steps, poses, TURNING_RADIUS, rng) for _ in range(2000)]
    drawn = [proposal for proposal in drawn if proposal is not None]
    assert len(drawn) > 200
    for proposal in drawn:
        new = proposal.steps
        end = poses_along(PATH[0, :3], new)[-1]
        np.testing.assert_allclose(end[:2], poses[-1, :2], atol=1e-4)
        assert np.cos(end[2] - poses[-1, 2]) > 1 - 1e-8
        np.testing.assert_allclose(new[:, 2:].sum(0), steps[:, 2:].sum(0), atol=1e-6)
        # No turn is tighter than the smallest, and the arm moves on its own where it did.
        assert np.all(np.abs(new[:, 0]) >= TURNING_RADIUS * np.abs(new[:, 1]) * (1 - 1e-4))
        np.testing.assert_array_equal(new[[0, -1]], steps[[0, -1]])


def test_the_rough_time_is_nearly_the_time(steps):
    rng = np.random.default_rng(0)
    for scale in (0.2, 1.0, 3.0):
        trial = steps * rng.uniform(0.5, scale + 0.5, (len(steps), 1))
        corners = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(trial, axis=0)])
        assert rough_time(trial) == pytest.approx(time_along(corners), rel=0.1)


def test_a_quickened_path_is_quicker_and_free(fetch, grid):
    quick = nrp_jax.quicken(fetch, grid, PATH, key=jax.random.key(0), proposals=3000)
    assert quick.verification.ok and quick.duration_s < 0.75 * quick.planned_s
    assert quick.duration_s == pytest.approx(time_along(quick.corners))
    np.testing.assert_allclose(quick.trajectory[0], PATH[0], atol=1e-6)
    np.testing.assert_allclose(quick.trajectory[-1], PATH[-1], atol=1e-4)
    along = configurations_along(PATH[0], np.diff(quick.corners, axis=0))
    np.testing.assert_allclose(quick.trajectory, along, atol=1e-6)
    # While the base drives the arm rests, as on the path.
    drives = np.linalg.norm(np.diff(quick.trajectory[:, :2], axis=0), axis=1) > 1e-6
    assert drives.sum() > 100
    np.testing.assert_allclose(np.diff(quick.trajectory[:, 3:], axis=0)[drives], 0, atol=1e-6)


def test_what_cannot_be_quickened_is_refused(fetch, grid):
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="no base that drives"):
        nrp_jax.quicken(nrp_jax.load_robot("snake"), grid.flatten(), np.zeros((2, 8)), key=key)
    through = PATH[[1, 5]]
    with pytest.raises(ValueError, match="not free: .* touches the map"):
        nrp_jax.quicken(fetch, grid, through, key=key, proposals=10)
    result = nrp_jax.plan(fetch, grid, PATH[1], PATH[1], key=key, planner="rrt")
    assert nrp_jax.quicken(fetch, grid, result, key=key).duration_s == 0
    failed = dataclasses.replace(result, status=Status.NO_PATH)
    with pytest.raises(ValueError, match="ended as NO_PATH"):
        nrp_jax.quicken(fetch, grid, failed, key=key)
