"""One roadmap of a snake's home for the tests of edge checks, roadmaps and the expert."""

import jax
import pytest

from nrp_jax import build_world, load_robot
from nrp_jax.homes.houses import generate_house
from nrp_jax.learning.roadmap import build_roadmap

NODES = 900


@pytest.fixture(scope="session")
def robot():
    return load_robot("snake")


@pytest.fixture(scope="session")
def world(robot):
    return build_world(robot, generate_house(3).grid)


@pytest.fixture(scope="session")
def roadmap(robot, world):
    return build_roadmap(world, robot, jax.random.key(0), NODES)
