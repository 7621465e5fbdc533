"""The descent that fits spheres to a body."""

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


def test_a_sphere_may_begin_on_a_point_that_it_covers(rng, monkeypatch):
    monkeypatch.setattr(sphere_fit, "_STEPS", 3)
    points = rng.uniform(-0.1, 0.1, (12, 3))
    samples = sphere_fit.BodySamples(
        surface=points,
        inside=points,
        num_surface=12,
        outside=points + 0.3,
        ball=np.full(12, 0.04),
        cell=1e-6,
    )
    ((center, radius),) = sphere_fit._descended(samples, points[None, :1], np.full((1, 1), 0.1))
    assert np.isfinite(center).all() and np.isfinite(radius).all()
