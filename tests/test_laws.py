"""What holds for whatever is drawn: metrics, rewiring, shortcuts, curves, cameras and pictures.

Each law has arrays of one shape, so that nothing compiles twice.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nrp_jax.learning import local_map
from nrp_jax.scene import reeds_shepp
from vrrt_jax.core import tree as trees
from vrrt_jax.core.edges import StraightLineEdges, nearest_turn, unwrapped
from vrrt_jax.core.rewire import rewire
from vrrt_jax.core.shortcut import path_length, prune, shortcut
from vrrt_jax.core.types import Expansion, pytree
from vrrt_jax.splat.camera import camera_from_matrix, cut, look_at, project, shrunk
from vrrt_jax.splat.camera_fields import camera_from_dict, camera_to_dict
from vrrt_jax.splat.images import check_views, shrink_views
from vrrt_jax.splat.types import SplatModel
from vrrt_jax.splat.windows import _cluster

pytestmark = pytest.mark.light_compilation
few = settings(deadline=None, max_examples=20, derandomize=True, database=None)
many = settings(few, max_examples=60)
TURN = 2 * np.pi
# Angles that are easy to get wrong, and any others.
angles = st.one_of(st.sampled_from(np.pi * np.arange(-4, 5) / 2), st.floats(-7, 7, width=32))
places = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-2, 2, width=32))
seeds = st.integers(0, 2**32 - 1)


@pytree
class Disc(StraightLineEdges):
    """A point in the plane that turns; a disc in the middle is solid."""

    lower: jax.Array
    upper: jax.Array
    is_continuous: jax.Array
    resolution: jax.Array

    def is_free(self, q):
        return jnp.hypot(q[0], q[1]) > 1.0


WORLD = Disc(
    lower=jnp.array([-2.0, -2.0, -np.pi]),
    upper=jnp.array([2.0, 2.0, np.pi]),
    is_continuous=jnp.array([False, False, True]),
    resolution=jnp.float32(0.02),
)
measured = jax.jit(lambda a, b: WORLD.distance(a, b))


def configurations(num):
    return st.lists(st.tuples(places, places, angles), min_size=num, max_size=num).map(
        lambda rows: np.array(rows, np.float32)
    )


@many
@given(configurations(3), st.lists(st.integers(-3, 3), min_size=3, max_size=3))
def test_lengths_of_edges_are_a_metric_that_knows_no_turns(q, turns):
    a, b, c = q
    ab, bc, ac = (float(measured(*pair)) for pair in ((a, b), (b, c), (a, c)))
    assert ab == pytest.approx(float(measured(b, a)), abs=1e-5) and measured(a, a) == 0
    assert ac <= ab + bc + 1e-5
    turned = b + np.float32(TURN) * np.array([0, 0, turns[0]], np.float32)
    assert float(measured(a, turned)) == pytest.approx(ab, abs=2e-5)
    near = nearest_turn(WORLD, turned, a)
    assert np.abs(near[2] - a[2]) <= np.pi + 1e-4
    path = unwrapped(WORLD, q)
    np.testing.assert_array_equal(path[0], q[0])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    np.testing.assert_allclose(steps, [ab, bc], atol=2e-5)


def free_path(seed, num):
    """A path (num, 3) around the disc, as crooked as a tree's."""
    rng = np.random.default_rng(seed)
    around = np.linspace(0, rng.uniform(2, 6), num) + rng.uniform(-0.05, 0.05, num)
    reach = rng.uniform(1.3, 1.9, num)
    place = reach * np.array([np.cos(around), np.sin(around)])
    return np.column_stack([place.T, np.cumsum(rng.uniform(-0.6, 0.6, num))]).astype(np.float32)


def is_clear(path):
    """Whether all edges of a path (P, 3) stay out of the disc, by its distance from segments."""
    a, step = path[:-1, :2].astype(float), np.diff(path[:, :2].astype(float), axis=0)
    share = np.clip(-(a * step).sum(1) / np.maximum((step**2).sum(1), 1e-12), 0, 1)
    return np.linalg.norm(a + share[:, None] * step, axis=1).min() > 1.0 - 1e-3


@few
@given(seeds)
def test_shorter_paths_are_no_longer_and_touch_nothing(seed):
    path = free_path(seed, 24)
    assume(is_clear(path))
    for make in (lambda q: shortcut(WORLD, q, key=jax.random.key(seed)), lambda q: prune(WORLD, q)):
        short = make(path)
        np.testing.assert_allclose(short[[0, -1]], path[[0, -1]], atol=1e-6)
        assert path_length(WORLD, short) <= path_length(WORLD, path) + 1e-4
        assert is_clear(short)
        again = make(short)
        assert path_length(WORLD, again) <= path_length(WORLD, short) + 1e-4 and is_clear(again)


rewired = jax.jit(
    lambda tree, expansion, radius: rewire(
        WORLD, tree, expansion, radius=radius, edge_steps=64, checks=16, tries=2, ancestors=2
    )
)


grown = jax.jit(trees.insert)


@many
@given(seeds, st.integers(0, 12), arrays(bool, 8))
def test_children_are_appended_in_their_order_as_far_as_there_is_room(seed, size, valid):
    rng, capacity = np.random.default_rng(seed), 12
    tree = trees.create(jnp.zeros((1, 3)), jnp.zeros(1), jnp.zeros((1, 2)), capacity)
    old = rng.normal(size=(capacity, 3)).astype(np.float32)
    tree = dataclasses.replace(tree, q=jnp.asarray(old), size=jnp.int32(size))
    children = {
        "q": rng.normal(size=(8, 3)).astype(np.float32),
        "parent": rng.integers(0, max(size, 1), 8).astype(np.int32),
        "cost": rng.uniform(size=8).astype(np.float32),
        "score": rng.uniform(size=8).astype(np.float32),
        "payload": rng.normal(size=(8, 2)).astype(np.float32),
    }
    after, slot = grown(tree, **children, valid=valid)
    kept = np.flatnonzero(valid)[: capacity - size]
    end = size + len(kept)
    assert int(after.size) == end
    expected = np.full(8, capacity)
    expected[kept] = np.arange(size, end)
    np.testing.assert_array_equal(slot, expected)
    for name, rows in children.items():
        np.testing.assert_array_equal(np.asarray(getattr(after, name))[size:end], rows[kept])
    untouched = np.r_[:size, end:capacity]
    np.testing.assert_array_equal(np.asarray(after.q)[untouched], old[untouched])


seen = jax.jit(local_map.window)


@many
@given(seeds, st.tuples(places, places), st.tuples(places, places))
def test_windows_hold_the_cells_around_the_base(seed, base, origin):
    """By a plain look at each cell's place; outside the map all is solid."""
    half, cell = local_map.SIDE // 2, np.float32(0.1)
    solid = np.random.default_rng(seed).uniform(size=(30, 25, 2)) < 0.3
    padded = np.pad(solid, [(half, half), (half, half), (0, 0)], constant_values=True)
    origin, q = np.float32(origin), np.float32([*np.abs(base), 0.4])
    q[:2] += origin
    window = np.asarray(seen(padded, q, cell, origin))
    middle = np.asarray(local_map.center(q, cell, origin))
    assert np.abs(middle - q[:2]).max() <= cell / 2 + 1e-5
    for i, j in np.random.default_rng(seed).integers(0, local_map.SIDE, (40, 2)):
        place = middle + cell * (np.array([i, j]) - half + 0.5)  # of the middle of the cell
        x, y = np.floor((place - origin) / cell).astype(int)
        inside = 0 <= x < 30 and 0 <= y < 25
        np.testing.assert_array_equal(window[i, j], solid[x, y] if inside else [True, True])


@few
@given(seeds, st.floats(0.1, 1.2))
def test_rewiring_keeps_a_tree_and_makes_no_node_dearer(seed, radius):
    rng, size, new = np.random.default_rng(seed), 24, 4
    q = free_path(seed, size)
    parent = np.r_[-1, [rng.integers(max(0, k - 3), k) for k in range(1, size)]].astype(np.int32)
    parent[-new:] = np.minimum(parent[-new:], size - new - 1)  # new nodes have no children
    tree = trees.create(q[:1], jnp.zeros(1), None, 32)
    tree = dataclasses.replace(
        tree,
        q=tree.q.at[:size].set(q),
        parent=tree.parent.at[:size].set(parent),
        size=jnp.int32(size),
    )
    tree = dataclasses.replace(tree, cost=tree.cost.at[:size].set(costs_of(q, parent)))
    accepted = rng.uniform(size=new) < 0.8
    # Those that were not accepted take no slot.
    tree = dataclasses.replace(tree, size=jnp.int32(size - new + accepted.sum()))
    index = np.where(accepted, size - new + np.cumsum(accepted) - 1, 32)
    expansion = Expansion(
        q=jnp.asarray(np.where(accepted[:, None], q[np.minimum(index, size - 1)], q[-new:])),
        node_index=jnp.asarray(index),
        accepted=jnp.asarray(accepted),
        blocked=jnp.zeros(new, bool),
    )
    done = rewired(tree, expansion, jnp.float32(radius))
    used = int(tree.size)
    after = np.asarray(done.parent[:used])
    np.testing.assert_allclose(done.cost[:used], costs_of(q[:used], after), atol=1e-4)
    assert np.all(done.cost[:used] <= tree.cost[:used] + 1e-4) and after[0] == -1
    changed = np.flatnonzero(after != parent[:used])
    for node in changed:
        assert is_clear(q[[after[node], node]])
    np.testing.assert_array_equal(done.q, tree.q)


def costs_of(q, parent):
    """Lengths of the ways to the root; a cycle is an error."""
    costs = np.zeros(len(parent))
    for node in range(len(parent)):
        here, seen = node, set()
        while parent[here] >= 0:
            assert here not in seen, "a cycle"
            seen.add(here)
            step = q[here] - q[parent[here]]
            step[2] -= TURN * np.round(step[2] / TURN)
            costs[node] += np.linalg.norm(step)
            here = parent[here]
    return costs


RADIUS = 0.25
curve_length = jax.jit(lambda a, b: reeds_shepp.length(a, b, RADIUS))


@jax.jit
def driven(a, b):
    return reeds_shepp.follow(a, reeds_shepp.shortest(a, b, RADIUS), RADIUS)


@many
@given(configurations(3), st.floats(-3, 3, width=32), st.tuples(places, places))
def test_reeds_shepp_curves_arrive_and_their_lengths_are_a_metric(q, angle, shift):
    a, b, c = q
    ab, bc, ac = (float(curve_length(*pair)) for pair in ((a, b), (b, c), (a, c)))
    assert ab == pytest.approx(float(curve_length(b, a)), abs=2e-3)
    assert ac <= ab + bc + 2e-3 and float(curve_length(a, a)) < 2e-3
    turned = abs((b[2] - a[2] + np.pi) % TURN - np.pi)
    assert ab >= max(np.linalg.norm(b[:2] - a[:2]), RADIUS * turned) - 2e-3
    end = np.asarray(driven(a, b))
    np.testing.assert_allclose(end[:2], b[:2], atol=2e-3)
    assert abs((end[2] - b[2] + np.pi) % TURN - np.pi) < 5e-3
    # Nothing depends on where the plane's origin is, and which way it faces.
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.array([[cos, sin], [-sin, cos]])
    moved = [np.r_[p[:2] @ rotation + shift, p[2] + angle].astype(np.float32) for p in (a, b)]
    assert float(curve_length(*moved)) == pytest.approx(ab, abs=5e-3)


directions = arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(
    lambda v: np.linalg.norm(v) > 0.3 and np.hypot(v[0], v[1]) > 0.05
)


@many
@given(directions, st.floats(0.5, 5), st.floats(20, 90), st.integers(20, 60), seeds)
def test_cameras_come_back_and_see_the_same_through_parts(toward, far, fovy, half, seed):
    width, height = 2 * half, 2 * half + 8
    eye = far * toward / np.linalg.norm(toward)
    camera = look_at(eye, (0, 0, 0), fovy_deg=fovy, height=height, width=width)
    again = camera_from_dict(camera_to_dict(camera), (height, width))
    for name in ("world_to_cam", "focal", "principal_point"):
        np.testing.assert_allclose(
            getattr(again, name), getattr(camera, name), atol=2e-5, rtol=1e-6
        )
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (5, 3)).astype(np.float32)
    pixels, depth = map(np.asarray, project(camera, points))
    assert np.all(depth > 0) and np.abs(np.asarray(project(camera, jnp.zeros(3))[0]) - [
        width / 2, height / 2]).max() < 0.01  # fmt: skip
    np.testing.assert_allclose(project(shrunk(camera, 2), points)[0], pixels / 2, atol=1e-3)
    corner = np.array([3.0, 5.0], np.float32)
    part, _ = project(cut(camera, corner, 8, 8), points)
    np.testing.assert_allclose(part, pixels - corner, atol=1e-3)
    # Back along the rays: the point at that depth.
    pose = np.linalg.inv(np.asarray(camera.world_to_cam, float))
    rays = (pixels - np.asarray(camera.principal_point)) / float(camera.focal)
    there = np.column_stack([rays, np.ones(5)]) * depth[:, None] @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(there, points, atol=1e-3)
    stretched = camera_from_matrix(
        np.asarray(camera.world_to_cam),
        focal=(1.2 * float(camera.focal), float(camera.focal)),
        height=height,
        width=width,
    )
    wide, _ = project(stretched, points)
    np.testing.assert_allclose((wide - pixels)[:, 1], 0, atol=1e-3)
    centered = (pixels - [width / 2, height / 2])[:, 0]
    np.testing.assert_allclose(np.asarray(wide)[:, 0] - width / 2, 1.2 * centered, atol=1e-3)


@few
@given(seeds, st.integers(1, 5))
def test_shrunk_pictures_keep_sums_and_stay_in_range(seed, factor):
    rng = np.random.default_rng(seed)
    image = rng.uniform(size=(60, 60, 4)).astype(np.float32)
    image[..., 3] = 0.0
    image[10:40, 10:40, 3] = rng.uniform(size=(30, 30))
    camera = look_at((1, 0, 0), (0, 0, 0), height=60, width=60)
    (view,) = check_views([image], [camera])
    goal, _ = shrink_views([view], round(60 / factor))
    alpha = np.asarray(goal.alpha[0])
    assert alpha.min() >= 0 and alpha.max() <= 1 + 1e-6
    np.testing.assert_allclose(alpha.mean(), image[..., 3].mean(), atol=1e-4)
    np.testing.assert_allclose(np.asarray(goal.rgb).mean(), view.rgb.mean(), atol=1e-4)
    assert np.all(np.asarray(goal.valid) == 1)


@few
@given(st.lists(st.integers(1, 40), min_size=1, max_size=5), seeds)
def test_clusters_hold_the_same_splats(counts, seed):
    rng = np.random.default_rng(seed)
    link = np.repeat(np.arange(len(counts)), counts)
    num = len(link)
    model = SplatModel(
        mean=rng.normal(size=(num, 3)),
        radius=np.arange(1.0, num + 1),
        density=np.ones(num),
        rgb=np.zeros((num, 3)),
        view_color_gradient=np.zeros((num, 3)),
        link=link,
        tau=np.float32(0.03),
    )
    clustered, size = _cluster(model)
    real = np.asarray(clustered.density) > 0
    assert sorted(np.asarray(clustered.radius)[real]) == list(range(1, num + 1))
    links = np.asarray(clustered.link).reshape(-1, size)
    assert np.all(links == links[:, :1]) and np.all(np.diff(links[:, 0]) >= 0)
