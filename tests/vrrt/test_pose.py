"""Goals that are poses of a link."""

import jax
import mujoco
import numpy as np
import pytest

import vrrt_jax

KEY = jax.random.key(0)
GOAL = np.array([0.6, 0.4, -0.3, -1.8, 0.2, 2.0, 0.5])


def pose_of(robot, q, link):
    """Where C MuJoCo puts a link."""
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    pose = np.eye(4)
    pose[:3, 3], pose[:3, :3] = data.body(link).xpos, data.body(link).xmat.reshape(3, 3)
    return pose


@pytest.fixture(scope="module")
def posts():
    return vrrt_jax.load_problem("panda_posts", engine="closed_form")


@pytest.mark.parametrize("link", ["link7", "hand"])
def test_solutions_are_where_they_should_be(posts, link):
    robot, pose = posts.robot, pose_of(posts.robot, GOAL, link)
    found = vrrt_jax.inverse_kinematics(
        robot, posts.world, pose, link, key=KEY, q_near=posts.q_start
    )
    assert len(found) > 1
    lower, upper = np.float32(robot.lower), np.float32(robot.upper)  # some end at a limit
    for q in found:
        np.testing.assert_allclose(pose_of(robot, q, link), pose, atol=1.1e-3)
        assert np.all((q >= lower) & (q <= upper))
        assert vrrt_jax.verify_path(robot, vrrt_jax.obstacle_list(posts.world), q[None]).ok
    away = np.linalg.norm(found - posts.q_start, axis=1)
    assert np.all(np.diff(away) >= 0)
    apart = np.linalg.norm(found[:, None] - found, axis=2) + np.eye(len(found))
    assert apart.min() > 0.3


def test_a_path_to_a_pose(posts):
    pose = pose_of(posts.robot, GOAL, "link7")
    result = vrrt_jax.plan_to_pose(posts.robot, posts.world, posts.q_start, pose, key=KEY)
    assert result.ok
    np.testing.assert_allclose(result.path[0], posts.q_start, atol=1e-6)
    np.testing.assert_allclose(result.path[-1], result.target, atol=1e-3)
    np.testing.assert_allclose(pose_of(posts.robot, result.path[-1], "link7"), pose, atol=1.5e-3)
    # From there, the way is none.
    there = result.path[-1]
    again = vrrt_jax.plan_to_pose(posts.robot, posts.world, there, pose, key=KEY)
    assert again.ok and again.cost < 0.05


def test_where_nothing_reaches_it_says_why(posts):
    robot, pose = posts.robot, pose_of(posts.robot, GOAL, "link7")
    far = pose.copy()
    far[0, 3] += 2.0
    result = vrrt_jax.plan_to_pose(robot, posts.world, posts.q_start, far, key=KEY)
    assert result.status is vrrt_jax.Status.NO_MATCH and "'link7' stays" in result.advice
    solid = vrrt_jax.Obstacle(
        name="solid", kind="sphere", position=tuple(pose[:3, 3]), size=(0.1, 0.0, 0.0)
    )
    world = vrrt_jax.build_world(robot, [solid], engine="closed_form")
    result = vrrt_jax.plan_to_pose(robot, world, posts.q_start, pose, key=KEY)
    assert result.status is vrrt_jax.Status.NO_MATCH
    assert "in collision" in result.advice and "touches solid" in result.advice
    with pytest.raises(ValueError, match="in collision"):
        vrrt_jax.inverse_kinematics(robot, world, pose, key=KEY)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"pose": np.eye(3)}, r"the pose has shape \(3, 3\); expected a rigid \(4, 4\)"),
        ({"pose": np.diag([1.0, 1.0, -1.0, 1.0])}, r"the pose is not a rigid \(4, 4\) transform"),
        ({"pose": np.full((4, 4), np.nan)}, r"the pose is not a rigid \(4, 4\) transform"),
        ({"link": "hand2"}, "'hand2' is no link of the robot; have: .*link7, hand"),
    ],
)
def test_bad_input_is_named(posts, change, told):
    given = {"pose": np.eye(4), "link": None} | change
    with pytest.raises(ValueError, match=told):
        vrrt_jax.plan_to_pose(posts.robot, posts.world, posts.q_start, **given, key=KEY)


def test_any_of_several_joint_goals(posts):
    robot, world, start = posts.robot, posts.world, posts.q_start
    goals = np.stack([GOAL, start + 0.2]).astype(np.float32)
    result = vrrt_jax.plan_to_configuration(robot, world, start, goals, key=KEY)
    assert result.ok
    assert min(np.abs(result.path[-1] - goals).max(axis=1)) < 1e-3
    np.testing.assert_array_equal(
        result.target, goals[np.argmin(np.abs(goals - result.path[-1]).max(axis=1))]
    )
    with pytest.raises(ValueError, match="RRT takes one goal"):
        vrrt_jax.plan_to_configuration(robot, world, start, goals, key=KEY, planner="rrt")
    bad = np.stack([GOAL, np.full(7, 9.0)])
    with pytest.raises(ValueError, match="goal 1"):
        vrrt_jax.plan_to_configuration(robot, world, start, bad, key=KEY)
