"""Reeds-Shepp curves: against a grid of words, a shortest-path search, and their own geometry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import csgraph

from nrp_jax.scene import reeds_shepp

pytestmark = pytest.mark.light_compilation

RADIUS = 0.1
length = jax.jit(lambda a, b: reeds_shepp.length(a, b, RADIUS))


@jax.jit
def interpolate(a, b, fraction):
    """Poses (..., 3) at a fraction (...) of the shortest curves."""
    curve = reeds_shepp.shortest(a, b, RADIUS)
    return reeds_shepp.follow(a, reeds_shepp.truncate(curve, fraction, RADIUS), RADIUS)


def poses(rng, n, reach=0.6):
    return np.column_stack(
        [rng.uniform(-reach, reach, (n, 2)), rng.uniform(-np.pi, np.pi, n)]
    ).astype(np.float32)


def turned(difference):
    return (difference + np.pi) % (2 * np.pi) - np.pi


def integrate(pose, curve, steps=400):
    """Drive a curve in small straight steps, in numpy."""
    x, y, heading = (float(v) for v in pose)
    for drive, turn in zip(curve.drive, curve.turn, strict=True):
        step = float(drive) / steps
        for _ in range(steps):
            heading += step * float(turn) / 2
            x, y = x + RADIUS * step * np.cos(heading), y + RADIUS * step * np.sin(heading)
            heading += step * float(turn) / 2
    return np.array([x, y, heading])


def test_known_lengths():
    start = jnp.zeros(3)
    ahead, behind = jnp.array([2.0, 0, 0]), jnp.array([-2.0, 0, 0])
    around = jnp.array([0.0, 2 * RADIUS, np.pi])
    on_the_spot = jnp.array([0.0, 0, np.pi])
    np.testing.assert_allclose(length(start, ahead), 2.0, rtol=1e-6)
    np.testing.assert_allclose(length(start, behind), 2.0, rtol=1e-6)
    np.testing.assert_allclose(length(start, around), np.pi * RADIUS, rtol=1e-5)
    # Three arcs of 60 degrees, the middle one in reverse.
    np.testing.assert_allclose(length(start, on_the_spot), np.pi * RADIUS, rtol=1e-4)
    assert float(length(start, start)) == 0.0


def test_curves_lead_to_the_goal_when_driven_step_by_step(rng):
    a, b = poses(rng, 40), poses(rng, 40)
    curves = jax.jit(lambda a, b: reeds_shepp.shortest(a, b, RADIUS))(a, b)
    for i in range(len(a)):
        end = integrate(a[i], jax.tree.map(lambda leaf: np.asarray(leaf)[i], curves))  # noqa: B023
        np.testing.assert_allclose(end[:2], b[i, :2], atol=2e-4)
        assert abs(turned(end[2] - b[i, 2])) < 1e-4
    driven = RADIUS * np.sum(np.abs(curves.drive), axis=0)
    np.testing.assert_allclose(length(a, b), driven, atol=1e-5)


def test_no_shorter_way_exists_on_a_lattice_of_poses():
    """A graph of all poses near the start, linked by small arcs and lines, knows no shortcut.

    Its paths are curves a car can drive but for the rounding of their ends, which is bounded.
    """
    n, turns, extent = 41, 32, 0.4
    xy, step_angle = np.linspace(-extent, extent, n), 2 * np.pi / turns
    cell = xy[1] - xy[0]
    grid = np.stack(np.meshgrid(range(n), range(n), range(turns), indexing="ij"), -1).reshape(-1, 3)
    heading = grid[:, 2] * step_angle
    rows, columns, costs = [], [], []
    for turn in (-1, 0, 1):
        for drive in (-1, 1):
            angle = turn * drive * step_angle
            way = RADIUS * step_angle if turn else cell
            middle = heading + angle / 2
            chord = drive * (2 * RADIUS * np.sin(step_angle / 2) if turn else cell)
            x = xy[grid[:, 0]] + chord * np.cos(middle)
            y = xy[grid[:, 1]] + chord * np.sin(middle)
            i, j = np.rint((np.stack([x, y]) + extent) / cell).astype(int)
            k = (grid[:, 2] + turn * drive) % turns
            inside = (i >= 0) & (i < n) & (j >= 0) & (j < n)
            rows.append(np.flatnonzero(inside))
            columns.append(np.ravel_multi_index((i[inside], j[inside], k[inside]), (n, n, turns)))
            costs.append(np.full(inside.sum(), way))
    graph = sparse.csr_matrix(
        (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))),
        shape=(len(grid),) * 2,
    )
    middle = np.ravel_multi_index((n // 2, n // 2, 0), (n, n, turns))
    found = csgraph.dijkstra(graph, indices=middle)
    goals = np.column_stack([xy[grid[:, 0]], xy[grid[:, 1]], heading]).astype(np.float32)
    exact = np.asarray(length(jnp.zeros((len(goals), 3)), goals))
    near = np.flatnonzero(np.abs(goals[:, :2]).max(1) < 0.3)
    # Rounding every step lets the lattice cheat a little; it never wins by more than that.
    assert np.quantile(exact[near] - found[near], 0.999) < 0.12
    assert np.median(np.abs(exact[near] - found[near])) < 0.05


def test_metric(rng):
    a, b, c = poses(rng, 4000), poses(rng, 4000), poses(rng, 4000)
    ab, bc, ac = length(a, b), length(b, c), length(a, c)
    np.testing.assert_allclose(ab, length(b, a), atol=1e-4)
    assert float(jnp.min(ab + bc - ac)) > -1e-4
    bound = np.maximum(
        np.linalg.norm(a[:, :2] - b[:, :2], axis=1), RADIUS * np.abs(turned(a[:, 2] - b[:, 2]))
    )
    assert np.all(np.asarray(ab) >= bound - 1e-5)


def test_interpolation_is_continuous_and_keeps_to_the_shortest_way(rng):
    a, b = poses(rng, 300), poses(rng, 300)
    fraction = np.linspace(0, 1, 201, dtype=np.float32)
    path = np.asarray(interpolate(a[:, None], b[:, None], fraction[None]))
    total = np.asarray(length(a, b))
    for end, pose in ((0, a), (-1, b)):
        np.testing.assert_allclose(path[:, end, :2], pose[:, :2], atol=1e-4)
        assert np.abs(turned(path[:, end, 2] - pose[:, 2])).max() < 1e-3
    step = np.diff(path, axis=1)
    curve = jax.jit(lambda a, b: reeds_shepp.shortest(a, b, RADIUS))(a, b)
    longest = np.asarray(reeds_shepp.extent(curve, RADIUS))[:, None] / 200
    turn = sum(np.abs(d) * (t != 0) for d, t in zip(curve.drive, curve.turn, strict=True))
    assert np.all(longest >= np.asarray(turn)[:, None] / 200 - 1e-6)
    # Neither the way nor the turn of a step is longer than its share of the extents.
    assert np.all(np.linalg.norm(step[..., :2], axis=2) <= longest + 1e-4)
    assert np.all(np.abs(turned(step[..., 2])) <= longest + 1e-3)
    middle = path[:, 80]
    np.testing.assert_allclose(length(a, middle) + length(middle, b), total, atol=5e-3)


def test_wide_turns_scale_with_the_radius(rng):
    a, b = poses(rng, 100), poses(rng, 100)
    large = np.array([5.0, 5.0, 1.0], np.float32)
    wide = jax.jit(reeds_shepp.length)(a * large, b * large, 5 * RADIUS)
    np.testing.assert_allclose(wide, 5 * length(a, b), rtol=1e-4)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_any_leading_axes(rng, shape):
    n = int(np.prod(shape))
    a, b = poses(rng, n).reshape(*shape, 3), poses(rng, n).reshape(*shape, 3)
    assert jax.eval_shape(length, a, b).shape == shape
    assert jax.eval_shape(interpolate, a, b, jnp.float32(0.5)).shape == (*shape, 3)
