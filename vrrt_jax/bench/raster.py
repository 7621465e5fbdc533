"""Rasterizer: value and gradient of an image loss, against bare products and plain splats."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.timing import interleaved_ms
from vrrt_jax.robots import Robot, load_robot
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.splat.camera import look_at
from vrrt_jax.splat.lanes import map_lanes
from vrrt_jax.splat.loss import image_loss
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.reference import render_reference
from vrrt_jax.splat.types import SplatModel, layer_starts
from vrrt_jax.splat.windows import choose_windows

CHANNELS = 5  # what the rasterizer sums: weighted rgb, weight and density


def run(
    num_lanes: int = 32, num_splats: int = 600, size_px: int = 64, repeats: int = 30
) -> dict[str, float]:
    """Times of 32 value-and-gradients by joint positions, of random splats on the Panda.

    ``floor_ms`` is for the three products that a sum over the whole image takes, alone;
    ``whole_image_ms`` for value and gradient by such sums; ``dense_ms`` for value and gradient
    through the plain sorted compositor.
    """
    robot, rng = load_robot("panda"), np.random.default_rng(0)
    q = rng.uniform(robot.lower, robot.upper, (2, num_lanes, robot.num_joints))
    typical, q = jnp.asarray(q, jnp.float32)
    whole = random_splats(robot, num_splats, rng)
    camera = look_at((1.5, 1.2, 0.9), (0.0, 0.0, 0.4), height=size_px, width=size_px)
    poses = jax.vmap(lambda q: link_poses(robot.chain, q))(typical)
    splats, windows = choose_windows(whole, poses, camera)

    def loss(q, splats, draw, *options):
        rgb, alpha = draw(splats, link_poses(robot.chain, q), camera, *options)
        goal = jnp.full_like(alpha, 0.3)
        return image_loss(rgb, alpha, goal[..., None], goal, jnp.ones_like(goal))

    def lanes(function, *options):
        return jax.jit(lambda q: map_lanes(lambda q: function(q, *options), q))

    gradient = jax.value_and_grad(loss)
    fast = lanes(gradient, splats, render, windows)
    whole_image = lanes(gradient, whole, render)
    forward = lanes(loss, splats, render, windows)
    dense = jax.jit(lambda q: jax.lax.map(lambda q: gradient(q, whole, render_reference), q))
    started = time.perf_counter()
    jax.block_until_ready(fast(q))
    compile_s = time.perf_counter() - started
    times = interleaved_ms(
        {
            "value_and_grad": lambda: fast(q),
            "floor": products(num_lanes, num_splats, size_px),
            "whole_image": lambda: whole_image(q),
            "forward": lambda: forward(q),
        },
        repeats,
    )
    times |= interleaved_ms({"dense": lambda: dense(q)}, 2)
    return {
        "num_lanes": num_lanes,
        "num_splats": num_splats,
        "size_px": size_px,
        "window_px": windows.size_px if windows else size_px,
        "cluster": windows.cluster_size if windows else num_splats,
        **{f"{name}_ms": round(value, 3) for name, value in times.items()},
        "compile_s": round(compile_s, 2),
        "ratio_to_floor": round(times["value_and_grad"] / times["floor"], 3),
        "speedup_vs_dense": round(times["dense"] / times["value_and_grad"], 1),
    }


def random_splats(robot: Robot, num_splats: int, rng: np.random.Generator) -> SplatModel:
    """Splats all over the spheres that cover a robot."""
    cover = robot.collision_spheres
    radius = np.asarray(cover.radius)
    sphere = np.sort(rng.choice(len(radius), num_splats, p=radius**2 / np.sum(radius**2)))
    sphere = sphere[np.argsort(np.asarray(cover.link)[sphere], kind="stable")]
    normal = rng.normal(size=(num_splats, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    arrays = {
        "mean": np.asarray(cover.center)[sphere] + radius[sphere, None] * normal,
        "radius": rng.uniform(0.012, 0.02, num_splats),
        "density": rng.uniform(1.0, 3.0, num_splats),
        "rgb": rng.uniform(size=(num_splats, 3)),
        "view_color_gradient": 0.2 * normal,
    }
    link = np.asarray(cover.link)[sphere]
    return SplatModel(
        link=jnp.asarray(link, jnp.int32),
        starts=layer_starts(link),
        tau=jnp.float32(0.04),
        **{name: jnp.asarray(value, jnp.float32) for name, value in arrays.items()},
    )


def products(num_lanes: int, num_splats: int, size_px: int):
    """A call that multiplies, for each lane, the matrices of a sum over the whole image."""
    rng = np.random.default_rng(0)
    shapes = (
        (CHANNELS * size_px, num_splats),
        (num_splats, size_px),
        (CHANNELS * size_px, size_px),
    )
    rows, columns, image = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in shapes)

    @jax.jit
    def call():
        def lane(_, small):
            # Each lane depends on the one before, or XLA would multiply once.
            b, c = columns + small, image + small
            out = jax.lax.optimization_barrier((rows @ b, rows.T @ c, c @ b.T))
            return 1e-30 * sum(matrix[0, 0] for matrix in out)

        return jax.lax.fori_loop(0, num_lanes, lane, jnp.float32(0))

    return call
