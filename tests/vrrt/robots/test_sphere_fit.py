"""Spheres that are fitted to a body."""

import mujoco
import numpy as np

from vrrt_jax.robots import convex_parts, sphere_fit


def test_descent_beats_its_starts(rng):
    """Three spheres around a bar: fitted ones stick out less than those of the greedy cover."""
    bar = convex_parts.piece_of(
        np.stack(np.meshgrid([-0.15, 0.15], [-0.04, 0.04], [-0.04, 0.04]), -1).reshape(-1, 3)
    )
    xml = '<mujoco><worldbody><body><joint/><geom size=".1"/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    samples = sphere_fit.sample_bodies(model, {1: [bar]}, rng)[1]
    _, _, alarms = sphere_fit.fit_body(samples, 3, rng)
    # no three spheres of one radius on the axis do better than sqrt(0.05^2 + 2 * 0.04^2)
    centers = np.array([[-0.1, 0, 0], [0, 0, 0], [0.1, 0, 0]])
    gap = np.linalg.norm(samples.outside[:, None] - centers, axis=-1) - np.sqrt(0.0057)
    assert alarms < 1.05 * np.sum(gap.min(1) < samples.ball) * samples.cell


def test_a_sphere_that_others_can_do_without_halves_the_work_of_a_bad_one(rng):
    """The first of three spheres lies in the second; all alarms are around the third."""
    points = np.linspace([-0.2, 0, 0], [0.2, 0, 0], 81)
    samples = sphere_fit.BodySamples(
        surface=points,
        inside=points,
        num_surface=81,
        outside=points[41:] + [0, 0.12, 0],
        ball=np.full(40, 0.04),
        cell=1e-6,
    )
    center, radius = (
        np.array([[-0.15, 0, 0], [-0.1, 0, 0], [0.1, 0, 0]]),
        np.array([0.05, 0.1, 0.1]),
    )
    moved, smaller = sphere_fit._moved(samples, center, radius, rng)
    assert np.array_equal(moved[1], center[1]) and smaller[1] == radius[1]
    np.testing.assert_allclose((moved[0] + moved[2]) / 2, center[2])
    np.testing.assert_allclose(np.linalg.norm(moved[0] - moved[2]), radius[2])
    assert smaller[0] == smaller[2] < radius[2]
