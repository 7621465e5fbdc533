"""One search by RRT-Connect around the wall, for all tests of the kernel."""

import pytest
from core_cases import connect


@pytest.fixture(scope="session")
def connected(wall_world):
    return connect(wall_world, 0)
