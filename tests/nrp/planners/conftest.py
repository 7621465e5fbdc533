"""What tests of planners share."""

import numpy as np
import pytest

import nrp_jax


@pytest.fixture(scope="module")
def snake():
    return nrp_jax.load_robot("snake")


@pytest.fixture(scope="module")
def home(snake):
    """Two rooms and a door of one meter."""
    occupied = np.zeros((50, 40), bool)
    occupied[24:26] = True
    occupied[24:26, 25:35] = False
    grid = nrp_jax.Grid(occupied=occupied)
    return grid, nrp_jax.build_world(snake, grid)
