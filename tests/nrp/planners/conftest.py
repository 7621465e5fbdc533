"""What tests of planners share."""

import pytest
from nrp_synthetic import two_rooms

import nrp_jax


@pytest.fixture(scope="module")
def snake():
    return nrp_jax.load_robot("snake")


@pytest.fixture(scope="module")
def home(snake):
    grid = two_rooms()
    return grid, nrp_jax.build_world(snake, grid)
