"""Difficulty of homes, and homes that are neither too hard nor too easy."""

import jax
import numpy as np
import pytest

from nrp_jax import build_world, load_robot
from nrp_jax.homes import houses
from nrp_jax.homes.grid import Grid
from nrp_jax.learning.difficulty import FAIR, difficulty, fair_house, is_solved, long_queries


def empty_room(side: int = 100) -> Grid:
    occupied = np.zeros((side, side, 1), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    return Grid(occupied=occupied)


def test_difficulty_of_an_empty_room_and_of_a_closed_one():
    robot = load_robot("snake")
    assert difficulty(robot, empty_room(), num=4) >= 0.75
    closed = empty_room()
    closed.occupied[49:51] = True
    world = build_world(robot, closed)
    starts, goals = long_queries(robot, world, closed, 3, 0)
    assert ((starts[:, 0] < 5) == (goals[:, 0] < 5)).all()
    assert (np.linalg.norm(starts[:, :2] - goals[:, :2], axis=1) > 4).all()
    across = starts[0].copy()
    across[0] = 10 - across[0]
    assert not is_solved(world, starts[0], across, jax.random.key(0))
    with pytest.raises(ValueError, match="too small"):
        difficulty(robot, empty_room(40), num=2)


def test_a_home_that_is_too_hard_is_replaced():
    robot = load_robot("snake")
    first, taken = houses.generate_house(2), fair_house(robot, 2)
    low, high = FAIR
    assert not low <= difficulty(robot, first.plan()) <= high
    assert low <= difficulty(robot, taken.plan()) <= high
    assert fair_house(load_robot("fetch"), 2).seed == 2
