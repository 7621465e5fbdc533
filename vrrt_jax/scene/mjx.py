"""The same question put to MJX: the oracle of :mod:`vrrt_jax.scene.closed_form`.

This is the only file that touches MJX's internals. Every jit around it needs
``compiler_options={"xla_cpu_use_fusion_emitters": False}`` on a CPU, or it runs thousands of times
slower; that, the cost of its box and mesh pairs, and distances that are only a sign are why the
planners do not use it.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from vrrt_jax.scene.obstacle_kinds import KINDS
from vrrt_jax.scene.world import World, obstacle_list


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
        kind = KINDS[obstacle.kind]
        if kind.mjx_mesh is None:
            geom.type, geom.size = kind.geom, kind.geom_size(obstacle.size)
        else:
            vertices = kind.mjx_mesh(obstacle.size)
            mesh = spec.add_mesh(name=f"mesh of {obstacle.name}", uservert=vertices.ravel())
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
    model = mjx.put_model(spec.compile())
    return model, mjx.make_data(model)


def mjx_is_free(model: mjx.Model, data: mjx.Data, q: jax.Array) -> jax.Array:
    """Whether ``q`` (D,) is free of contacts, () bool."""
    data = mjx.kinematics(model, data.replace(qpos=q))
    contact = mjx.collision(model, data)._impl.contact
    return jnp.all(contact.dist > 0)
