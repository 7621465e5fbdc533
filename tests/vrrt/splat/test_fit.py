"""A self-model is trained on MuJoCo's images, goes on after an interruption, and looks right."""

import dataclasses

import numpy as np
import pytest

from vrrt_jax.robots import load_robot
from vrrt_jax.robots.mesh_sources import mesh_spec
from vrrt_jax.splat import fit
from vrrt_jax.splat.camera import orbit
from vrrt_jax.splat.model import load_self_model
from vrrt_jax.splat.mujoco_images import MeshRenderer

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="base">
      <geom type="cylinder" size="0.1 0.05" pos="0 0 0.05" rgba="0.2 0.4 0.8 1"/>
      <body name="upper" pos="0 0 0.1">
        <joint name="lift" axis="0 1 0" range="-120 120"/>
        <geom type="capsule" size="0.04 0.15" pos="0 0 0.2" rgba="0.9 0.9 0.9 1"/>
        <body name="hand" pos="0 0 0.4">
          <joint name="turn" axis="0 0 1" range="-170 170"/>
          <geom type="box" size="0.02 0.08 0.05" pos="0 0 0.05" rgba="0.9 0.3 0.1 1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SMALL = fit.LevelConfig(num_splats=90, size_px=32, steps=120, batch=2)
CONFIG = fit.FitConfig(
    num_images=30,
    num_surface_images=20,
    num_validation=6,
    image_px=64,
    levels=(SMALL,),
    close_up=dataclasses.replace(SMALL, num_splats=70),
    close_up_of_px=128,
)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "arm.xml"
    path.write_text(ARM)
    robot = load_robot(path)
    spec = mesh_spec(robot)
    assert spec is not None
    try:
        MeshRenderer(spec).check()
    except RuntimeError as error:
        pytest.skip(str(error))
    return robot, spec


def test_too_large_an_image_is_refused(arm):
    robot, spec = arm
    camera = orbit(azimuth_deg=0, elevation_deg=-20, distance=2.0, height=600, width=1100)
    with pytest.raises(ValueError, match="1100x600 px is too large .* at most 1024"):
        MeshRenderer(spec).picture(robot.lower, camera)


def test_a_small_self_model_is_trained_and_resumed(arm, tmp_path, monkeypatch):
    robot, spec = arm
    path = tmp_path / "arm.npz"
    fit_level, calls = fit._fit_level, []

    def interrupted(*args):
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return fit_level(*args)

    monkeypatch.setattr(fit, "_fit_level", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit.fit_self_model(robot, spec, path, seed=0, config=CONFIG)
    with pytest.raises(ValueError, match="unfinished training of another robot, seed"):
        fit.fit_self_model(robot, spec, path, seed=1, config=CONFIG)
    other = dataclasses.replace(robot, xml=robot.xml + " ")
    with pytest.raises(ValueError, match="unfinished training of another robot"):
        fit.fit_self_model(other, spec, path, seed=0, config=CONFIG)

    restored, rendered = [], []
    restore, render_images = fit._restore, fit.render_images
    monkeypatch.setattr(fit, "_restore", lambda *a: restored.append(a[0].name) or restore(*a))
    monkeypatch.setattr(
        fit, "render_images", lambda *a, **k: rendered.append(k) or render_images(*a, **k)
    )
    model = fit.fit_self_model(robot, spec, path, seed=0, config=CONFIG)
    assert len(restored) == 1 and not rendered  # the level and the images that were done
    assert not path.with_name("arm.npz.work").exists()
    assert model.levels[0].psnr_db > 22 and model.close_up.psnr_db > 18
    assert load_self_model(path).close_up.match_threshold == model.close_up.match_threshold


def test_close_ups_show_the_outermost_link(arm):
    robot, spec = arm
    _, points = fit.render_images(robot, spec, CONFIG, 20, 0, 20)
    link, middle = tip = fit.outermost(points)
    assert link == 2
    np.testing.assert_allclose(middle, [0, 0, 0.05], atol=0.02)
    images, _ = fit.render_images(robot, spec, CONFIG, 20, 1, tip=tip)
    assert images.rgb.shape == (20, 32, 32, 3)
    red = (images.rgb[..., 0] > 1.5 * images.rgb[..., 2]).mean(axis=(1, 2))
    assert np.mean(red > 0.03) > 0.7  # the hand, but where the arm hides it
