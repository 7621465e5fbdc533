"""Fit few spheres to a body, which stick out little where obstacles could be; takes minutes.

The command ``vrrt spheres`` fits with it. Robots are loaded with the quick covers of
:mod:`vrrt_jax.robots.sphere_cover`.

The spheres of a body minimize the volume of false alarms: places for the center of a ball-shaped
obstacle that touches a sphere but not the robot. They are found by gradient descent from several
starts, with a penalty on surface left uncovered, and grown at last until nothing is.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
from scipy.spatial import KDTree

from vrrt_jax.robots.convex_parts import Piece, grow, surface_samples, union_depth
from vrrt_jax.robots.limits import joint_ranges

MAX_SPHERES = 8  # of one body
_STARTS = 8
_STEPS = 500
_SPACING = 0.003  # [m] between surface samples
_BALLS = (0.04, 0.1)  # [m] radii of the obstacles that false alarms are counted for
_SHELL = 0.045  # [m] how far from touching they are counted
_NUM_OUTSIDE, _NUM_INSIDE, _NUM_INTERIOR = 4000, 1500, 300


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodySamples:
    """Points around a body, in its frame."""

    inside: np.ndarray  # (p, 3) surface and interior, to be covered [m]
    outside: np.ndarray  # (x, 3) centers of balls that do not touch the robot [m]
    ball: np.ndarray  # (x,) their radii [m]
    cell: float  # volume that each outside point stands for [m^3]


def sample_bodies(
    model: mujoco.MjModel, pieces: dict[int, list[Piece]], rng: np.random.Generator
) -> dict[int, BodySamples]:
    """Points around every body.

    Args:
        model: the robot.
        pieces: convex pieces by body.
        rng: source of randomness.
    """
    surfaces = {body: surface_samples(own, _SPACING, rng) for body, own in pieces.items()}
    trees = {body: KDTree(points) for body, points in surfaces.items()}
    samples = {}
    for body, own in pieces.items():
        # To be covered: mostly surface, and some of the interior, so that nothing fits inside.
        interior = _box_points(surfaces[body], 0.0, 20 * _NUM_INTERIOR, rng)
        interior = interior[union_depth(own, interior) > 0][:_NUM_INTERIOR]
        surface = rng.permutation(surfaces[body])[: _NUM_INSIDE - len(interior)]
        outside, ball, cell = _outside(model, body, own, surfaces, trees, rng)
        samples[body] = BodySamples(
            inside=np.vstack([surface, interior]), outside=outside, ball=ball, cell=cell
        )
    return samples


def _box_points(
    surface: np.ndarray, border: float, num: int, rng: np.random.Generator
) -> np.ndarray:
    return rng.uniform(surface.min(0) - border, surface.max(0) + border, (num, 3))


def _outside(
    model: mujoco.MjModel,
    body: int,
    pieces: list[Piece],
    surfaces: dict[int, np.ndarray],
    trees: dict[int, KDTree],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Balls (x, 3), (x,) near a body that do not touch the robot, and the volume of each."""
    border = max(_BALLS) + _SHELL
    box = np.prod(np.ptp(surfaces[body], axis=0) + 2 * border)
    points, balls, drawn, kept = [], [], 0, 0
    while kept < _NUM_OUTSIDE:
        candidates = _box_points(surfaces[body], border, 4000, rng)
        ball = rng.choice(_BALLS, len(candidates))
        distance = trees[body].query(candidates, distance_upper_bound=border)[0]
        near = (distance > ball) & (distance < ball + _SHELL)
        near &= union_depth(pieces, candidates) < 0
        candidates, ball = candidates[near], ball[near]
        free = _clear_of_others(model, body, candidates, ball, trees, rng)
        points.append(candidates[free])
        balls.append(ball[free])
        drawn += 4000
        kept += int(free.sum())
    return np.vstack(points)[:_NUM_OUTSIDE], np.hstack(balls)[:_NUM_OUTSIDE], float(box / drawn)


def _clear_of_others(
    model: mujoco.MjModel,
    body: int,
    points: np.ndarray,
    ball: np.ndarray,
    trees: dict[int, KDTree],
    rng: np.random.Generator,
) -> np.ndarray:
    """Which balls touch no other body, in configurations drawn at random."""
    data = mujoco.MjData(model)
    lower, upper = joint_ranges(model)
    free = np.ones(len(points), bool)
    for group in np.array_split(np.arange(len(points)), max(len(points) // 20, 1)):
        data.qpos[:] = rng.uniform(lower, upper)
        mujoco.mj_kinematics(model, data)
        world = points[group] @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
        for other, tree in trees.items():
            if other != body:
                local = (world - data.xpos[other]) @ data.xmat[other].reshape(3, 3)
                near = tree.query(local, distance_upper_bound=max(_BALLS))[0]
                free[group] &= near > ball[group]
    return free


def fit_body(
    samples: BodySamples, num: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """The best found spheres that cover a body's samples.

    Args:
        samples: of the body.
        num: number of spheres, at most ``MAX_SPHERES``.
        rng: source of randomness.

    Returns:
        Centers (num, 3) and radii (num,) [m], and the volume of false alarms [m^3].
    """
    starts = [_start(samples.inside, num, rng) for _ in range(_STARTS)]
    centers = np.zeros((_STARTS, MAX_SPHERES, 3))
    radii = np.full((_STARTS, MAX_SPHERES), -1.0)  # unused: far from everything
    # One compiled descent serves any number of spheres: the spare ones have no effect.
    for k, (center, radius) in enumerate(starts):
        centers[k, :num], radii[k, :num] = center, radius
    arrays = (samples.outside, samples.ball, samples.inside)
    fitted = _descend(centers, radii, num, *(jnp.asarray(a, jnp.float32) for a in arrays))
    # Of all starts keep the one with the least false alarms, once every sample is covered.
    best = (np.inf, np.zeros((num, 3)), np.zeros(num))
    for center, radius in zip(*(np.asarray(a, np.float64)[:, :num] for a in fitted), strict=True):
        inside = np.linalg.norm(samples.inside[:, None] - center, axis=-1)
        radius = grow(inside, radius)
        gap = np.linalg.norm(samples.outside[:, None] - center, axis=-1) - radius
        volume = float(np.sum(gap.min(1) < samples.ball) * samples.cell)
        best = min(best, (volume, center, radius), key=lambda found: found[0])
    return best[1], best[2], best[0]


def _start(points: np.ndarray, num: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Spheres around the clusters that k-means finds."""
    points = points[rng.choice(len(points), 800)]
    centers = points[rng.choice(len(points), num, replace=False)]
    # Lloyd's iterations of k-means.
    for _ in range(15):
        nearest = np.linalg.norm(points[:, None] - centers, axis=-1).argmin(1)
        for k in np.unique(nearest):
            centers[k] = points[nearest == k].mean(0)
    distance = np.linalg.norm(points[:, None] - centers, axis=-1)
    nearest = distance.argmin(1)
    radii = [distance[nearest == k, k].max(initial=0.02) for k in range(num)]
    return centers, np.array(radii)


@jax.jit
def _descend(
    centers: jax.Array,
    radii: jax.Array,
    num: jax.Array,
    outside: jax.Array,
    ball: jax.Array,
    inside: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Improve (starts, spheres, 3) centers and (starts, spheres) radii by Adam."""
    used = jnp.arange(MAX_SPHERES) < num
    optimizer = optax.adam(optax.cosine_decay_schedule(2e-3, _STEPS, 0.02))

    def distance(spheres, points):
        center, radius = spheres
        gap = jnp.linalg.norm(points[:, None] - center, axis=-1) - radius
        return jnp.min(jnp.where(used, gap, jnp.inf), axis=-1)

    def loss(spheres, progress):
        # Soft counts of false alarms, which get sharper, and a penalty on bare points, which grows.
        width = 0.006 * (1 - progress) + 0.0015 * progress
        alarms = jnp.mean(jax.nn.sigmoid((ball - distance(spheres, outside)) / width))
        bare = jax.nn.relu(distance(spheres, inside) + 3e-4) / 1e-3
        return alarms + (0.3 + 3 * progress) * (jnp.mean(bare**2) + 0.002 * jnp.max(bare) ** 2)

    def step(carry, progress):
        spheres, state = carry
        updates, state = optimizer.update(jax.grad(loss)(spheres, progress), state)
        return (jax.tree.map(jnp.add, spheres, updates), state), None

    def descend(center, radius):
        carry = ((center, radius), optimizer.init((center, radius)))
        (spheres, _), _ = jax.lax.scan(step, carry, jnp.arange(_STEPS) / _STEPS)
        return spheres

    return jax.vmap(descend)(jnp.asarray(centers), jnp.asarray(radii))
