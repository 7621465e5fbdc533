"""Goal images that tests render with a self-model."""

import jax
import jax.numpy as jnp
import numpy as np

import vrrt_jax

Q_START = np.array([-0.9, 0.5, 0.0, -1.6, 0.0, 2.0, 0.8], np.float32)
Q_GOAL = np.array([-0.5, 0.3, 0.2, -1.9, 0.1, 2.2, 0.6], np.float32)
HALF_TURNED = Q_GOAL - np.pi * np.eye(7, dtype=np.float32)[6]


def picture(panda, self_model, camera, q, level=2):
    splats = self_model.levels[level].splats
    poses = vrrt_jax.link_poses(panda.chain, jnp.asarray(q))
    rgb, alpha = jax.jit(vrrt_jax.render)(splats, poses, camera)
    straight = rgb / jnp.maximum(alpha, 1e-3)[..., None]
    return np.clip(np.concatenate([straight, alpha[..., None]], axis=-1), 0, 1)
