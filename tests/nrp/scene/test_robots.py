"""The snake and the Fetch: kinematics, limits, and spheres that cover their primitives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import nrp_jax
from vrrt_jax.robots.kinematics import batch_link_poses, link_poses


@pytest.fixture(params=["snake", "fetch"])
def robot(request):
    return nrp_jax.load_robot(request.param)


def random_q(robot, rng, n):
    lower = np.concatenate([np.full(robot.base_dim, -2.0), robot.lower])
    upper = np.concatenate([np.full(robot.base_dim, 2.0), robot.upper])
    return rng.uniform(lower, upper, (n, robot.num_joints)).astype(np.float32)


def test_joints(robot):
    names = {"snake": ("x", "y", "q1"), "fetch": ("x", "y", "theta", "torso_lift")}[robot.name]
    assert robot.joint_names[: len(names)] == names
    assert robot.num_joints == {"snake": 8, "fetch": 11}[robot.name]
    assert np.all(robot.lower < robot.upper)
    if robot.name == "fetch":
        np.testing.assert_allclose([robot.lower[0], robot.upper[0]], [0.0, 0.38615])
        assert robot.is_continuous.tolist() == [False, False, True, False] + [
            name in ("upperarm_roll", "forearm_roll", "wrist_roll")
            for name in robot.joint_names[4:]
        ]


def test_unknown_robot():
    with pytest.raises(ValueError, match="unknown robot 'eel'; have: snake, fetch"):
        nrp_jax.load_robot("eel")


def test_features_are_where_mujoco_has_them(robot, rng):
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    for q in random_q(robot, rng, 5):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        expected = data.site_xpos * ([1, 1, 0] if robot.planar else [1, 1, 1])
        features = jax.jit(nrp_jax.link_features)(robot, q)
        np.testing.assert_allclose(features, expected, atol=2e-6)


def test_snake_lies_along_y_and_turns_clockwise():
    snake = nrp_jax.load_robot("snake")
    tips = nrp_jax.link_features(snake, jnp.zeros(8))
    np.testing.assert_allclose(tips[:, 1], 0.12 * np.arange(1, 7), atol=1e-6)
    tips = nrp_jax.link_features(snake, jnp.zeros(8).at[2].set(np.pi / 2))
    np.testing.assert_allclose(tips[-1], [0.72, 0, 0], atol=1e-6)


def test_straight_arm_of_the_fetch():
    fetch = nrp_jax.load_robot("fetch")
    features = nrp_jax.link_features(fetch, jnp.zeros(11).at[3].set(0.1))
    assert float(features[1, 2]) == pytest.approx(0.826, abs=1e-3)
    gripper = features[-1] + jnp.array([0.16645, 0, 0])
    np.testing.assert_allclose(gripper, [1.128, 0.0, 0.886], atol=1e-3)


def test_cover_contains_the_primitives_at_any_configuration(robot, rng):
    """Surface points of MuJoCo's geoms lie inside the spheres, or in the round base."""
    from nrp_jax.viz import _outer_points

    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    for q in random_q(robot, rng, 3):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        pose = np.asarray(link_poses(robot.chain, jnp.asarray(q)))[
            np.asarray(robot.collision_spheres.link)
        ]
        center = (
            np.einsum("nij,nj->ni", pose[:, :3, :3], robot.collision_spheres.center)
            + pose[:, :3, 3]
        )
        for geom in range(model.ngeom):
            if model.geom(geom).name == "footprint":
                continue
            points = _outer_points(mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom])
            points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            axes = slice(0, 2) if robot.planar else slice(0, 3)
            gap = np.linalg.norm(points[:, None, axes] - center[:, axes], axis=2)
            assert (gap - np.asarray(robot.collision_spheres.radius)).min(axis=1).max() < 1e-5


def test_only_links_of_one_layer_of_the_snake_are_checked():
    snake = nrp_jax.load_robot("snake")
    assert snake.planar_boxes is not None
    assert sorted(snake.planar_boxes.pairs) == [(0, 2), (0, 4), (1, 3), (1, 5), (2, 4), (3, 5)]


def test_share_of_postures_that_hit_themselves(rng):
    """Near those of the paper's models: 48 % (its last link stands off farther) and 13.8 %."""
    grid = nrp_jax.Grid(occupied=np.zeros((100, 100, 20), bool))
    for name, low, high in (("snake", 0.51, 0.58), ("fetch", 0.10, 0.22)):
        robot = nrp_jax.load_robot(name)
        world = nrp_jax.build_world(robot, grid)
        q = random_q(robot, rng, 4096)
        q[:, :2] = 5.0
        if name == "fetch":  # above the floor, so that only the robot itself is in its way
            lowest = np.asarray(batch_link_poses(robot.chain, q))[:, 5:, 2, 3].min(axis=1)
            q = q[lowest > 0.35]
        hits = 1 - float(np.mean(nrp_jax.batch_is_free(world, q)))
        assert low < hits < high
