"""Maps, distance fields and configuration checks in homes."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nrp_jax
from nrp_jax.bench import checks
from nrp_jax.bench.checks import SphereLoop
from nrp_jax.homes.grid import load_map
from nrp_jax.scene.exact import ExactScene, merge_cells
from nrp_jax.scene.link_shapes import segment_to_cylinder
from nrp_jax.scene.near_cells import make_near_cells, touches
from nrp_jax.scene.world import CarWorld
from vrrt_jax.core.edge_checks import free_prefix
from vrrt_jax.core.planners.rrt import sample_configurations

pytestmark = pytest.mark.light_compilation

MAPS = Path(os.environ.get("NRP_MAPS", "maps-are-elsewhere"))


# One compiled program each: operation by operation, curves of the Fetch take seconds.
interpolate = jax.jit(lambda world, q_a, q_b, fraction: world.interpolate(q_a, q_b, fraction))
distance = jax.jit(lambda world, q_a, q_b: world.distance(q_a, q_b))
span = jax.jit(lambda world, q_a, q_b: world.span(world.edge(q_a, q_b)))


def cluttered(rng, shape, share=0.04):
    occupied = rng.random(shape) < share
    occupied[2:5, 2:5] = False
    return nrp_jax.Grid(occupied=occupied, origin=(-1.0, 0.5, 0.0))


@pytest.fixture(scope="module")
def worlds():
    """Both robots among random cells: (robot, grid, world)."""
    rng = np.random.default_rng(0)
    snake, fetch = nrp_jax.load_robot("snake"), nrp_jax.load_robot("fetch")
    flat, tall = cluttered(rng, (40, 30, 1)), cluttered(rng, (50, 40, 20), 0.002)
    return {
        "snake": (snake, flat, nrp_jax.build_world(snake, flat)),
        "fetch": (fetch, tall, nrp_jax.build_world(fetch, tall)),
    }


def distance_to_cells(grid, points):
    """Exact distances (n,) from points (n, 3) to the solid cells, and to what is beside the map."""
    dims = 2 if grid.planar else 3
    low = np.argwhere(grid.occupied) * grid.resolution + grid.origin
    gap = np.maximum(low - points[:, None], points[:, None] - low - grid.resolution)
    near = np.linalg.norm(np.maximum(gap[..., :dims], 0), axis=2).min(axis=1)
    first, last = np.array(grid.origin), grid.origin + grid.size
    beside = np.minimum(points - first, last - points)[:, :2].min(axis=1)
    return np.minimum(near, np.maximum(beside, 0))


@pytest.mark.parametrize("name", ["snake", "fetch"])
@pytest.mark.parametrize("largest", [0.06, 0.17])
def test_spheres_touch_the_cells_that_are_near_enough(worlds, rng, name, largest):
    _, grid, _ = worlds[name]
    low, high = np.array(grid.origin), grid.origin + grid.size
    points = rng.uniform(low - 0.2, high + 0.2, (4000, 3))
    radius = rng.uniform(0.01, largest, 4000).astype(np.float32)
    exact = distance_to_cells(grid, points)
    from_corner = (points - [*grid.origin[:2], 0.0]).astype(np.float32)
    found = np.asarray(touches(make_near_cells(grid, largest), from_corner.T, radius))
    assert found[exact < radius].all() and not found[exact > radius + 3e-5].any()
    assert 0.02 < found.mean() < 0.98


@pytest.mark.parametrize("name", ["snake", "fetch"])
def test_no_collision_is_missed(worlds, name):
    """Against an exact loop over the same spheres and against C MuJoCo with the primitives."""
    robot, grid, world = worlds[name]
    q = np.asarray(sample_configurations(world, jax.random.key(0), 1024))
    free = np.asarray(nrp_jax.batch_is_free(world, q))
    loop, scene = SphereLoop(robot, grid), ExactScene(robot, grid)
    by_loop = np.array([loop.is_free(row) for row in q])
    by_mujoco = np.array([not scene.touching(row) for row in q])
    assert 0.03 < free.mean() < 0.9
    assert not np.any(free & ~by_loop)
    assert not np.any(free & ~by_mujoco)
    assert np.mean(~free & by_loop) < 0.01  # false alarms
    assert np.mean(~free & by_mujoco) < (0.04 if name == "snake" else 0.02)


def test_planar_boxes_stand_where_the_snake_is():
    occupied = np.zeros((40, 40), bool)
    occupied[20:22] = True
    grid = nrp_jax.Grid(occupied=occupied, origin=(0.0, 0.0, -2.0))
    scene = ExactScene(nrp_jax.load_robot("snake"), grid)
    q = np.array([1.0, 1.0, 0.6, 1.0, -0.8, 1.0, -0.8, 0.9])
    assert not scene.touching(q)
    for x in (2.1, 4.1):  # the wall, and what is beside the map
        q[0] = x
        assert "touches the map" in scene.describe(scene.touching(q)[0])


def test_rates_of_fewer_configurations_than_a_batch(worlds, monkeypatch):
    monkeypatch.setattr(checks, "_rate", lambda num, *_: float(num))
    robot, grid, _ = worlds["snake"]
    rates = checks.run(robot, grid, num=100)["checks_per_s"]
    assert rates == {"batched": 100, "sphere_loop": 100, "mujoco": 100}
    with pytest.raises(ValueError, match="num is 0; expected at least 1"):
        checks.run(robot, grid, num=0)


def test_outside_the_map_all_is_solid(worlds):
    for robot, grid, _ in worlds.values():
        clear = nrp_jax.Grid(occupied=np.zeros((40, 40, 20)), origin=grid.origin)
        empty = nrp_jax.build_world(robot, clear)
        q = np.zeros((5, robot.num_joints), np.float32)
        q[:, 3 if robot.planar else 5] = 1.0 if robot.planar else -1.0
        if not robot.planar:
            q[:, 3] = 0.2
        middle = np.array(grid.origin[:2]) + 2.0
        q[:, :2] = middle + np.array([[0, 0], [2.5, 0], [0, 2.5], [-9, 0], [0, -90]])
        assert nrp_jax.batch_is_free(empty, q).tolist() == [True, False, False, False, False]


def test_the_floor_stops_the_arm():
    fetch = nrp_jax.load_robot("fetch")
    world = nrp_jax.build_world(fetch, nrp_jax.Grid(occupied=np.zeros((60, 60, 20))))
    q = np.zeros((2, 11), np.float32)
    q[:, :2], q[:, 3] = 3.0, 0.1
    q[1, 5] = 1.2  # the straight arm points down
    assert nrp_jax.batch_is_free(world, q).tolist() == [True, False]


def test_segments_and_an_upright_cylinder(rng):
    """Against the nearest of many points along each segment."""
    start, end = rng.uniform(-0.6, 0.6, (2, 3, 500))
    end[:, :50] = start[:, :50]  # points
    start[:2, 50:60] = end[:2, 50:60] = 0.0  # on the axis
    found = np.asarray(segment_to_cylinder(start, end - start, 0.28, 0.37))
    point = start + np.linspace(0, 1, 2001)[:, None, None] * (end - start)
    beside = np.maximum(np.linalg.norm(point[:, :2], axis=1) - 0.28, 0)
    exact = np.hypot(beside, np.maximum(point[:, 2] - 0.37, 0)).min(axis=0)
    assert np.all(found <= exact + 1e-6) and np.all(found > exact - 2e-3)


def test_another_home_does_not_compile_again(worlds):
    robot, grid, world = worlds["fetch"]
    q = sample_configurations(world, jax.random.key(1), 1500)
    before = nrp_jax.batch_is_free(world, q)
    other = nrp_jax.with_grid(world, nrp_jax.Grid(occupied=~grid.occupied, origin=grid.origin))
    compiled = nrp_jax.batch_is_free.__wrapped__._cache_size()
    assert not np.any(nrp_jax.batch_is_free(other, q)) and np.any(before)
    assert nrp_jax.batch_is_free.__wrapped__._cache_size() == compiled


@pytest.mark.parametrize("name", ["snake", "fetch"])
def test_edges_and_metric(worlds, name):
    robot, _, world = worlds[name]
    q_a, q_b = sample_configurations(world, jax.random.key(2), 64).reshape(2, 32, -1)
    np.testing.assert_allclose(distance(world, q_a, q_b), distance(world, q_b, q_a), rtol=1e-4)
    if name == "snake":
        step = np.array(q_b - q_a)
        step[:, 2] = (step[:, 2] + np.pi) % (2 * np.pi) - np.pi  # q1 alone is_continuous
        base, arm = np.linalg.norm(step[:, :2], axis=1), np.linalg.norm(step[:, 2:], axis=1)
        np.testing.assert_allclose(distance(world, q_a, q_b), base + 0.167 * arm, rtol=1e-4)
    ends = [interpolate(world, q_a, q_b, f) for f in (0.0, 1.0)]
    for end, q in zip(ends, (q_a, q_b), strict=True):
        apart = np.array(end - q)
        is_continuous = np.asarray(world.is_continuous)
        apart[:, is_continuous] = (apart[:, is_continuous] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(apart).max() < 1e-3
    middle = interpolate(world, q_a, q_b, 0.5)
    first, second = distance(world, q_a, middle), distance(world, middle, q_b)
    np.testing.assert_allclose(first + second, distance(world, q_a, q_b), atol=0.01)
    if name == "snake":  # the Fetch's edges are cut by how far they go or turn
        np.testing.assert_allclose(first, distance(world, q_a, q_b) / 2, atol=0.01)


@pytest.mark.parametrize("name", ["snake", "fetch"])
def test_no_joint_moves_farther_in_a_sub_step_than_the_resolution(worlds, name):
    _, _, world = worlds[name]
    q_a, q_b = sample_configurations(world, jax.random.key(5), 64).reshape(2, 32, -1)
    num = np.ceil(np.asarray(span(world, q_a, q_b)) / float(world.resolution))
    for start, end, parts in zip(q_a, q_b, num.astype(int), strict=True):
        fraction = np.minimum(np.arange(200) / parts, 1.0).astype(np.float32)
        step = np.diff(interpolate(world, start[None], end[None], fraction), axis=0)
        is_continuous = np.asarray(world.is_continuous)
        step[:, is_continuous] = (step[:, is_continuous] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(step).max() <= 1.01 * float(world.resolution)


@pytest.mark.parametrize("name", ["snake", "fetch"])
def test_distances_to_nodes_agree_with_the_metric(worlds, name):
    """The nearest node is right; of the Fetch's, only a shortlist is answered."""
    _, _, world = worlds[name]
    nodes = sample_configurations(world, jax.random.key(3), 300)
    q = sample_configurations(world, jax.random.key(4), 20)
    among = jnp.ones((20, 300), bool).at[:, ::7].set(False)
    exact = np.asarray(distance(world, q[:, None], nodes))
    found = np.asarray(jax.jit(lambda w, *a: w.distances(*a))(world, nodes, q, among))
    assert np.all(np.isinf(found[:, ::7]))
    answered = np.isfinite(found)
    np.testing.assert_allclose(found[answered], exact[answered], atol=1e-3)
    nearest = np.where(among, exact, np.inf).min(axis=1)
    np.testing.assert_allclose(found.min(axis=1), nearest, atol=1e-3)


def test_free_steps_against_single_checks(worlds):
    _, _, world = worlds["snake"]
    q = sample_configurations(world, jax.random.key(5), 400)
    q = q[np.asarray(nrp_jax.batch_is_free(world, q))][:16]
    q_from, q_to = q[:8], q[8:16]
    passed, _ = jax.jit(free_prefix, static_argnums=3)(world, q_from, world.edge(q_from, q_to), 16)
    for a, b, count in zip(q_from, q_to, np.asarray(passed), strict=True):
        points = interpolate(world, a[None], b[None], jnp.arange(1, 17) / 16)
        free = np.asarray(nrp_jax.batch_is_free(world, points))
        assert count == (16 if free.all() else np.argmin(free))


def test_merged_cells_are_the_cells(rng):
    occupied = rng.random((9, 8, 7)) < 0.5
    rebuilt = np.zeros(occupied.shape, int)
    boxes = merge_cells(occupied)
    for low, high in boxes:
        rebuilt[tuple(map(slice, low, high))] += 1
    np.testing.assert_array_equal(rebuilt, occupied)
    assert len(boxes) < occupied.sum()


def test_what_lies_below_the_floor_is_in_nobodys_way():
    robot = nrp_jax.load_robot("fetch")
    occupied = np.zeros((60, 60, 21), bool)
    occupied[..., 0] = True  # the floor itself
    grid = nrp_jax.Grid(occupied=occupied, origin=(0.0, 0.0, -0.1))
    world = nrp_jax.build_world(robot, grid)
    q = np.zeros((1, 11), np.float32)
    q[0, :2], q[0, 3:] = 3.0, [0.2, 1.3, 1.4, -0.2, 1.5, 0.0, 1.66, 0.0]
    assert nrp_jax.batch_is_free(world, jnp.asarray(q))[0]
    assert SphereLoop(robot, grid).is_free(q[0])
    assert not ExactScene(robot, grid).touching(q[0])


@pytest.mark.skipif(not MAPS.is_dir(), reason="NRP_MAPS names no folder")
@pytest.mark.parametrize("name", ["home_rls_3d", "house_aws_3d", "home_pal_3d", "house_tb3_3d"])
def test_maps_from_elsewhere_load(name):
    grid = load_map(MAPS / f"{name}.npz")
    world = nrp_jax.build_world(nrp_jax.load_robot("snake"), grid)
    q = sample_configurations(world, jax.random.key(0), 1500)
    assert 0.05 < float(np.mean(nrp_jax.batch_is_free(world, q))) < 0.6


class KeepOut(nrp_jax.GridWorld):
    """A home where the base must keep away from a place."""

    keep_out: jax.Array  # (2,) [m]

    def is_free(self, q):
        return super().is_free(q) & (jnp.linalg.norm(q[:2] - self.keep_out) > 1.0)


class CarKeepOut(CarWorld):
    """The same for a base that drives like a car."""

    keep_out: jax.Array  # (2,) [m]

    def is_free(self, q):
        return super().is_free(q) & (jnp.linalg.norm(q[:2] - self.keep_out) > 1.0)


@pytest.mark.parametrize(("name", "kind"), [("snake", KeepOut), ("fetch", CarKeepOut)])
def test_a_subclass_is_obeyed_by_every_function(worlds, rng, name, kind):
    _, grid, world = worlds[name]
    place = np.array(grid.origin[:2]) + grid.size[:2] / 2
    zone = kind(**vars(world), keep_out=jnp.asarray(place, jnp.float32))
    q = np.asarray(sample_configurations(world, jax.random.key(0), 2048))
    outside = np.linalg.norm(q[:, :2] - place, axis=1) > 1.0
    before = np.asarray(nrp_jax.batch_is_free(world, q))  # compiled for the world it extends
    expected = before & outside
    assert before.sum() > expected.sum() > 0
    np.testing.assert_array_equal(nrp_jax.batch_is_free(zone, q), expected)
    np.testing.assert_array_equal(jax.jit(jax.vmap(zone.is_free))(jnp.asarray(q)), expected)
    assert not bool(jax.jit(nrp_jax.is_free)(zone, jnp.asarray(q[np.argmax(before & ~outside)])))
    # The kernel stops at the zone, and so do its edges.
    start, inside = q[np.argmax(expected)][None], q[np.argmax(before & ~outside)][None]
    edge = zone.edge(jnp.asarray(start), jnp.asarray(inside))
    steps, _ = jax.jit(free_prefix, static_argnums=3)(zone, jnp.asarray(start), edge, 64)
    assert int(steps[0]) < 64
    assert isinstance(nrp_jax.with_grid(zone, grid), kind)
