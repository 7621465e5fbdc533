"""Odometry of a path: integrated, it leads along the path again."""

import numpy as np
import pytest

import nrp_jax
from nrp_jax.scene.odometry import odometry

pytestmark = pytest.mark.light_compilation


@pytest.fixture(scope="module")
def world():
    grid = nrp_jax.Grid(occupied=np.zeros((40, 40, 20), bool), origin=(100.0, -50.0, 0.0))
    return nrp_jax.build_world(nrp_jax.load_robot("fetch"), grid)


def test_wheels_and_motors_lead_along_the_path(world):
    rng = np.random.default_rng(0)
    path = np.concatenate(
        [
            rng.uniform([101, -49, -3], [103, -47, 3], (6, 3)),
            rng.uniform(0.05, 0.3, (6, 1)),
            rng.uniform(-1, 1, (6, 7)),
        ],
        axis=1,
    )
    path[3, :3] = path[2, :3]  # an edge that only moves the arm
    numbers = odometry(world, path)
    assert numbers.shape[1] == 10 and len(numbers) <= 5 * 5 + 1
    # Along each piece, driving is an arc or a line.
    x, y = path[0, :2]
    for step, heading in zip(np.diff(numbers, axis=0), numbers[:-1, 1], strict=True):
        driven, turned = step[:2]
        chord = driven * np.sinc(turned / 2 / np.pi)
        x, y = x + chord * np.cos(heading + turned / 2), y + chord * np.sin(heading + turned / 2)
    np.testing.assert_allclose([x, y], path[-1, :2], atol=1e-3)
    wrapped = np.angle(np.exp(1j * (numbers[-1, 1:] - path[-1, 2:])))
    np.testing.assert_allclose(wrapped, 0, atol=1e-4)


def test_a_path_of_one_waypoint_stays(world):
    q = np.array([102.0, -48.0, 1.0, 0.1, 0, 0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(odometry(world, q[None]), [[0, *q[2:]]])
