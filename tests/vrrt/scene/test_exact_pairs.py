"""How far apart two shapes are, as the exact checks measure it: no more than they are."""

import mujoco
import numpy as np
import pytest

import nrp_jax
import vrrt_jax
from nrp_jax.scene.exact import ExactScene
from vrrt_jax.scene.advance import NEAR, near_pairs
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.exact_pairs import boxes_to_meshes, measure_rightly

TOLERANCE = 1e-5  # [m]
FETCH = np.array([0, 0, 0, 0.2, 1.3, 1.4, -0.2, 1.5, 0.0, 1.66, 0.0])
SHAPES = {
    "box": "size='.02 .01 .015'",
    "cylinder": "size='.05 .03'",
    "capsule": "size='.03 .1'",
}


def test_the_round_base_is_as_far_from_a_corner_as_it_is(rng):
    """A cylinder and a box: what MuJoCo adds to their contact is off by millimeters."""
    occupied = np.zeros((60, 60, 20), bool)
    occupied[30:32, 30:34, 0:8] = True
    scene = ExactScene(nrp_jax.load_robot("fetch"), nrp_jax.Grid(occupied=occupied))
    radius = 0.28
    for _ in range(200):
        angle, gap = rng.uniform(0.05, np.pi / 2 - 0.05), rng.uniform(-0.003, 0.003)
        q = FETCH.copy()
        q[:2] = 3.0 - (radius + gap) * np.array([np.cos(angle), np.sin(angle)])
        q[2] = np.pi + angle  # the arm points away
        distance, bodies = scene.near(q)
        base = scene.model.body("base").id
        own = distance[(bodies == base).any(axis=1) & (bodies == 0).any(axis=1)]
        assert abs(own.min() - gap) < TOLERANCE


@pytest.mark.parametrize("name", SHAPES)
def test_boxes_are_as_near_as_another_routine_says(name, rng):
    """Of two boxes contacts tell no distance; of a box and a mesh of its corners they do."""
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><worldbody><body><freejoint/><geom type='{name}' {SHAPES[name]}/></body>"
        "</worldbody></mujoco>"
    )
    boxes_to_meshes(spec)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.03, 5e-4])
    model = spec.compile()
    model.geom_margin[:] = NEAR / 2
    measure_rightly(model)
    data, seen = mujoco.MjData(model), 0
    for _ in range(2000):
        turn = rng.normal(size=4)
        q = np.concatenate([rng.uniform(-0.1, 0.1, 3), turn / np.linalg.norm(turn)])
        distance, _ = near_pairs(model, data, q)
        apart = mujoco.mj_geomDistance(model, data, 0, 1, NEAR, None)
        if apart > 1e-4:
            assert abs(distance.min(initial=NEAR) - apart) < TOLERANCE
            seen += apart < NEAR
    assert seen > 20


def test_what_is_held_is_measured_rightly_too(panda, rng):
    """A held box and a box beside it."""
    sheet = vrrt_jax.Obstacle(
        name="sheet", kind="box", position=(0.5, 0, 0.3), size=(0.2, 0.2, 5e-4)
    )
    brick = vrrt_jax.Obstacle(
        name="brick", kind="box", position=(0, 0, 0.13), size=(0.03, 0.02, 0.015)
    )
    world = vrrt_jax.build_world(panda, [sheet], engine="closed_form")
    scene = exact_scene(panda, vrrt_jax.attach(world, brick, "hand"))
    held = int(scene.model.body_geomadr[scene.compiled.held_bodies[0]])
    standing, seen = int(scene.obstacle_geoms[0]), 0
    for _ in range(1500):
        q = np.clip(panda.home + rng.normal(0, 0.25, 7), panda.lower, panda.upper)
        distance, _ = scene.near(q)
        geoms = np.sort(scene.data.contact.geom, axis=1)
        own = distance[(geoms == sorted((held, standing))).all(axis=1)]
        apart = mujoco.mj_geomDistance(scene.model, scene.data, held, standing, NEAR, None)
        if apart > 1e-4:
            assert abs(own.min(initial=NEAR) - apart) < TOLERANCE
            seen += apart < NEAR
    assert seen > 10
