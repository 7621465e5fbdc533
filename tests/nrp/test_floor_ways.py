"""Ways over the floor: through doors, and what planners make of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nrp_synthetic import two_rooms

import nrp_jax
from nrp_jax.planners.floor_ways import FAR, floor_ways

LEFT, RIGHT = (1.0, 1.0), (4.0, 1.0)  # of the wall at x = 2.5 m, whose door is at y = 3 m


@pytest.fixture(scope="module")
def snake():
    return nrp_jax.load_robot("snake")


def between(ways, a, b):
    q = jnp.zeros((2, 8)).at[:, :2].set(jnp.array([a, b]))
    return float(ways.between(q[0], q[1]))


def test_ways_lead_through_the_door(snake):
    ways = floor_ways(snake, nrp_jax.build_world(snake, two_rooms()))
    through = np.hypot(1.5, 2.0) * 2
    assert through < between(ways, LEFT, RIGHT) < 1.15 * through
    assert between(ways, LEFT, RIGHT) == pytest.approx(between(ways, RIGHT, LEFT), rel=1e-5)
    assert between(ways, LEFT, (1.0, 3.0)) == pytest.approx(2.0, abs=0.2)
    # In the wall counts as beside it, and beside the map as at its rim.
    assert between(ways, LEFT, (2.45, 1.0)) < 2.0
    assert np.isfinite(between(ways, LEFT, (-3.0, 9.0)))


def test_many_at_once_are_each_by_itself(snake):
    ways = floor_ways(snake, nrp_jax.build_world(snake, two_rooms()))
    q = jax.random.uniform(jax.random.key(0), (5, 8), maxval=5.0)
    table = ways.between(q[:, None], q[None, :3])
    assert table.shape == (5, 3)
    assert float(table[4, 2]) == float(ways.between(q[4], q[2]))


def test_a_closed_door_is_far(snake):
    home = two_rooms()
    closed = home.occupied.copy()
    closed[24:26] = True
    grid = dataclasses.replace(home, occupied=closed)
    assert between(floor_ways(snake, nrp_jax.build_world(snake, grid)), LEFT, RIGHT) == FAR


def test_a_map_without_floor_is_refused(snake):
    full = nrp_jax.Grid(occupied=np.ones((30, 30, 1), bool))
    with pytest.raises(ValueError, match="no place of the map has 0.3 m"):
        floor_ways(snake, nrp_jax.build_world(snake, full))


@pytest.mark.parametrize(("shape", "resolution"), [((900, 900), 0.05), ((200, 200), 0.2)])
def test_large_maps_are_refused(snake, shape, resolution):
    huge = nrp_jax.Grid(occupied=np.zeros((*shape, 1), bool), resolution=resolution)
    with pytest.raises(ValueError, match="free squares .* crop it"):
        floor_ways(snake, nrp_jax.build_world(snake, huge))


def test_fine_cells_make_no_smaller_squares(snake):
    fine = two_rooms()
    occupied = fine.occupied.repeat(2, axis=0).repeat(2, axis=1)
    fine = dataclasses.replace(fine, occupied=occupied, resolution=0.05)
    ways = floor_ways(snake, nrp_jax.build_world(snake, fine))
    assert float(ways.side) == pytest.approx(0.25)
    assert 4.6 < between(ways, LEFT, RIGHT) < 5.8


@pytest.mark.parametrize("method", ["nrp-d-floor", "nrp-g-floor", "nrp-star-g-floor"])
def test_planners_go_by_the_floor(snake, method):
    """Both ends are nearer to each other than to the door: the door is found even so."""
    q = np.zeros((2, 8), np.float32)
    q[:, :2], q[:, 2:] = (LEFT, RIGHT), (0.6, 1.0, -0.8, 1.0, -0.8, 0.9)
    run = {"key": jax.random.key(0), "method": method, "max_expansions": 300, "lanes": 10}
    result = nrp_jax.plan(snake, two_rooms(), q[0], q[1], goal_bias=0.1, **run)
    assert result.ok and result.verification.ok
