"""Files of joint-goal problems: what is read, what is refused, where the base stands."""

import numpy as np
import pytest
from arm_cases import BASE, GOAL, POST, START
from scipy.spatial.transform import Rotation

import vrrt_jax
from vrrt_jax.bench.arm_problems import problem_files, read_problems


def test_a_file_is_read_in_the_robots_order_and_names(panda, arrays, write):
    order = [3, 0, 1, 2, 6, 5, 4]
    shuffled = {key: arrays[key][..., order] for key in ("joints", "start", "goal")}
    shuffled |= {key: arrays[key][order] for key in ("joint_lower", "joint_upper")}
    names = {"box_name": np.array([["post"]]), "cyl_name": np.array([["can"]])}
    problems = read_problems(write(arrays | shuffled | names), panda)
    assert problems.name == "posts" and problems.differences == ()
    np.testing.assert_array_equal(problems.q_start, np.tile(START.astype(np.float32), (3, 1)))
    np.testing.assert_array_equal(problems.q_goal[0], GOAL.astype(np.float32))
    post, can = problems.obstacles[1]
    assert (post.name, post.kind, post.size) == ("post", "box", (0.03, 0.03, 0.3))
    assert (can.name, can.kind, can.size) == ("can", "cylinder", (0.03, 0.05, 0.0))
    np.testing.assert_allclose(post.position, POST)
    assert problems.is_valid.tolist() == [True, True, False]


def test_spheres_are_obstacles_too(panda, arrays, write):
    spheres = {"sphere_pos": np.full((3, 1, 3), 0.7), "sphere_radius": np.full((3, 1), 0.1)}
    *_, ball = read_problems(write(arrays | spheres), panda).obstacles[0]
    assert (ball.kind, ball.size, ball.position) == ("sphere", (0.1, 0.0, 0.0), (0.7, 0.7, 0.7))


def test_another_posture_of_the_files_robot_is_told(panda, arrays, write):
    upper = panda.upper.copy()
    upper[2] += 0.2
    values = np.array([[0.065, 0.04], [0.065, 0.04], [0.03, 0.04]])
    fixed = np.array(["panda_finger_joint1", "wheel"])
    changes = {"joint_upper": upper, "fixed_values": values, "fixed_joints": fixed}
    limits, finger, unknown = read_problems(write(arrays | changes), panda).differences
    assert limits == "the limits of joint3 differ by up to 0.200 rad or m"
    assert finger == "panda_finger_joint1 is fixed at 0.03 to 0.065 in the file, at 0.04 here"
    assert unknown == "the fixed joints wheel are not modeled here"


def _nan(array):
    array = array.copy()
    array.flat[8] = np.nan
    return array


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("goal", None, r"lacks the keys \['goal'\]"),
        ("base_poze", lambda _: np.zeros(7), r"unknown keys \['base_poze'\]"),
        ("goal", _nan, r"goal\[1, 1\] is nan"),
        ("goal", lambda a: a[:2], r"goal has shape \(2, 7\); expected \(N, J\) = \(3, 7\)"),
        ("box_half", lambda a: a[..., 0], r"expected \(N, B, 3\) = \(3, 1, 3\)"),
        ("cyl_pose", lambda a: a[..., :6], r"expected \(N, C, 7\)"),
        ("vamp_valid", lambda a: a.astype(int), "vamp_valid is of type int64; expected bool"),
        ("joints", lambda a: np.arange(7), "joints is of type int64; expected text"),
        ("joints", lambda a: a.astype(object), "no readable .npz of arrays .*holds Python objects"),
        ("box_pose", lambda a: 2 * a, "problem 0: 'box_0' has the quaternion.*expected length 1"),
        ("cyl_radius", lambda a: -a, "problem 0: obstacle 'cyl_0'.*expected 2 positive numbers"),
        ("box_name", lambda _: np.array([["a", "b"]]), r"box_name has shape \(1, 2\)"),
    ],
)
def test_a_damaged_file_is_refused_by_name(panda, arrays, write, key, change, message):
    changed = {k: v for k, v in arrays.items() if k != key}
    if change is not None:
        changed[key] = change(arrays.get(key))
    with pytest.raises(ValueError, match=message):
        read_problems(write(changed), panda)


def test_what_is_no_archive_or_empty_or_missing_is_refused(panda, arrays, write, tmp_path):
    text, truncated = tmp_path / "text.npz", tmp_path / "truncated.npz"
    text.write_text("not an archive")
    truncated.write_bytes(write(arrays).read_bytes()[:600])
    array, empty = tmp_path / "array.npy", tmp_path / "empty.npz"
    np.save(array, np.zeros(3))
    empty.write_bytes(b"")
    for file in (text, truncated, array, empty):
        with pytest.raises(ValueError, match="no readable .npz of arrays"):
            read_problems(file, panda)
    per_problem = [key for key, value in arrays.items() if len(value) == 3]
    nothing = arrays | {key: arrays[key][:0] for key in per_problem}
    with pytest.raises(ValueError, match="holds no problem"):
        read_problems(write(nothing), panda)
    with pytest.raises(FileNotFoundError, match="cannot read .*none.npz"):
        read_problems(tmp_path / "none.npz", panda)


def test_a_file_of_another_robot_is_refused(arrays, write):
    with pytest.raises(ValueError, match="panda_joint1, .*those of 'ur5e'.*shoulder_pan, "):
        read_problems(write(arrays), vrrt_jax.load_robot("ur5e"))


def test_files_are_found_in_the_folder_or_in_the_robots(arrays, tmp_path):
    (tmp_path / "panda").mkdir()
    np.savez(tmp_path / "panda" / "b.npz", **arrays)
    np.savez(tmp_path / "panda" / "a.npz", **arrays)
    for folder in (tmp_path, tmp_path / "panda"):
        assert [file.name for file in problem_files(folder, "panda")] == ["a.npz", "b.npz"]
    with pytest.raises(FileNotFoundError, match="one of the folders in it: panda"):
        problem_files(tmp_path, "fetch")


def test_a_base_that_stands_elsewhere_moves_the_obstacles(panda, arrays, write):
    """The same problems, told in a frame in which the base stands elsewhere."""
    turn, shift = Rotation.from_euler("z", BASE[3]), np.array(BASE[:3])
    moved = dict(arrays)
    for key in ("box_pose", "cyl_pose"):
        pose = arrays[key].copy()
        pose[:, 0, :3] = turn.apply(pose[:, 0, :3]) + shift
        pose[:, 0, 3:] = turn.as_quat(scalar_first=True)
        moved[key] = pose
    plain = read_problems(write(arrays, "plain"), panda)
    file = write(moved, "moved")
    base_pose = np.array([*shift, *turn.as_quat(scalar_first=True)])
    with_pose = write(moved | {"base_pose": base_pose}, "with_pose")
    for problems in (read_problems(file, panda, BASE), read_problems(with_pose, panda)):
        for own, same in zip(problems.obstacles, plain.obstacles, strict=True):
            for obstacle, other in zip(own, same, strict=True):
                np.testing.assert_allclose(obstacle.position, other.position, atol=1e-9)
                np.testing.assert_allclose(obstacle.quaternion, other.quaternion, atol=1e-9)
    with pytest.raises(ValueError, match="a base_pose, and a base is given too"):
        read_problems(with_pose, panda, BASE)
    with pytest.raises(ValueError, match="expected x, y, z"):
        read_problems(file, panda, BASE[:3])


def test_the_base_is_that_of_the_base_link(arrays, write):
    """The packaged UR5e turns its base by a quarter: there, that is where it stands already."""
    robot = vrrt_jax.load_robot("ur5e")
    own = {
        "joints": np.array([f"{name}_joint" for name in robot.joint_names]),
        "joint_lower": robot.lower,
        "joint_upper": robot.upper,
        **{key: np.zeros((3, 6)) for key in ("start", "goal")},
    }
    file = write(arrays | own)
    np.testing.assert_allclose(read_problems(file, robot).obstacles[0][0].position, POST)
    (post, _), *_ = read_problems(file, robot, (0.0, 0.0, 0.1, np.pi / 2)).obstacles
    np.testing.assert_allclose(post.position, np.array(POST) - [0, 0, 0.1], atol=1e-9)
