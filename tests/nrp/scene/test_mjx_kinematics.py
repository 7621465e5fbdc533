"""MJX has no grids, so that homes have a kinematics of their own: it is MJX's."""

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import nrp_jax
from vrrt_jax.robots.kinematics import batch_link_poses, chain_from_model


@pytest.mark.parametrize("name", ["snake", "fetch"])
def test_poses_are_those_of_mjx(name, rng):
    robot = nrp_jax.load_robot(name)
    model = mujoco.MjModel.from_xml_string(robot.xml)
    model.geom_contype[:] = model.geom_conaffinity[:] = 0  # pairs of these geoms do not matter
    _, body_link, body_in_link = chain_from_model(model)
    lower = np.concatenate([np.full(robot.base_dim, -2.0), robot.lower])
    upper = np.concatenate([np.full(robot.base_dim, 2.0), robot.upper])
    q = rng.uniform(lower, upper, (64, robot.num_joints)).astype(np.float32)
    poses = np.asarray(batch_link_poses(robot.chain, q))[:, body_link] @ body_in_link
    on_device = mjx.put_model(model)
    data = mjx.make_data(on_device)
    kinematics = jax.jit(
        jax.vmap(lambda q: mjx.kinematics(on_device, data.replace(qpos=q))),
        compiler_options={"xla_cpu_use_fusion_emitters": False},
    )
    found = kinematics(q)
    np.testing.assert_allclose(poses[:, :, :3, 3], found.xpos, atol=5e-6)
    np.testing.assert_allclose(poses[:, :, :3, :3], found.xmat, atol=5e-6)
