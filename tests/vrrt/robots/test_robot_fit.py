"""Spheres contain what they stand for, and do not claim much more."""

import dataclasses

import mujoco
import numpy as np
import pytest

from vrrt_jax.robots import (
    convex_parts,
    geom_pieces,
    load_robot,
    mesh_sources,
    robot_fit,
    sphere_descent,
    sphere_fit,
)
from vrrt_jax.robots.robot_spheres import spheres_of
from vrrt_jax.scene.sphere_errors import measure_spheres

# Bounds on false alarms, against obstacles and itself; measured at 10,000 configurations, seed 0:
# 1.2 and 1.2 %, 2.2 and 3.8 %, 1.0 and 4.0 %.
FALSE_ALARMS = {"panda": (0.01, 0.01), "ur5e": (0.015, 0.025), "fetch": (0.01, 0.03)}
SELF_MISSES = 0.01  # 0.000, 0.001, 0.006

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="base">
      <geom type="box" size="0.1 0.1 0.05" pos="0 0 -0.05"/>
      <body name="upper" pos="0 0 0.05">
        <joint name="lift" axis="0 1 0" range="-150 150"/>
        <geom type="cylinder" size="0.04 0.15" pos="0 0 0.2"/>
        <body name="fore" pos="0 0 0.4">
          <joint name="bend" axis="0 1 0" range="-170 170"/>
          <geom type="box" size="0.03 0.02 0.12" pos="0 0 0.17"/>
          <geom type="capsule" size="0.02 0.04" pos="0 0 0.3" euler="0 90 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def panda_meshes(panda):
    spec = mesh_sources.mesh_spec(panda, visuals=False)
    if spec is None:
        pytest.skip("the Panda's meshes are not installed (mujoco-menagerie or genesis-world)")
    return spec.compile()


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "arm.xml"
    path.write_text(ARM)
    return load_robot(path)


def true_model(robot):
    spec = mesh_sources.mesh_spec(robot, visuals=False)
    assert spec is not None
    return spec.compile()


def uncovered(model, bodies, robot, rng):
    """Largest distance [m] of a surface point of the model from the robot's collision spheres."""
    found = spheres_of(mujoco.MjModel.from_xml_string(robot.xml)).collision
    own = mujoco.MjModel.from_xml_string(robot.xml)
    worst = -np.inf
    for body, shape in geom_pieces.collision_pieces(model).items():
        if body not in bodies:
            continue
        mine = found.body == own.body(model.body(body).name).id
        surface = convex_parts.surface_samples(shape, 0.002, rng)
        gap = np.linalg.norm(surface[:, None] - found.center[mine], axis=-1) - found.radius[mine]
        worst = max(worst, gap.min(1).max())
    return worst


@pytest.mark.parametrize("name", FALSE_ALARMS)
def test_spheres_miss_nothing_and_rarely_cry_wolf(name):
    robot = load_robot(name)
    if mesh_sources.mesh_file(robot.mesh_source) is None:
        pytest.skip(f"the meshes of {name} are not installed")
    report = measure_spheres(robot, num=2500, seed=11)
    assert report.obstacles.colliding > 150
    assert report.obstacles.misses == 0
    for counts, bound in zip(
        (report.obstacles, report.self_collision), FALSE_ALARMS[name], strict=True
    ):
        assert counts.false_alarm_rate < bound
    assert report.self_collision.miss_rate < SELF_MISSES


def test_panda_spheres_contain_the_whole_surface(panda, panda_meshes, rng):
    moving = np.flatnonzero(panda_meshes.body_weldid)
    # half a step of rounding, in MuJoCo's placement of meshes too
    assert uncovered(panda_meshes, moving, panda, rng) < 1e-5


def test_spheres_fitted_on_loading_contain_the_geometry(arm, rng):
    model = true_model(arm)
    assert uncovered(model, [2, 3], arm, rng) <= 1e-9
    report = measure_spheres(arm, num=2000, seed=1)
    assert report.obstacles.misses == 0
    assert report.self_collision.colliding > 40
    assert report.self_collision.miss_rate < 0.02
    assert report.self_collision.false_alarm_rate < 0.1


def test_fit_spheres_writes_a_robot(arm, tmp_path, monkeypatch, rng):
    monkeypatch.setattr(robot_fit, "_CONFIGURATIONS", 2000)
    monkeypatch.setattr(robot_fit, "_MOVES", 2)
    monkeypatch.setattr(sphere_descent, "STEPS", 60)
    for name, value in (("_STARTS", 2), ("_NUM_OUTSIDE", 600), ("_NUM_INSIDE", 1500)):
        monkeypatch.setattr(sphere_fit, name, value)
    lines = []
    xml = robot_fit.fit_spheres(arm, num_spheres=5, progress=lines.append)
    assert lines
    path = tmp_path / "fitted.xml"
    path.write_text(xml)
    robot = load_robot(path)
    assert len(robot.collision_sphere_bodies) == 5
    # The base and the arm's end may touch; each has a sphere for every 5 cm.
    assert set(robot.self_collision_sphere_bodies) == {"base", "fore"}
    assert robot.mesh_source == arm.mesh_source
    model = true_model(arm)
    assert uncovered(model, [2, 3], robot, rng) <= 1e-9
    report = measure_spheres(robot, num=1000, seed=1)
    assert report.obstacles.misses == 0
    with pytest.raises(ValueError, match="num_spheres is 1; expected at least one for each of"):
        robot_fit.fit_spheres(arm, num_spheres=1)


def test_meshes_are_needed_to_fit_and_to_measure(panda, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", "")
    monkeypatch.setattr(mesh_sources.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="cannot fit spheres: the meshes of robot 'panda'"):
        robot_fit.fit_spheres(panda)
    with pytest.raises(ValueError, match="meshes of robot 'panda' are not on this machine"):
        measure_spheres(panda, num=20, seed=99)


def test_report_counts(arm):
    few = measure_spheres(arm, num=10, seed=2)  # fewer than there are scenes
    assert few.obstacles.colliding + few.obstacles.free == 10
    report = measure_spheres(arm, num=200, seed=2)
    assert report.num == 200 and report.seed == 2
    for counts in (report.obstacles, report.self_collision):
        assert counts.colliding + counts.free == 200
    none = dataclasses.replace(report.obstacles, colliding=0, free=0, misses=0, false_alarms=0)
    assert none.miss_rate == none.false_alarm_rate == 0.0
