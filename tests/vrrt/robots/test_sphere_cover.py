"""Spheres of the quick covers contain what they cover."""

import itertools
import tracemalloc

import mujoco
import numpy as np
import pytest

from vrrt_jax.robots.bounded_cover import cover_within
from vrrt_jax.robots.convex_parts import contain_surface, piece_of
from vrrt_jax.robots.geom_pieces import collision_pieces, solid
from vrrt_jax.robots.sphere_cover import (
    MAX_BULGE,
    cover_convex_parts,
    cover_geom,
    cover_primitives,
)


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


def shapes(text):
    """A model of one moving body with these geoms."""
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><body><joint/>{text}</body></worldbody></mujoco>"
    )


def signed_distance(model, points):
    """Of points (n, 3) to the nearest geom, (n,), negative inside; boxes and round shapes."""
    found = []
    for geom in range(model.ngeom):
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        x = (points - model.geom_pos[geom]) @ rotation.reshape(3, 3)
        size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom]).name[7:]
        along = np.stack([np.linalg.norm(x[:, :2], axis=1), np.abs(x[:, 2])], axis=1)
        if kind == "BOX":
            over = np.abs(x) - size
        elif kind == "CYLINDER":
            over = along - size[:2]
        elif kind == "CAPSULE":
            over = along - [0, size[1]]
        else:
            raise AssertionError(kind)
        outside = np.linalg.norm(np.maximum(over, 0), axis=1)
        distance = outside + np.minimum(over.max(axis=1), 0)
        found.append(distance - (size[0] if kind == "CAPSULE" else 0))
    return np.min(found, axis=0)


BOX_AND_CAPSULE = (
    '<geom type="box" size=".04 .04 .04"/><geom type="capsule" size=".05" fromto="0 0 0 0 0 1.5"/>'
)
LONG = '<geom type="capsule" size=".03" fromto="0 0 0 0 0 .6"/>'


@pytest.mark.parametrize(
    "text",
    [
        LONG,
        '<geom type="capsule" size=".002 .6"/>',
        '<geom type="cylinder" size=".02" fromto="0 0 0 1 0 0"/>',
        '<geom type="cylinder" size=".25 .004"/>',
        '<geom type="box" size=".2 .1 .003" euler="10 20 30"/>',
        '<geom type="box" size=".02 .02 4"/>',
        BOX_AND_CAPSULE,
        LONG
        + '<geom type="box" size=".1 .1 .01" pos=".3 0 .2"/><geom type="cylinder" size=".2 .3"/>',
        '<geom type="box" size=".001 .002 .004"/><geom type="capsule" size=".001 .005"/>',
    ],
)
def test_covers_contain_any_shape_and_stick_out_by_no_more_than_3_cm(rng, text):
    model = shapes(text)
    spheres = cover_convex_parts(model)
    ball = rng.normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    on_spheres = (spheres.center[:, None] + spheres.radius[:, None, None] * ball).reshape(-1, 3)
    low, high = on_spheres.min(axis=0), on_spheres.max(axis=0)
    extent = np.max(high - low)
    assert signed_distance(model, on_spheres).max() <= min(MAX_BULGE, 0.2 * extent) + 1e-9
    # Points near the surface: those inside the shape are inside a sphere.
    near = on_spheres[rng.choice(len(on_spheres), 4000)] * rng.uniform(0.5, 1, (4000, 1))
    points = np.concatenate([near, rng.uniform(low, high, (20_000, 3))])
    points = points[np.abs(signed_distance(model, points) + 0.01 * extent) < 0.01 * extent]
    assert len(points) > 50
    gap = np.linalg.norm(points[:, None] - spheres.center, axis=2) - spheres.radius
    assert gap.min(axis=1).max() <= 1e-9


def test_fine_and_flat_meshes_are_covered(rng):
    """A needle of 40,000 faces would swell if its hull were made simpler carelessly."""
    angle, t = np.meshgrid(np.linspace(0, 2 * np.pi, 200), np.linspace(0, np.pi, 100))
    needle = np.stack(
        [0.01 * np.cos(angle) * np.sin(t), 0.01 * np.sin(angle) * np.sin(t), 0.5 * np.cos(t)], -1
    ).reshape(-1, 3)
    sheet = rng.uniform(-0.1, 0.1, (30, 3)) * [1, 1, 0]
    for points in (needle, sheet):
        found = cover_within([piece_of(solid(points))], 0.03, rng, most=100)
        assert found is not None
        spheres_center, radius = found
        gap = np.linalg.norm(points[:, None] - spheres_center, axis=2) - radius
        assert gap.min(axis=1).max() <= 1e-9
        # A sphere's farthest point from the shape is at least so far from the nearest point of it.
        near = np.linalg.norm(points[:, None] - spheres_center, axis=2).min(axis=0)
        assert np.max(radius - near) <= 0.03 + 2e-3


def test_memory_of_a_proof_is_bounded(rng):
    """Of a box and a capsule that stick out of few small spheres: 24 GB once."""
    model = shapes(BOX_AND_CAPSULE)
    (pieces,) = collision_pieces(model).values()
    tracemalloc.start()
    center = np.array([[0, 0, 0.2], [0, 0, 1.3]])
    center, radius = contain_surface(pieces, center, np.full(2, 0.02), leaf=3e-4)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3e8
    tip = np.linalg.norm([0, 0, 1.55] - center, axis=1) - radius
    assert tip.min() <= 0
