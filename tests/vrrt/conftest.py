"""A goal image of the Panda, rendered by its self-model: quick, and without OpenGL."""

import pytest
from pictures import Q_GOAL, picture

import vrrt_jax
from vrrt_jax.problems import self_model_path


@pytest.fixture(scope="session")
def self_model(panda):
    return vrrt_jax.load_self_model(self_model_path(panda))


@pytest.fixture(scope="session")
def camera():
    return vrrt_jax.load_problem("panda_posts").cameras[0]


@pytest.fixture(scope="session")
def image(panda, self_model, camera):
    return picture(panda, self_model, camera, Q_GOAL)


@pytest.fixture(scope="session")
def open_world(panda):
    ball = vrrt_jax.Obstacle(name="ball", kind="sphere", position=(0, 0.9, 0.9), size=(0.1, 0, 0))
    return vrrt_jax.build_world(panda, [ball], engine="closed_form")
