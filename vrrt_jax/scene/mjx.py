"""The same question put to MJX: the oracle of :mod:`vrrt_jax.scene.world`.

This is the only file that touches MJX's internals. Every jit around it needs
``compiler_options={"xla_cpu_use_fusion_emitters": False}`` on a CPU, or it runs thousands of times
slower; that, the cost of its box and mesh pairs, and distances that are only a sign are why the
planners do not use it.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.world import World, obstacle_list

PRISM_SIDES = 16  # of the convex mesh that stands for a cylinder, whose pairs MJX lacks


def mjx_world(robot: Any, world: World) -> tuple[mjx.Model, mjx.Data]:
    """Put a robot's collision spheres and a world's obstacles into MJX.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        world: the obstacles.

    Returns:
        The model, and data to start from.
    """
    spec = mujoco.MjSpec.from_string(robot.xml)
    for obstacle in obstacle_list(world):
        geom = spec.worldbody.add_geom(
            name=f"obstacle {obstacle.name}",
            pos=obstacle.position,
            quat=obstacle.quaternion,
            contype=1,
            conaffinity=0,
        )
        if obstacle.kind == "cylinder":
            mesh = spec.add_mesh(name=f"prism {obstacle.name}", uservert=_prism(obstacle))
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
        else:
            geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{obstacle.kind.upper()}")
            geom.size = obstacle.size
    model = mjx.put_model(spec.compile())
    return model, mjx.make_data(model)


def mjx_is_free(model: mjx.Model, data: mjx.Data, q: jax.Array) -> jax.Array:
    """Whether ``q`` (D,) is free of contacts, () bool."""
    data = mjx.kinematics(model, data.replace(qpos=q))
    contact = mjx.collision(model, data)._impl.contact
    return jnp.all(contact.dist > 0)


def _prism(obstacle: Obstacle) -> np.ndarray:
    """Vertices (2 * sides * 3,) of a prism around a cylinder."""
    radius, half, _ = obstacle.size
    angle = 2 * np.pi * np.arange(PRISM_SIDES) / PRISM_SIDES
    ring = radius / np.cos(np.pi / PRISM_SIDES) * np.stack([np.cos(angle), np.sin(angle)], 1)
    ends = [np.column_stack([ring, np.full(PRISM_SIDES, z)]) for z in (-half, half)]
    return np.concatenate(ends).ravel()
