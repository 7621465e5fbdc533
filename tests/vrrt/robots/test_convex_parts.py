"""Convex pieces contain their geoms, and spheres grow until they contain the pieces."""

import mujoco
import numpy as np

from vrrt_jax.robots import convex_parts, geom_pieces


def test_piece_contains_every_round_geom():
    """The polytope around a sphere, a capsule, a cylinder and an ellipsoid contains it."""
    sizes = {"sphere": "0.1", "capsule": "0.1 0.2", "cylinder": "0.1 0.2", "ellipsoid": ".1 .2 .3"}
    geoms = "".join(
        f'<body pos="0 0 {k}"><geom type="{kind}" size="{size}"/></body>'
        for k, (kind, size) in enumerate(sizes.items())
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ends = np.sign(directions[:, 2:]) * [[0, 0, 0.2]]
    rim = np.hstack([directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1)[:, None], ends])
    surfaces = {
        "sphere": 0.1 * directions,
        "capsule": 0.1 * directions + ends,
        "cylinder": np.stack([0.1 * rim[:, 0], 0.1 * rim[:, 1], ends[:, 2]], -1),
        "ellipsoid": directions * [0.1, 0.2, 0.3],
    }
    for (body, (piece,)), kind in zip(
        geom_pieces.collision_pieces(model).items(), sizes, strict=True
    ):
        depth = piece.depth(surfaces[kind])
        assert depth.min() > -1e-9, kind
        assert depth.min() < 0.026 * 0.3, (body, kind)


def test_grow_takes_the_worst_point_in_by_the_nearest_sphere():
    distance = np.array([[1.0, 3.0], [2.0, 5.5], [5.0, 4.0]])
    np.testing.assert_allclose(convex_parts.grow(distance, np.array([1.0, 1.0])), [2.0, 4.0])
    np.testing.assert_allclose(convex_parts.grow(distance, np.array([5.0, 1.0])), [5.0, 1.0])


def test_contain_surface_closes_every_gap(rng):
    """Two balls in a box, far too small: they grow until the box is inside."""
    box = convex_parts.piece_of(rng.uniform(-0.1, 0.1, (60, 3)))
    centers, radii = convex_parts.contain_surface(
        [box], np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]]), np.full(2, 0.05), leaf=1e-3
    )
    surface = convex_parts.surface_samples([box], 0.001, rng)
    gap = np.linalg.norm(surface[:, None] - centers, axis=-1) - radii
    assert gap.min(1).max() <= 0
    assert radii.max() < 0.2
