"""Drives along the floor with a folded arm, and searches from both ends to them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.planners.by_drive import COST, MOST, search_by_drive
from nrp_jax.planners.drive import FOLDED, LENGTH, find_drive, folded_postures
from nrp_jax.planners.nrp_connect import NRPConnect
from nrp_jax.scene.exact import ExactScene
from vrrt_jax.core.search import StopReason, make_termination
from vrrt_jax.core.shortcut import path_length
from vrrt_jax.core.types import pytree

pytestmark = pytest.mark.light_compilation
START = np.array([1.2, 1.2, 0.5, 0.2, 1.0, 0.2, 0.0, 0.4, 0.0, 0.3, 0.0], np.float32)
GOAL = np.array([4.0, 1.2, -2.0, 0.3, -1.0, 0.3, 0.0, 0.5, 0.0, 0.2, 0.0], np.float32)


@pytree
class Unasked:
    """A sampler that is never asked: drives do."""

    def propose(self, world, q_from, q_goal, key):
        """See the samplers."""
        raise AssertionError


def rooms(door: bool = True) -> nrp_jax.Grid:
    """Two rooms, with a door of one meter or without."""
    occupied = np.zeros((52, 40, 20), bool)
    occupied[25:27] = True
    if door:
        occupied[25:27, 25:35] = False
    return nrp_jax.Grid(occupied=occupied)


@pytest.fixture(scope="module")
def world():
    return nrp_jax.build_world(nrp_jax.load_robot("fetch"), rooms())


@pytest.fixture(scope="module")
def folded():
    return folded_postures("fetch")


@pytest.fixture(scope="module")
def solve(world, folded):
    return functools.partial(search, world, START, GOAL, folded)


def search(world, start, goal, folded, iterations):
    """A search by drive, which never asks its sampler."""
    goal = nrp_jax.ConfigurationGoal(q=jnp.asarray(goal))
    policy = NRPConnect(sampler=Unasked(), straight_iterations=1000)
    return search_by_drive(
        world,
        goal,
        policy,
        policy.init(world, goal, start[None], 4096),
        folded=folded,
        key=jax.random.key(0),
        termination=make_termination(policy.goal_score(goal), max_iterations=iterations),
        time_limit_s=60.0,
    )


def test_folded_postures_keep_close_and_touch_nothing_of_the_robot(folded):
    assert len(folded.arm) > 20 and np.ptp(folded.reach) <= FOLDED
    assert folded.reach.min() >= 0.28 and folded.top.min() > 1.0  # the base, and the head
    robot = nrp_jax.load_robot("fetch")
    scene = ExactScene(robot, nrp_jax.Grid(occupied=np.zeros((40, 40, 20), bool)))
    for arm in folded.arm[::20]:
        assert not scene.touching(np.concatenate([[2.0, 2.0, 0.0], arm]))


def test_the_snake_slides_folded_and_its_ends_are_joined():
    robot, grid, folded = nrp_jax.load_robot("snake"), rooms().flatten(), folded_postures("snake")
    world = nrp_jax.build_world(robot, grid)
    # Half of the base's diagonal; the arm alone is 0.72 m long.
    assert len(folded.arm) > 20 and 0.106 < folded.reach.min() <= folded.reach.max() < 0.2
    start, goal = (
        np.concatenate([q[:2], turns]).astype(np.float32)
        for q, turns in ((START, [0.5, 0, 0, 0.4, 0, 0]), (GOAL, [-2, 0, 1, 0, 0, 0]))
    )
    drive = find_drive(world, folded, start, goal)
    assert drive is not None and drive.shape == (LENGTH, 8)
    np.testing.assert_allclose(drive[[0, -1], :2], [start[:2], goal[:2]], atol=1e-6)
    assert 2.5 < drive[np.abs(drive[:, 0] - 2.6).argmin(), 1] < 3.5
    # Short searches do, the sampler is not asked, and the same key gives the same path.
    (found, path), (_, again) = (search(world, start, goal, folded, 1000) for _ in range(2))
    assert int(found.tree.iteration) <= 2 * MOST
    assert path is not None
    np.testing.assert_array_equal(path[[0, -1]], [start, goal])
    np.testing.assert_array_equal(path, again)


@pytest.mark.parametrize("rank", [0, 1000])
def test_a_drive_is_free_and_goes_through_the_door(world, folded, rank):
    drive = find_drive(world, folded, START, GOAL, rank=rank)
    assert drive is not None and drive.shape == (LENGTH, 11)
    assert np.ptp(drive[:, 3:], axis=0).max() == 0
    np.testing.assert_allclose(drive[[0, -1], :3], [START[:3], GOAL[:3]], atol=1e-6)
    through = drive[np.abs(drive[:, 0] - 2.6).argmin()]
    assert 2.5 < through[1] < 3.5
    part = np.linspace(0, 1, 5, dtype=np.float32)[:, None]
    between = world.interpolate(drive[None, :-1], drive[None, 1:], part).reshape(-1, 11)
    assert np.all(nrp_jax.batch_is_free(world, between))


def test_the_nearest_posture_is_taken_first(world, folded):
    near, far = (find_drive(world, folded, START, GOAL, rank=rank) for rank in (0, 40))

    def away(drive):
        ends = np.stack([START, GOAL])[:, 3:]
        turns = np.asarray(world.is_continuous)[3:]
        step = drive[0, 3:] - ends
        return np.linalg.norm(step - 2 * np.pi * np.round(step / (2 * np.pi)) * turns, axis=1).sum()

    assert away(near) < away(far)


def test_there_is_no_drive_through_a_wall(world, folded):
    walled = nrp_jax.scene.world.with_grid(world, rooms(door=False))
    assert find_drive(walled, folded, START, GOAL) is None


def test_a_path_by_drive_joins_both_ends_and_is_free(solve, world):
    found, path = solve(iterations=1000)
    assert found.stopped is StopReason.REACHED
    np.testing.assert_array_equal(path[[0, -1]], [START, GOAL])
    part = np.linspace(0, 1, 9, dtype=np.float32)[:, None]
    between = world.interpolate(path[None, :-1], path[None, 1:], part).reshape(-1, 11)
    assert np.all(nrp_jax.batch_is_free(world, between))
    # All searches are one: its history, its tree of two forests, and the length of its path.
    history = found.history
    assert history[0, 0] == 0 and history[-1, 0] == int(found.tree.iteration) <= 8 * MOST
    assert np.all(np.diff(history[:, [0, 1, 3, 5]], axis=0) >= 0)
    assert history[-1, 1] <= found.search_s and history[0, 1] > 0
    assert history[-1, COST] == pytest.approx(path_length(world, path), rel=1e-5)
    assert np.all(np.isinf(history[:-1, COST]))
    assert int(found.tree.size) > 2 * LENGTH


def test_a_budget_ends_it_before_both_ends_come_to_the_drive(solve):
    found, path = solve(iterations=1)
    assert path is None and int(found.tree.iteration) == 1
    assert np.isinf(found.history[-1, COST])
