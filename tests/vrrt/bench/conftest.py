"""Files of problems for the benchmark of joint goals."""

import numpy as np
import pytest
from arm_cases import AWAY, GOAL, POST, arrays_of, fingertips


@pytest.fixture(scope="module")
def arrays(panda):
    """Three problems: a post in between, a can in the fingers at the goal, an invalid one."""
    cans = [AWAY, fingertips(panda, GOAL), AWAY]
    valid = np.array([True, True, False])
    return arrays_of(panda, [POST] * 3, cans, vamp_valid=valid)


@pytest.fixture
def write(tmp_path):
    """Write a file of problems."""

    def to_file(arrays, name="posts"):
        np.savez(tmp_path / f"{name}.npz", **arrays)
        return tmp_path / f"{name}.npz"

    return to_file
