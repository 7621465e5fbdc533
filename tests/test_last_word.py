"""A few paths and configurations of the slow check :mod:`tests.slow.last_word`."""

import numpy as np
import pytest
from slow import last_word

import vrrt_jax
from nrp_jax.problems import load_problem
from vrrt_jax.robots.mesh_sources import mesh_file

pytestmark = pytest.mark.light_compilation


@pytest.fixture(scope="module", params=["panda", "snake"])
def place(request):
    if request.param == "snake":
        place = last_word.home_place("snake", load_problem("home_1").grid)
    else:
        robot = vrrt_jax.load_robot("panda")
        if mesh_file(robot.mesh_source) is None:
            pytest.skip("the meshes of the Panda are not installed")
        small = last_word.small_things(robot, np.random.default_rng(0))
        place = last_word.arm_place("panda", small, engines=("closed_form",))
    place.plan = lambda *_: None  # planned paths take long to come by
    return place


def test_no_path_is_called_free_that_touches_something(place):
    found = last_word.judge_paths(place, 40, seed=1)
    assert found["missed"] == 0 and found["refused_untouched"] == 0
    assert found["free"] > 5 and found["near"] > 0 and found["paths"] > found["free"]


def test_no_collision_is_missed_by_the_covers(place):
    found = last_word.judge_configurations(place, 1000, seed=1)
    (cover,) = (found[name] for name in place.covers)
    assert cover["missed"] == 0 and cover["free"] > 200 and cover["near"] > 5
    assert found["colliding"] > 50
