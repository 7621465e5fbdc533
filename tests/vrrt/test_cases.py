"""Small files from outside that once gave a wrong answer, each with the right one.

Cases that need a plan or threads are where those are tested: thin sheets in
``scene/test_advance.py``, turns of the start in ``test_starts.py``, threads in
``scene/test_verify.py``, fields of cameras in ``splat/test_camera.py``, 64 bit in ``test_x64.py``,
and the order of what failed in ``visual/test_finish.py``.
"""

import tracemalloc
from pathlib import Path

import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.checks import check_start
from vrrt_jax.robots import load_robot
from vrrt_jax.robots import robot as robot_module
from vrrt_jax.scene.world import batch_is_free
from vrrt_jax.splat.background import robot_on_plain_background

CASES = Path(__file__).parents[1] / "cases" / "arms"


@pytest.fixture(scope="module")
def goal_image():
    """What the pictures of the cases were made of: the robot, and its mask."""
    return vrrt_jax.load_problem("panda_posts", engine="closed_form").goal_images[0]


def test_01_a_start_12_cm_from_a_pole_is_accepted():
    robot = load_robot(CASES / "01_capsule_spheres_stick_out" / "capsarm.xml")
    pole = vrrt_jax.Obstacle(
        name="pole", kind="cylinder", position=(0.2, 0, 0.5), size=(0.02, 0.5, 0)
    )
    world = vrrt_jax.build_world(robot, [pole], engine="closed_form")
    start = check_start(robot, world, np.zeros(4))
    exact = vrrt_jax.verify_path(robot, [pole], start[None], measure_clearance=True).clearance
    assert exact - 0.03 <= float(vrrt_jax.obstacle_clearance(world, start)) <= exact


def test_02_a_box_and_a_long_capsule_take_little_memory(monkeypatch):
    monkeypatch.setattr(robot_module, "_NUM_SAMPLES", 500)
    tracemalloc.start()
    robot = load_robot(CASES / "02_load_robot_eats_memory" / "robot.xml")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e8 and len(robot.collision_spheres.radius) < 500


@pytest.mark.parametrize("name", ["uni1", "uni2"])
def test_03_bodies_with_several_joints_may_touch_their_neighbors(name, rng):
    path = CASES / "03_several_joints_per_body" / f"{name}.xml"
    robot = load_robot(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data, q = mujoco.MjData(model), rng.uniform(robot.lower, robot.upper, (300, robot.num_joints))
    for pose in q:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        assert data.ncon == 0
    world = vrrt_jax.build_world(robot, engine="closed_form")
    assert np.all(batch_is_free(world, q.astype(np.float32)))
    assert all(vrrt_jax.verify_path(robot, [], pose[None]).ok for pose in q[:30])


def test_06_limits_of_a_urdf_that_say_nothing_are_refused():
    path = CASES / "06_urdf_limits_missing_zero_reversed" / "zero.urdf"
    fixed = {}
    for name, words in (("j1", "lower=0, upper=0"), ("j2", "no limits"), ("j3", "lower=0.5")):
        with pytest.raises(ValueError, match=f"'{name}' is revolute and has .*{words}"):
            load_robot(path, freeze=fixed)
        fixed[name] = 0.0


@pytest.mark.parametrize("name", ["pkg", "rel"])
def test_07_meshes_with_urls_are_found(name, monkeypatch):
    monkeypatch.setattr(robot_module, "_NUM_SAMPLES", 500)
    robot = load_robot(CASES / "07_package_and_file_urls" / "pk" / "urdf" / f"{name}.urdf")
    assert robot.joint_names == ("j1", "j2") and "a" in robot.collision_sphere_bodies


def test_08_a_mask_of_0_and_1_is_scaled(goal_image):
    read = vrrt_jax.read_image(CASES / "08_mask_of_0_and_1" / "mask01.png")
    np.testing.assert_array_equal(read[..., 3], goal_image[..., 3] > 0.5)


def test_09_sixteen_bits_of_grey_are_read_as_eight(goal_image):
    read = vrrt_jax.read_image(CASES / "09_sixteen_bit_grey" / "g16.png")
    assert read.max() < 1 and read[goal_image[..., 3] == 1].mean() == pytest.approx(0.7, abs=0.02)


def test_11_a_photo_is_turned_as_its_exif_says():
    path = CASES / "11_status_no_path_without_match" / "por_exif.jpg"
    assert vrrt_jax.read_image(path).shape == (640, 480, 3)


@pytest.mark.filterwarnings("ignore:joints coupled")
@pytest.mark.parametrize(
    ("name", "freeze", "planned", "frozen"),
    [
        ("eq.xml", None, "ab", {"fl": 0.0, "fr": 0.0}),
        ("eq.xml", {"fl": 0.03}, "ab", {"fl": 0.03, "fr": 0.03}),
        ("eq_off.xml", None, "ab fl fr", {}),
        ("eq_arm.xml", None, "fl fr", {"a": 0.0, "b": 0.0}),
        ("eq_poly.xml", {"fl": 0.01}, "ab", {"fl": 0.01, "fr": 0.03}),
        ("mimic.urdf", {"left": 0.03}, "pan wrist", {"left": 0.03, "right": 0.03}),
    ],
)
def test_14_followers_follow(name, freeze, planned, frozen, monkeypatch):
    monkeypatch.setattr(robot_module, "_NUM_SAMPLES", 500)
    robot = load_robot(CASES / "14_couplings_followers" / name, freeze=freeze)
    assert robot.joint_names == tuple(planned.replace("ab", "a b").split())
    assert robot.frozen == pytest.approx(frozen)


def test_14_a_tendon_that_ties_joints_is_told(monkeypatch):
    monkeypatch.setattr(robot_module, "_NUM_SAMPLES", 500)
    with pytest.warns(UserWarning, match="what ties tendon 't' .joints fl, fr. together"):
        load_robot(CASES / "14_couplings_followers" / "eq_tendon.xml")


@pytest.mark.parametrize("name", ["bg_green.jpg", "bg_green.png", "bg_grey.png"])
def test_17_the_robot_is_told_from_its_background(goal_image, name):
    read = vrrt_jax.read_image(CASES / "17_plain_background_grey_or_jpeg" / name)
    _, alpha = robot_on_plain_background(read[..., :3])
    true = goal_image[..., 3]
    assert (alpha * (true == 0)).sum() + ((1 - alpha) * (true == 1)).sum() < 0.015 * true.sum()
