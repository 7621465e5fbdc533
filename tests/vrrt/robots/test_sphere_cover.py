"""Spheres of the quick covers contain what they cover."""

import itertools

import mujoco
import numpy as np
import pytest

from vrrt_jax.robots import convex_parts
from vrrt_jax.robots.sphere_cover import cover_body, cover_geom, cover_primitives


@pytest.mark.parametrize(
    ("kind", "size"),
    [("BOX", (0.06, 0.0125, 0.0)), ("BOX", (0.06, 0.066, 0.044)), ("CAPSULE", (0.06, 0.1, 0))],
)
def test_spheres_cover_their_geom(rng, kind, size):
    size = np.array(size, float)
    center, radius = cover_geom(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), size, 0.03)
    if kind == "BOX":
        points = rng.uniform(-size, size, (5000, 3))
        corners = size * np.array(list(itertools.product((-1, 1), repeat=3)))
        points = np.concatenate([points, corners])
    else:
        ball = rng.normal(size=(5000, 3))
        ball *= size[0] / np.linalg.norm(ball, axis=1, keepdims=True)
        points = ball + np.outer(rng.uniform(-size[1], size[1], 5000), [0, 0, 1])
    gap = np.linalg.norm(points[:, None] - center, axis=2) - radius
    assert gap.min(axis=1).max() < 1e-9
    assert radius.max() < np.sort(size)[-2] + 0.04


def test_other_geoms_are_refused():
    with pytest.raises(ValueError, match="mjGEOM_CYLINDER: expected spheres, capsules and boxes"):
        cover_geom(mujoco.mjtGeom.mjGEOM_CYLINDER, np.ones(3), 0.1)


def test_primitives_are_covered_in_their_bodies_frames(rng):
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body pos="1 2 3">
        <geom type="box" size=".1 .05 .02" pos=".3 0 0" euler="0 0 90"/>
        <geom type="sphere" size=".2" pos="0 .5 0"/></body></worldbody></mujoco>"""
    )
    spheres, geom = cover_primitives(model, np.arange(2), np.array([0.05, 0.05]))
    assert geom.tolist() == [0, 0, 1] and spheres.body.tolist() == [1, 1, 1]
    # The box lies along y of its body after its turn.
    np.testing.assert_allclose(
        spheres.center, [[0.3, -0.05, 0], [0.3, 0.05, 0], [0, 0.5, 0]], atol=1e-9
    )
    flat, _ = cover_primitives(model, np.arange(1), np.array([0.05]), planar=True)
    np.testing.assert_allclose(flat.radius, np.hypot(0.05, 0.05))


def test_greedy_spheres_contain_a_body_and_stick_out_little(rng):
    box = convex_parts.piece_of(
        np.stack(np.meshgrid([-0.2, 0.2], [-0.1, 0.1], [-0.1, 0.1]), -1).reshape(-1, 3)
    )
    centers, radii = cover_body([box], 0.02, rng)
    surface = convex_parts.surface_samples([box], 0.003, rng)
    gap = np.linalg.norm(surface[:, None] - centers, axis=-1) - radii
    assert gap.min(axis=1).max() <= 1e-9
    sticks_out = radii - box.depth(centers)
    assert np.median(sticks_out) < 0.03 and sticks_out.max() < 0.08
