"""The exact check sees what it must, and says what touches what."""

import dataclasses
import time

import numpy as np
import pytest

from vrrt_jax.robots import load_robot, mesh_sources
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import contacts, verify_path

GEOMETRIES = ("meshes", "spheres")

PENDULUM = """
<mujoco>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="swing" axis="0 0 1" limited="false"/>
      <geom type="box" size="0.2 0.02 0.02" pos="0.25 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(params=GEOMETRIES)
def geometry(request, panda):
    if request.param == "meshes" and mesh_sources.mesh_file(panda.mesh_source) is None:
        pytest.skip("the Panda's meshes are not installed (mujoco-menagerie or genesis-world)")
    return request.param


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "pendulum.xml"
    path.write_text(PENDULUM)
    return load_robot(path)


def swing(panda, start, end):
    """Two waypoints that differ in joint 1 only."""
    path = np.tile(panda.home, (2, 1))
    path[:, 0] = start, end
    return path


FLOOR = Obstacle(name="floor", kind="plane", position=(0, 0, 0))
FAR = Obstacle(name="far", kind="cylinder", position=(-0.7, 0, 0.5), size=(0.05, 0.2, 0))
POST = Obstacle(name="post", kind="box", position=(0.55, 0, 0.5), size=(0.05, 0.03, 0.4))


def test_free_path_passes(panda, geometry):
    result = verify_path(panda, [FLOOR, FAR], swing(panda, -1, 1), geometry=geometry)
    assert result.ok and result.contact is None
    assert result.geometry == geometry
    assert result.checked == 401
    assert 0.05 < result.clearance < 0.6


def test_path_through_a_box_is_caught_and_named(panda, geometry):
    result = verify_path(panda, [FLOOR, POST], swing(panda, -1, 1), geometry=geometry)
    assert not result.ok
    assert result.clearance <= 0
    words = str(result.contact).split()
    assert words[0] in {"link5", "link6", "link7", "hand", "left_finger", "right_finger"}
    assert words[1:4] == ["touches", "post", "at"]
    assert 20 < int(words[4]) < 50


def test_thin_obstacle_between_way_points_is_caught(panda, geometry):
    sheet = dataclasses.replace(POST, name="sheet", size=(0.3, 0.001, 0.4))
    free_ends = swing(panda, -1, 1)
    for q in free_ends:
        assert contacts(panda, [sheet], q, geometry=geometry) == []
    result = verify_path(panda, [sheet], free_ends, geometry=geometry)
    assert not result.ok and "touches sheet" in str(result.contact)


def test_self_collision_is_caught(panda, geometry):
    folded = panda.home.copy()
    folded[[1, 3, 5]] = -1.5, -3.0, 0.5
    (first, *_) = contacts(panda, [], folded, geometry=geometry)
    assert "touches" in first
    result = verify_path(panda, [], np.stack([panda.home, folded]), geometry=geometry)
    assert not result.ok and "touches" in str(result.contact)
    assert np.isnan(result.clearance)


def test_limits_are_caught(panda, geometry):
    path = swing(panda, 0, 2.8973 * 1.25)
    result = verify_path(panda, [], path, geometry=geometry)
    assert not result.ok
    contact = str(result.contact)
    assert contact.startswith("joint1 = 2.9")
    assert contact.endswith("is outside [-2.8973, 2.8973] at 80 % of the path")
    on_the_limit = swing(panda, 0, np.float32(2.8973))
    assert verify_path(panda, [], on_the_limit, geometry=geometry).ok


def test_base_may_stand_on_the_floor_but_links_may_not_touch_it(panda, geometry):
    assert contacts(panda, [FLOOR], panda.home, geometry=geometry) == []
    low = panda.home.copy()
    low[1], low[3] = 1.7, -0.5
    found = contacts(panda, [FLOOR], low, geometry=geometry)
    assert found and all(line.endswith("touches floor") for line in found)


def test_single_way_point_is_checked(panda, geometry):
    result = verify_path(panda, [FLOOR], panda.home[None], geometry=geometry)
    assert result.ok and result.checked == 1


def test_meshes_and_spheres_agree_on_clearance(panda):
    if mesh_sources.mesh_file(panda.mesh_source) is None:
        pytest.skip("the Panda's meshes are not installed (mujoco-menagerie or genesis-world)")
    path = swing(panda, -1, 1)
    exact, covered = (
        verify_path(panda, [FLOOR, FAR], path, geometry=geometry).clearance
        for geometry in GEOMETRIES
    )
    assert covered <= exact + 1e-4  # spheres contain the meshes
    assert covered > exact - 0.05


def test_auto_takes_spheres_without_meshes(panda, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", "")
    monkeypatch.setattr(mesh_sources.importlib.util, "find_spec", lambda name: None)
    # obstacles of their own, or the model of another test would be found in the cache
    obstacle = dataclasses.replace(FAR, name="unseen")
    assert verify_path(panda, [obstacle], panda.home[None]).geometry == "spheres"
    with pytest.raises(ValueError, match="meshes of robot 'panda' are not on this machine"):
        verify_path(panda, [obstacle], panda.home[None], geometry="meshes")


def test_wrapping_joint_takes_the_short_way(pendulum):
    behind = Obstacle(name="behind", kind="box", position=(-0.3, 0, 1), size=(0.05, 0.05, 0.05))
    ahead = dataclasses.replace(behind, name="ahead", position=(0.3, 0, 1))
    path = np.array([[3.0 - 0.7], [-3.0 + 0.7]])  # 1.7 rad through pi
    assert "arm touches behind" in str(verify_path(pendulum, [behind], path).contact)
    free = verify_path(pendulum, [ahead], path)
    assert free.ok and free.checked == int(np.ceil((2 * np.pi - 4.6) / 0.005)) + 1
    assert verify_path(pendulum, [ahead], path + 2 * np.pi).ok


@pytest.mark.parametrize("turn", [np.pi, np.float32(np.pi), -np.pi, -np.float32(np.pi)])
def test_half_a_turn_goes_the_way_it_is_written(pendulum, turn):
    for side in (1.0, -1.0):
        box = Obstacle(name="box", kind="box", position=(0, 0.3 * side, 1), size=(0.05, 0.05, 0.05))
        found = verify_path(pendulum, [box], np.array([[0.0], [turn]]))
        assert found.ok == (side != np.sign(turn))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('pos="0.25 0 0"', 'pos="0.25 0 0" contype="1" conaffinity="0"'),
        ("<mujoco>", '<mujoco><option><flag contact="disable" constraint="disable"/></option>'),
    ],
)
def test_no_setting_of_a_file_hides_a_contact(tmp_path, old, new):
    (tmp_path / "arm.xml").write_text(PENDULUM.replace(old, new))
    robot = load_robot(tmp_path / "arm.xml")
    post = Obstacle(name="post", kind="box", position=(0, 0.4, 1), size=(0.05, 0.05, 0.2))
    for kind in GEOMETRIES:
        result = verify_path(robot, [post], np.array([[0.0], [3.0]]), geometry=kind)
        assert not result.ok and "post" in str(result.contact), kind


def test_a_robot_whose_file_has_moved_is_checked_by_its_spheres(tmp_path):
    (tmp_path / "arm.xml").write_text(PENDULUM)
    robot = load_robot(tmp_path / "arm.xml")
    (tmp_path / "arm.xml").unlink()
    result = verify_path(robot, [FAR], np.array([[0.1], [0.2]]))
    assert result.ok and result.geometry == "spheres"


def test_files_own_geometry_is_the_truth(pendulum):
    """A box arm: the corner of its covering spheres touches where the box does not."""
    close = Obstacle(name="close", kind="sphere", position=(0.25, 0.0, 1.03), size=(0.009, 0, 0))
    assert contacts(pendulum, [close], np.zeros(1)) == []
    assert contacts(pendulum, [close], np.zeros(1), geometry="spheres") == ["arm touches close"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('joint name="joint7"', 'joint name="j"'), None),  # addressed by order
        (('pos="0 0 0.333"', 'pos="0 0 0.350"'), "are placed 0.0170 m away"),
        (('body name="hand"', 'body name="claw"'), "have no body hand; have: link0, link1"),
    ],
)
def test_meshes_of_another_robot_are_refused(panda, tmp_path, change, message):
    """The committed spheres play the meshes of some other version."""
    path = tmp_path / "meshes.xml"
    path.write_text(panda.xml.replace(*change))
    robot = dataclasses.replace(panda, mesh_source=str(path))
    if message is None:
        assert contacts(robot, [], robot.home, geometry="meshes") == []
        return
    with pytest.raises(ValueError, match=message):
        contacts(robot, [], robot.home, geometry="meshes")


def test_typical_path_is_verified_in_time(panda):
    obstacles = [
        dataclasses.replace(FAR, name=f"post {k}", position=(-0.7, 0.1 * k, 0.5)) for k in range(8)
    ]
    path = swing(panda, -1, 1)
    verify_path(panda, obstacles, path)
    started = time.perf_counter()
    assert verify_path(panda, obstacles, path).ok
    assert time.perf_counter() - started < 1.0  # 0.03 s on an idle machine


@pytest.mark.parametrize(
    ("path", "arguments", "message"),
    [
        (np.zeros((2, 6)), {}, r"shape \(2, 6\); expected \(waypoints, 7\).*joint1, joint2"),
        (np.zeros((0, 7)), {}, r"shape \(0, 7\)"),
        (np.full((2, 7), np.nan), {}, "waypoint 0 of the path is not finite"),
        (np.zeros((2, 7)), {"step": 0.0}, "step is 0.0; expected a positive"),
        (np.zeros((2, 7)), {"geometry": "mesh"}, "expected one of: auto, meshes, spheres"),
    ],
)
def test_bad_arguments(panda, path, arguments, message):
    with pytest.raises(ValueError, match=message):
        verify_path(panda, [], path, **arguments)


@pytest.mark.parametrize(
    ("obstacles", "message"),
    [
        ([dataclasses.replace(POST, kind="cone")], "'post' is a 'cone'; expected one of: sphere"),
        ([dataclasses.replace(POST, size=(0, 0, 0))], "do not compile.*size"),
        ([POST, POST], "used more than once: post; expected distinct"),
    ],
)
def test_bad_obstacles(panda, obstacles, message):
    with pytest.raises(ValueError, match=message):
        verify_path(panda, obstacles, panda.home[None], geometry="spheres")
