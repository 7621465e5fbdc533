"""Kinematics and collision: both engines inside a user's plain ``jit``, and where time goes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.timing import best_ms, interleaved_ms
from vrrt_jax.robots import Robot, load_robot
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.scene.world import ENGINES, build_world, is_free

NO_FUSION_EMITTERS = {"xla_cpu_use_fusion_emitters": False}
BATCHES = (
    32,
    192,
    1024,
)  # lanes; checks in an iteration: visual, RRT-Connect
KINDS = ("sphere", "box", "capsule", "cylinder")


def run(robot_name: str = "panda", repeats: int = 30) -> dict[str, Any]:
    """Times of both engines on random configurations among eight obstacles.

    ``user_jit_ratio`` compares a plain ``jit(vmap(...))`` with the fastest way to compile it that
    is known here: the same without XLA's fusion emitters, or the plain one itself.
    """
    robot, rng = load_robot(robot_name), np.random.default_rng(0)
    obstacles = _obstacles(rng, KINDS * 2)
    worlds = {engine: build_world(robot, obstacles, engine=engine) for engine in ENGINES}
    poses = _ratios(lambda chain, q: link_poses(chain, q), robot.chain, _draw(robot, 1024), repeats)
    figures = {
        "robot": robot_name,
        "num_obstacles": len(obstacles),
        "num_collision_spheres": len(robot.collision_spheres.radius),
        "num_self_collision_pairs": len(robot.self_collision_pairs),
        "link_poses_user_jit_ratio": poses["user_jit_ratio"],
        "batches": {},
    }
    for batch in BATCHES:
        q = _draw(robot, batch)
        row = {engine: _ratios(is_free, world, q, repeats) for engine, world in worlds.items()}
        plain = jax.jit(jax.vmap(is_free, (None, 0)))
        calls = {engine: _call(plain, world, q) for engine, world in worlds.items()}
        times = interleaved_ms(calls, repeats)
        free = {engine: np.asarray(call()) for engine, call in calls.items()}
        figures["batches"][batch] = {
            **{f"{engine}_{name}": value for engine in row for name, value in row[engine].items()},
            **{f"{e}_us_per_configuration": round(1e3 * times[e] / batch, 2) for e in ENGINES},
            "mjx_over_closed_form": round(times["mjx"] / times["closed_form"], 2),
            "engines_agree": float(np.mean(free["mjx"] == free["closed_form"])),
        }
    return figures | {"mjx_us_per_configuration": _parts(robot, rng, repeats)}


def _parts(robot: Robot, rng: np.random.Generator, repeats: int) -> dict[str, float]:
    """What MJX spends on the robot alone, and more for four obstacles of each kind [us]."""
    worlds = {kind: build_world(robot, _obstacles(rng, [kind] * 4)) for kind in KINDS}
    worlds["kinematics and itself"] = build_world(robot)
    plain, q = jax.jit(jax.vmap(is_free, (None, 0))), _draw(robot, 192)
    times = interleaved_ms({name: _call(plain, w, q) for name, w in worlds.items()}, repeats)
    cost = {name: 1e3 * time / len(q) for name, time in times.items()}
    alone = cost.pop("kinematics and itself")
    more = {f"4 of kind {kind}": round(total - alone, 2) for kind, total in cost.items()}
    return {"kinematics and itself": round(alone, 2), **more}


def _ratios(
    function: Callable[..., jax.Array], thing: Any, q: jax.Array, repeats: int
) -> dict[str, float]:
    """How a function of one configuration does in a plain ``jit``, and how long that compiles."""
    over = jax.vmap(function, (None, 0))
    plain, other = jax.jit(over), jax.jit(over, compiler_options=NO_FUSION_EMITTERS)
    _, compile_s = best_ms(lambda: plain(thing, q), repeats=1)
    times = interleaved_ms(
        {"user": _call(plain, thing, q), "other": _call(other, thing, q)}, repeats
    )
    ratio = times["user"] / min(times.values())
    return {"user_jit_ratio": round(ratio, 3), "first_call_s": round(compile_s, 2)}


def _call(function: Callable[..., jax.Array], thing: Any, q: jax.Array) -> Callable[[], jax.Array]:
    return lambda: function(thing, q)


def _draw(robot: Robot, num: int) -> jax.Array:
    q = np.random.default_rng(1).uniform(robot.lower, robot.upper, (num, robot.num_joints))
    return jnp.asarray(q, jnp.float32)


def _obstacles(rng: np.random.Generator, kinds: Any) -> list[Obstacle]:
    return [
        Obstacle(
            name=f"{kind}_{i}",
            kind=kind,
            position=tuple(rng.uniform([0.2, -0.6, 0.1], [0.8, 0.6, 0.9]).tolist()),
            size=(0.08, 0.1, 0.06),
        )
        for i, kind in enumerate(kinds)
    ]
