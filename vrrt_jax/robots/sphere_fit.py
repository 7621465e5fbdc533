"""Fit few spheres to a body, which stick out little where obstacles could be; takes minutes.

The command ``vrrt spheres`` fits with it. Robots are loaded with the quick covers of
:mod:`vrrt_jax.robots.sphere_cover`.

The spheres of a body minimize the volume of false alarms: places for the center of a ball-shaped
obstacle that touches a sphere but not the robot. Places around the base, where hardly an obstacle
stands, count little. The spheres are found by gradient descent from several
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

MAX_SPHERES = 16  # of one body
_STARTS = 3
_STEPS = 250
_ROUNDS = 2  # of going on from the best start, with the points that it left bare
_GENTLE = 0.5  # of the descent is left out then
_SPACING = 0.003  # [m] between surface samples
_BALLS = (0.04, 0.1)  # [m] radii of the obstacles that false alarms are counted for
_SHELL = 0.045  # [m] how far from touching they are counted
_NUM_OUTSIDE, _NUM_INSIDE, _NUM_INTERIOR = 2500, 1500, 200
_AROUND_BASE = 0.25  # of the reach: obstacles stand farther from the base's axis
_MIN_SHARE = 0.1  # of the places around a body that count, even if all are around the base


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodySamples:
    """Points around a body, in its frame."""

    surface: np.ndarray  # (s, 3) dense, to be covered [m]
    inside: np.ndarray  # (p, 3) some of the surface, then some of the interior [m]
    num_surface: int  # of the former
    outside: np.ndarray  # (x, 3) centers of balls that do not touch the robot [m]
    ball: np.ndarray  # (x,) their radii [m]
    cell: float  # volume that each outside point stands for, less where few obstacles are [m^3]


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
        share = max(_share_of_obstacles(model, body, outside, rng), _MIN_SHARE)
        samples[body] = BodySamples(
            surface=surfaces[body],
            inside=np.vstack([surface, interior]),
            num_surface=len(surface),
            outside=outside,
            ball=ball,
            cell=share * cell,
        )
    return samples


def _share_of_obstacles(
    model: mujoco.MjModel, body: int, points: np.ndarray, rng: np.random.Generator
) -> float:
    """The share of points (n, 3) around a body that are not around the base, as the arm moves."""
    data = mujoco.MjData(model)
    away, reach = [], 0.0
    for q in rng.uniform(*joint_ranges(model), (100, model.njnt)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        world = points @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
        away.append(np.linalg.norm(world[:, :2], axis=1))
        reach = max(reach, float(np.linalg.norm(data.xpos, axis=1).max()))
    return float(np.mean(np.array(away) > _AROUND_BASE * reach))


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
    # Clusters of the interior are slices along a long body, those of the surface are patches.
    whole, interior = samples.inside, samples.inside[samples.num_surface :]
    sources = [interior if k % 2 == 0 and len(interior) else whole for k in range(_STARTS)]
    starts = [_start(source, whole, num, rng) for source in sources]
    centers, radii = (np.array(part) for part in zip(*starts, strict=True))
    fitted = _descended(samples, centers, radii)
    # Of all starts keep the one with the least false alarms, once every sample is covered.
    best = min((_covering(samples, *spheres) for spheres in fitted), key=lambda found: found[2])
    for _ in range(_ROUNDS):
        # Half of the points to cover are now those that would have to be taken in by growing.
        center, radius = best[3]
        gap = _gaps(samples.surface, center, radius)
        hard = np.argsort(-gap)[: max(int(np.sum(gap > 0)), 1)]
        inside = samples.inside.copy()
        change = rng.choice(len(inside), len(inside) // 2, replace=False)
        inside[change] = samples.surface[rng.choice(hard, len(change))]
        changed = dataclasses.replace(samples, inside=inside)
        ((center, radius),) = _descended(changed, center[None], radius[None], begin=_GENTLE)
        best = min(best, _covering(samples, center, radius), key=lambda found: found[2])
    return best[:3]


def _gaps(points: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Distances (p,) of points (p, 3) from the nearest sphere [m]."""
    return (np.linalg.norm(points[:, None] - center, axis=-1) - radius).min(axis=1)


def _covering(
    samples: BodySamples, center: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, tuple[np.ndarray, np.ndarray]]:
    """Spheres grown over the surface, their volume of false alarms [m^3], and those before."""
    grown = grow(np.linalg.norm(samples.surface[:, None] - center, axis=-1), radius)
    is_alarm = _gaps(samples.outside, center, grown) < samples.ball
    return center, grown, float(np.sum(is_alarm) * samples.cell), (center, radius)


def _descended(
    samples: BodySamples, center: np.ndarray, radius: np.ndarray, begin: float = 0.0
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Improve spheres, (starts, num, 3) and (starts, num), from a share of the descent on."""
    # One compiled descent serves up to four numbers of spheres: the spare ones have no effect.
    num = radius.shape[1]
    spare = ((0, 0), (0, -num % 4))
    arrays = (
        np.pad(center, (*spare, (0, 0))),
        np.pad(radius, spare, constant_values=-1.0),
        samples.outside,
        samples.ball,
        samples.inside,
    )
    found = _descend(num, begin, *(jnp.asarray(a, jnp.float32) for a in arrays))
    centers, radii = (np.asarray(part, np.float64)[:, :num] for part in found)
    return list(zip(centers, radii, strict=True))


def _start(
    clustered: np.ndarray, points: np.ndarray, num: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Spheres around the clusters that k-means finds, so large that they reach their points."""
    clustered = clustered[rng.choice(len(clustered), 800)]
    centers = clustered[rng.choice(len(clustered), num, replace=False)]
    # Lloyd's iterations of k-means.
    for _ in range(15):
        nearest = np.linalg.norm(clustered[:, None] - centers, axis=-1).argmin(1)
        for k in np.unique(nearest):
            centers[k] = clustered[nearest == k].mean(0)
    distance = np.linalg.norm(points[:, None] - centers, axis=-1)
    nearest = distance.argmin(1)
    radii = [distance[nearest == k, k].max(initial=0.02) for k in range(num)]
    return centers, np.array(radii)


@jax.jit
def _descend(
    num: jax.Array,
    begin: jax.Array,
    centers: jax.Array,
    radii: jax.Array,
    outside: jax.Array,
    ball: jax.Array,
    inside: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Improve (starts, spheres, 3) centers and (starts, spheres) radii by Adam.

    ``begin`` is the share of the descent that is left out: then it begins sharp, in small steps.
    """
    used = jnp.arange(radii.shape[1]) < num
    optimizer = optax.adam(optax.cosine_decay_schedule(2e-3, _STEPS, 0.02))

    def distance(spheres, points):
        center, radius = spheres
        # A center may be one of the points: the derivative of a norm is not a number there.
        squared = jnp.sum((points[:, None] - center) ** 2, axis=-1)
        gap = jnp.sqrt(squared + 1e-12) - radius
        return jnp.min(jnp.where(used, gap, jnp.inf), axis=-1)

    def loss(spheres, progress):
        # Soft counts of false alarms, which get sharper, and a penalty on bare points, which grows.
        width = 0.006 * (1 - progress) + 0.0015 * progress
        alarms = jnp.mean(jax.nn.sigmoid((ball - distance(spheres, outside)) / width))
        bare = jax.nn.relu(distance(spheres, inside) + 3e-4) / 5e-3
        return alarms + (0.3 + 3 * progress) * (jnp.mean(bare**2) + 0.002 * jnp.max(bare) ** 2)

    def step(carry, progress):
        spheres, state = carry
        updates, state = optimizer.update(jax.grad(loss)(spheres, progress), state)
        moved = jax.tree.map(lambda x, change: x + (1 - begin) * change, spheres, updates)
        return (moved, state), None

    def descend(center, radius):
        carry = ((center, radius), optimizer.init((center, radius)))
        progress = begin + (1 - begin) * jnp.arange(_STEPS) / _STEPS
        (spheres, _), _ = jax.lax.scan(step, carry, progress)
        return spheres

    return jax.vmap(descend)(centers, radii)
