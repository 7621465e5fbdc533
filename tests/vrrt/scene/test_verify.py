"""The exact check sees what it must, and says what touches what."""

import dataclasses
import threading
import time

import mujoco
import numpy as np
import pytest

from vrrt_jax.robots import load_robot, mesh_sources, mjcf_writer
from vrrt_jax.scene import exact
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.obstacle_kinds import KINDS
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.verify import contacts, interpolate, verify_path

GEOMETRIES = ("meshes", "polytopes", "spheres")

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
    path = swing(panda, -1, 1)
    result = verify_path(panda, [FLOOR, FAR], path, geometry=geometry, measure_clearance=True)
    assert result.ok and result.contact is None
    assert result.geometry == geometry
    assert 0.05 < result.clearance < 0.6
    # Far from everything, few of the 401 configurations have to be looked at.
    assert 5 < result.checked < 201
    assert np.isnan(verify_path(panda, [FLOOR, FAR], path, geometry=geometry).clearance)


def test_path_through_a_box_is_caught_and_named(panda, geometry):
    path = swing(panda, -1, 1)
    result = verify_path(panda, [FLOOR, POST], path, geometry=geometry, measure_clearance=True)
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


def test_meshes_and_covers_agree_on_clearance(panda):
    if mesh_sources.mesh_file(panda.mesh_source) is None:
        pytest.skip("the Panda's meshes are not installed (mujoco-menagerie or genesis-world)")
    path = swing(panda, -1, 1)
    exact, tight, covered = (
        verify_path(panda, [FLOOR, FAR], path, geometry=kind, measure_clearance=True).clearance
        for kind in GEOMETRIES
    )
    assert covered <= exact + 1e-4 and tight <= exact + 1e-4  # both contain the meshes
    assert covered > exact - 0.05 and tight > exact - 0.01


def test_auto_takes_polytopes_without_meshes(panda, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", "")
    monkeypatch.setattr(mesh_sources.importlib.util, "find_spec", lambda name: None)
    exact.forget()  # or the model of another test would be found there
    assert verify_path(panda, [FAR], panda.home[None]).geometry == "polytopes"
    with pytest.raises(ValueError, match="meshes of robot 'panda' are not on this machine"):
        verify_path(panda, [FAR], panda.home[None], geometry="meshes")
    exact.forget()


def test_wrapping_joint_takes_the_short_way(pendulum):
    behind = Obstacle(name="behind", kind="box", position=(-0.3, 0, 1), size=(0.05, 0.05, 0.05))
    ahead = dataclasses.replace(behind, name="ahead", position=(0.3, 0, 1))
    path = np.array([[3.0 - 0.7], [-3.0 + 0.7]])  # 1.7 rad through pi
    assert "arm touches behind" in str(verify_path(pendulum, [behind], path).contact)
    assert verify_path(pendulum, [ahead], path).ok
    walk = interpolate(pendulum, path, 0.005)
    assert len(walk.q) == int(np.ceil((2 * np.pi - 4.6) / 0.005)) + 1
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


def test_a_robot_whose_file_has_moved_is_checked_by_its_polytopes(tmp_path):
    (tmp_path / "arm.xml").write_text(PENDULUM)
    robot = load_robot(tmp_path / "arm.xml")
    (tmp_path / "arm.xml").unlink()
    result = verify_path(robot, [FAR], np.array([[0.1], [0.2]]))
    assert result.ok and result.geometry == "polytopes"


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


def random_obstacles(rng, num):
    """Of all kinds; the planes lie below the robot."""
    for k in range(num):
        kind = list(KINDS)[k % len(KINDS)]
        turn = rng.normal(size=4)
        yield Obstacle(
            name=f"{kind} {k}",
            kind=kind,
            position=(0, 0, -0.05) if kind == "plane" else tuple(rng.uniform(-0.9, 0.9, 3)),
            quaternion=(1, 0, 0, 0) if kind == "plane" else tuple(turn),
            size=tuple(rng.uniform(0.03, 0.2, 3)),
        )


def test_obstacles_moved_into_slots_are_those_of_a_model_of_their_own(panda, geometry, rng):
    scenes = [list(random_obstacles(rng, num)) for num in (10, 3, 7)]
    moved = [exact_scene(panda, obstacles, geometry=geometry) for obstacles in scenes]
    bits = 1 if geometry == "spheres" else exact.ALL_BITS
    for scene, obstacles in zip(moved, scenes, strict=True):
        spec = mujoco.MjSpec.from_string(panda.xml)
        if mjcf_writer.keep_geoms(spec, polytopes=geometry == "polytopes"):
            for geom in spec.geoms:
                geom.contype = geom.conaffinity = bits
        if geometry == "meshes":
            spec = mesh_sources.mesh_spec(panda, visuals=False)
        for k, obstacle in enumerate(obstacles):
            spec.worldbody.add_geom(
                name=f"own {k}",
                type=KINDS[obstacle.kind].geom,
                size=KINDS[obstacle.kind].geom_size(obstacle.size),
                pos=obstacle.position,
                quat=obstacle.quaternion,
                contype=bits,
                conaffinity=bits,
            )
        model = spec.compile()
        data = mujoco.MjData(model)
        own = {model.geom(f"own {k}").id: o.name for k, o in enumerate(obstacles)}
        for q in rng.uniform(panda.lower, panda.upper, (150, 7)):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            hit = data.contact.geom[data.contact.dist < 0]
            seen = {own[g] for g in hit.ravel().tolist() if g in own}
            # Scenes take turns in one model: each has to find its own obstacles there.
            words = [scene.describe(pair) for pair in scene.touching(q)]
            names = {w.split(" touches ")[1] for w in words}
            assert seen == names & set(own.values())


def test_what_is_skipped_is_free(panda, geometry, rng):
    """The verdict, and where, is that of looking at every single configuration."""
    verdicts, counts = [], []
    for num in (6, 12, 12, 12):
        obstacles = [o for o in random_obstacles(rng, num) if o.kind != "plane"]
        scene = exact_scene(panda, obstacles, geometry=geometry)
        for _ in range(8):
            path = panda.home + rng.normal(0, 0.5, (3, 7))
            path = np.clip(path, panda.lower + 0.01, panda.upper - 0.01)
            found = verify_path(panda, obstacles, path, geometry=geometry)
            walk = interpolate(panda, path, 0.005)
            touching = [bool(scene.touching(q)) for q in walk.q]
            assert found.ok == (not any(touching))
            if not found.ok:
                # It is found between the last free configuration and the first that touches.
                first = touching.index(True)
                told = float(str(found.contact).split(" at ")[1].split()[0]) / 100
                low, high = walk.fraction[[max(first - 1, 0), first]]
                assert low - 0.006 < told < high + 0.006
            counts.append((found.checked, len(walk.q)))
            verdicts.append(found.ok)
    assert 3 < sum(verdicts) < len(verdicts) - 3
    checked, small_steps = np.sum(counts, axis=0)
    assert checked < small_steps / 2


def test_threads_verify_at_the_same_time(panda):
    paths = [swing(panda, -1, 1), swing(panda, 1.2, 2.5)] * 4
    expected = [verify_path(panda, [FLOOR, POST], path).ok for path in paths]
    found = [None] * len(paths)

    def verify(k):
        for _ in range(3):
            found[k] = verify_path(panda, [FLOOR, POST], paths[k]).ok

    threads = [threading.Thread(target=verify, args=(k,)) for k in range(len(paths))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == expected and True in found and False in found


def test_typical_path_is_verified_in_time(panda):
    obstacles = [
        dataclasses.replace(FAR, name=f"post {k}", position=(-0.7, 0.1 * k, 0.5)) for k in range(8)
    ]
    path = swing(panda, -1, 1)
    verify_path(panda, obstacles, path)
    started = time.perf_counter()
    assert verify_path(panda, obstacles, path).ok
    assert time.perf_counter() - started < 0.5  # 0.005 s on an idle machine


@pytest.mark.parametrize(
    ("path", "arguments", "message"),
    [
        (np.zeros((2, 6)), {}, r"shape \(2, 6\); expected \(waypoints, 7\).*joint1, joint2"),
        (np.zeros((0, 7)), {}, r"shape \(0, 7\)"),
        (np.full((2, 7), np.nan), {}, "waypoint 0 of the path is not finite"),
        (np.zeros((2, 7)), {"step": 0.0}, "step is 0.0; expected a positive"),
        (
            np.zeros((2, 7)),
            {"geometry": "mesh"},
            "one of: auto, meshes, polytopes, spheres",
        ),
    ],
)
def test_bad_arguments(panda, path, arguments, message):
    with pytest.raises(ValueError, match=message):
        verify_path(panda, [], path, **arguments)


@pytest.mark.parametrize(
    ("obstacles", "message"),
    [
        (
            [dataclasses.replace(POST, kind="cone")],
            "not supported; use one of sphere",
        ),
        (
            [dataclasses.replace(POST, size=(0, 0, 0))],
            "'post'.*3 positive numbers",
        ),
        ([POST, POST], "used more than once: post; expected distinct"),
    ],
)
def test_bad_obstacles(panda, obstacles, message):
    with pytest.raises(ValueError, match=message):
        verify_path(panda, obstacles, panda.home[None], geometry="spheres")
