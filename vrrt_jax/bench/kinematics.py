"""Kinematics and collision: ours inside a user's plain ``jit``, our best, and MJX."""

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from vrrt_jax.core.timing import best_ms, interleaved_ms
from vrrt_jax.robots import load_robot
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.scene.mjx import mjx_is_free, mjx_world
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.world import build_world, is_free

NO_FUSION_EMITTERS = {"xla_cpu_use_fusion_emitters": False}


def run(batch: int = 1024, repeats: int = 30) -> dict:
    """Times of a batch of Panda configurations.

    ``user_jit_ratio`` compares ``link_poses`` in a plain ``jit(vmap(...))`` with the fastest way to
    compile it that is known here.
    """
    robot = load_robot("panda")
    rng = np.random.default_rng(0)
    q = jnp.asarray(rng.uniform(robot.lower, robot.upper, (batch, robot.num_joints)), jnp.float32)
    world = build_world(robot, _obstacles(rng))

    def posed(q):
        return link_poses(robot.chain, q)

    user = jax.jit(jax.vmap(posed))
    best = jax.jit(jax.vmap(posed), compiler_options=NO_FUSION_EMITTERS)
    model, data = mjx_world(robot, world)
    mjx_kinematics = jax.jit(
        jax.vmap(lambda q: mjx.kinematics(model, data.replace(qpos=q)).xpos),
        compiler_options=NO_FUSION_EMITTERS,
    )
    free = jax.jit(jax.vmap(is_free, (None, 0)))
    mjx_free = jax.jit(
        jax.vmap(lambda q: mjx_is_free(model, data, q)),
        compiler_options=NO_FUSION_EMITTERS,
    )
    _, compile_s = best_ms(lambda: user(q), repeats=1)
    times = interleaved_ms(
        {
            "user_jit": lambda: user(q),
            "best": lambda: best(q),
            "mjx_kinematics": lambda: mjx_kinematics(q),
            "is_free": lambda: free(world, q),
        },
        repeats,
    )
    times |= interleaved_ms({"mjx_collision": lambda: mjx_free(q)}, 3)
    agree = np.mean(np.asarray(free(world, q)) == np.asarray(mjx_free(q)))
    return {
        "batch": batch,
        "num_obstacles": 8,
        "num_cover_spheres": len(robot.collision_spheres.radius),
        **{f"{name}_ms": round(value, 3) for name, value in times.items()},
        "compile_s": round(compile_s, 2),
        "user_jit_ratio": round(times["user_jit"] / times["best"], 3),
        "is_free_us_per_configuration": round(1e3 * times["is_free"] / batch, 2),
        "mjx_over_is_free": round(times["mjx_collision"] / times["is_free"], 1),
        "agrees_with_mjx": float(agree),
    }


def _obstacles(rng: np.random.Generator) -> list[Obstacle]:
    kinds = ("sphere", "box", "capsule", "sphere", "box", "capsule", "sphere", "box")
    return [
        Obstacle(
            name=f"{kind}_{i}",
            kind=kind,
            position=tuple(rng.uniform([0.2, -0.6, 0.1], [0.8, 0.6, 0.9]).tolist()),
            size=(0.08, 0.1, 0.06),
        )
        for i, kind in enumerate(kinds)
    ]
