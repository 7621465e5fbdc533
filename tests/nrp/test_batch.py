"""Many plans in homes at once."""

import jax
import numpy as np
import pytest
from nrp_synthetic import two_rooms

import nrp_jax

KEY = jax.random.key(3)
STARTS = np.array([[1.0, 1, 0.6, 1, -0.8, 1, -0.8, 0.9], [1.5, 1.2, 0, 0, 0, 0, 0, 0]])
GOALS = np.array([[4.0, 1, -0.6, 0.5, 0.5, 0.5, 0.5, 0.5], [3.5, 3.0, 1, 0, 0, 0, 0, 0]])


@pytest.fixture(scope="module")
def snake():
    return nrp_jax.load_robot("snake")


@pytest.fixture(scope="module")
def home():
    return two_rooms()


def test_plans_are_those_of_single_calls(snake, home):
    options = {"method": "rrt-connect", "capacity": 2048}
    results = nrp_jax.plan_batch(snake, home, STARTS, GOALS, key=KEY, **options)
    for i, result in enumerate(results):
        assert result.ok
        single = nrp_jax.plan(
            snake, home, STARTS[i], GOALS[i], key=jax.random.fold_in(KEY, i), **options
        )
        np.testing.assert_array_equal(result.path, single.path)


def test_what_makes_no_sense_is_named(snake, home):
    walled = GOALS.copy()
    walled[1, :2] = 2.5, 1.0  # in the wall
    for starts, goals, told in (
        (STARTS, walled, "problem 1: .*goal"),
        (STARTS, GOALS[:1], "got 2 starts, 1 goals and 2 homes"),
        (STARTS[:0], GOALS[:0], "one at least"),
    ):
        with pytest.raises(ValueError, match=told):
            nrp_jax.plan_batch(snake, home, starts, goals, key=KEY)
