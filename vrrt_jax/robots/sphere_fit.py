"""Fit few spheres to a body, which stick out little where obstacles could be; takes minutes.

The command ``vrrt spheres`` fits with it. Robots are loaded with the quick covers of
:mod:`vrrt_jax.robots.sphere_cover`.

The spheres of a body minimize the volume of false alarms: places for the center of a ball-shaped
obstacle that touches a sphere but not the robot. Places around the base, where hardly an obstacle
stands, count little. The spheres are found by gradient descent from several starts, with the
surface as a constraint (:mod:`vrrt_jax.robots.sphere_descent`), and grown over what is left bare.
A descent keeps spheres where they began, so that then one at a time moves to where it saves more.
"""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial import KDTree

from vrrt_jax.robots.convex_parts import Piece, grow, surface_samples, union_depth
from vrrt_jax.robots.limits import joint_ranges
from vrrt_jax.robots.sphere_descent import descend

MAX_SPHERES = 32  # of one body
_STARTS = 4
_ROUNDS = 4  # at last, with the points that are hardest to contain
_GENTLE = 0.5  # of the descent is left out after a move
_OVERLAP = 1e-3  # [m] a point that is deeper in a second sphere needs no other one
_SMALLER = 0.8  # of the radius of a sphere, each of the two that take its place
_SPACING = 0.003  # [m] between surface samples
_BALLS = (0.04, 0.1)  # [m] radii of the obstacles that false alarms are counted for
_SHELL = 0.045  # [m] how far from touching they are counted
_NUM_OUTSIDE, _NUM_INSIDE, _NUM_INTERIOR = 5000, 8000, 400
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
        # As many points of every body, so that one compiled descent serves all.
        num, whole = _NUM_INSIDE - len(interior), surfaces[body]
        surface = whole[rng.choice(len(whole), num, replace=len(whole) < num)]
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
    samples: BodySamples, num: int, rng: np.random.Generator, *, moves: int = 0
) -> tuple[np.ndarray, np.ndarray, float]:
    """The best found spheres that cover a body's samples.

    Args:
        samples: of the body.
        num: number of spheres, at most ``MAX_SPHERES``.
        rng: source of randomness.
        moves: how often one sphere moves to where it may save more; each takes a
            descent. Without any the fit is quick, and coarser.

    Returns:
        Centers (num, 3) and radii (num,) [m], and the volume of false alarms [m^3].
    """
    # Clusters of the interior are slices along a long body, those of the surface are patches.
    whole, interior = samples.inside, samples.inside[samples.num_surface :]
    sources = [interior if k % 2 == 0 and len(interior) else whole for k in range(_STARTS)]
    fitted = [_fitted(samples, *_start(source, whole, num, rng), rng) for source in sources]
    best = min(fitted, key=lambda found: found[2])
    for _ in range(moves if num > 1 else 0):
        begin = _moved(samples, *best[:2], rng)
        best = min(best, _fitted(samples, *begin, rng, _GENTLE), key=lambda found: found[2])
    for _ in range(_ROUNDS if moves else 0):
        # Half of the points to contain are now those that are nearest to being bare.
        inside = samples.inside.copy()
        half = len(inside) // 2
        gap = _gaps(samples.surface, *best[:2]).min(axis=1)
        inside[:half] = samples.surface[np.resize(np.argsort(-gap)[:half], half)]
        closer = dataclasses.replace(samples, inside=inside)
        best = min(best, _fitted(closer, *best[:2], rng, _GENTLE), key=lambda found: found[2])
    return best


def _fitted(
    samples: BodySamples,
    center: np.ndarray,
    radius: np.ndarray,
    rng: np.random.Generator,
    begin: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Spheres after a descent, grown over the surface, and their volume of false alarms [m^3]."""
    obstacles, seed = (samples.outside, samples.ball), int(rng.integers(1 << 31))
    center, radius = descend(center, radius, obstacles, samples.inside, seed=seed, begin=begin)
    radius = grow(np.linalg.norm(samples.surface[:, None] - center, axis=-1), radius)
    is_alarm = _gaps(samples.outside, center, radius).min(axis=1) < samples.ball
    return center, radius, float(np.sum(is_alarm) * samples.cell)


def _moved(
    samples: BodySamples, center: np.ndarray, radius: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The same spheres, but one that others could stand in for halves the work of a bad one."""
    gaps = _gaps(samples.outside, center, radius)
    alarms = np.bincount(
        gaps.argmin(axis=1)[gaps.min(axis=1) < samples.ball], minlength=len(radius)
    )
    bad = rng.choice(len(radius), p=(alarms + 1.0) / np.sum(alarms + 1.0))
    # Points that no other sphere holds.
    gaps = _gaps(samples.surface, center, radius)
    is_own = np.partition(gaps, 1, axis=1)[:, 1] > -_OVERLAP
    own = np.bincount(gaps.argmin(axis=1)[is_own], minlength=len(radius))
    weight = 1.0 / (own + 1.0)
    weight[bad] = 0.0
    idle = rng.choice(len(radius), p=weight / weight.sum())
    direction = rng.normal(size=3)
    shift = radius[bad] / 2 * direction / np.linalg.norm(direction)
    center, radius = center.copy(), radius.copy()
    center[[bad, idle]] = center[bad] - shift, center[bad] + shift
    radius[[bad, idle]] = _SMALLER * radius[bad]
    return center, radius


def _gaps(points: np.ndarray, center: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Distances (p, n) of points (p, 3) from spheres [m]; negative inside."""
    return np.linalg.norm(points[:, None] - center, axis=-1) - radius


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
