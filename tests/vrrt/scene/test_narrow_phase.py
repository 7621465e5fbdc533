"""The narrow phase: where spheres touch, planes between polytopes tell whether the bodies do."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.scene.body_polytopes import body_polytopes
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.obstacles import Obstacle, to_slots
from vrrt_jax.scene.world import batch_is_free, rooms, with_margin

KINDS = ("box", "sphere", "capsule", "cylinder")
LINKS = jnp.tile(jnp.eye(4), (2, 1, 1))
CUBE = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) / 10


def cubes(*centers):
    """Bodies of one cube each, 0.2 m wide, on link 1."""
    parts = [
        vrrt_jax.robots.polytopes.Polytope(body=f"cube {k}", link=1, vertices=CUBE + center)
        for k, center in enumerate(centers)
    ]
    return body_polytopes(parts)[0]


def scene_of(panda, rng, num=6):
    obstacles = []
    for k in range(num):
        place = rng.uniform([-0.7, -0.7, 0.0], [0.7, 0.7, 1.0])
        if np.hypot(*place[:2]) > 0.3:
            turn = rng.normal(size=4)
            obstacles.append(
                Obstacle(
                    name=f"{k}",
                    kind=KINDS[k % 4],
                    position=tuple(place),
                    quaternion=tuple(turn / np.linalg.norm(turn)),
                    size=tuple(rng.uniform(0.04, 0.12, 3)),
                )
            )
    return obstacles


@pytest.mark.parametrize("kind", KINDS)
def test_gaps_to_obstacles(kind):
    """From a face of a cube, along its normal and beside it."""
    body = cubes((0, 0, 0))
    for place, gap in (((0.3, 0, 0), 0.15), ((0, 0, 0.4), 0.25), ((0.1, 0.05, 0), None)):
        obstacle = Obstacle(name="it", kind=kind, position=place, size=(0.05, 0.05, 0.05))
        if kind == "capsule" and gap == 0.25:
            gap = 0.2  # it is longer along z
        slots = to_slots([obstacle], 1)
        args = jnp.int32(0), jnp.array([0.0, 0, 0]), LINKS, slots, jnp.int32(0)
        found = float(body.obstacle_gap(*args))
        if gap is None:
            assert found < 0
        else:
            np.testing.assert_allclose(found, gap, atol=1e-5)
        assert float(body.obstacle_gap(jnp.int32(1), *args[1:])) == -np.inf  # no such body


def test_gaps_between_bodies():
    body = cubes((0, 0, 0), (0.35, 0.05, 0), (0.1, 0.1, 0.1))
    points = jnp.zeros(3), jnp.ones(3)
    for second, gap in ((1, 0.15), (2, -0.1)):
        for pair in ((0, second), (second, 0)):
            found = float(body.body_gap(*map(jnp.int32, pair), points, LINKS))
            np.testing.assert_allclose(found, gap, atol=1e-5)
    # Where the points are one there is no way between them, which would separate anything.
    same = jnp.zeros(3), jnp.zeros(3)
    assert float(body.body_gap(jnp.int32(0), jnp.int32(2), same, LINKS)) < -0.05
    # Corner to corner no face separates as well as the way between two points.
    apart = cubes((0, 0, 0), (0.4, 0.4, 0.4))
    corners = jnp.full(3, 0.1), jnp.full(3, 0.3)
    found = float(apart.body_gap(jnp.int32(0), jnp.int32(1), corners, LINKS))
    np.testing.assert_allclose(found, 0.2 * np.sqrt(3), atol=1e-5)


@pytest.mark.parametrize("engine", vrrt_jax.scene.world.ENGINES)
def test_it_frees_what_only_spheres_touch_and_nothing_else(panda, engine, rng):
    freed = 0
    for _ in range(3):
        world = vrrt_jax.build_world(panda, scene_of(panda, rng), engine=engine, num_slots=8)
        alone = world.by_spheres_alone()
        q = rng.uniform(panda.lower, panda.upper, (500, 7)).astype(np.float32)
        ours, wary = (np.asarray(batch_is_free(w, q)) for w in (world, alone))
        exact = exact_scene(panda, world, geometry="polytopes")
        free = np.array([not exact.touching(row) for row in q])
        assert not (ours & ~free).any()  # C MuJoCo finds the polytopes apart
        freed += int((ours & ~wary).sum())
        # Few are refused that it could have freed: a plane along two edges is not tried.
        assert (free & ~ours).mean() < 0.01
    assert freed > 10


def test_spans_and_clearances_are_those_of_polytopes(panda, rng):
    world = vrrt_jax.build_world(panda, scene_of(panda, rng), engine="closed_form", num_slots=8)
    alone = world.by_spheres_alone()
    q = rng.uniform(panda.lower, panda.upper, (3000, 7)).astype(np.float32)
    in_doubt = np.asarray(batch_is_free(world, q)) & ~np.asarray(batch_is_free(alone, q))
    q = q[in_doubt]
    assert len(q) > 10
    clearance = np.asarray(jax.vmap(lambda q: vrrt_jax.obstacle_clearance(world, q))(q))
    by_spheres = np.asarray(jax.vmap(lambda q: vrrt_jax.obstacle_clearance(alone, q))(q))
    assert np.all(clearance > 0) and by_spheres.min() < 0
    # Within the span nothing is touched, at its ends neither.
    edge = rng.normal(size=q.shape).astype(np.float32) / 3
    span = np.asarray(jax.vmap(world.free_span)(q, edge))
    assert np.all(span >= 0) and np.median(span) > 0
    exact = exact_scene(panda, world, geometry="polytopes")
    for row, way, share in zip(q, edge, np.minimum(span, 1.0), strict=True):
        for sign in (-1, 1):
            touching = exact.touching(row + sign * share * way)
            # Self-collision spheres are no cover: what they miss is nothing of the narrow phase.
            assert not [pair for pair in touching if pair[1] >= exact.num_bodies]


def test_margins_are_kept_by_polytopes(panda, rng):
    world = vrrt_jax.build_world(panda, scene_of(panda, rng), engine="closed_form", num_slots=8)
    q = rng.uniform(panda.lower, panda.upper, (1000, 7)).astype(np.float32)
    wide = np.asarray(batch_is_free(with_margin(world, 0.02), q))
    assert not (wide & ~np.asarray(batch_is_free(world, q))).any()
    exact = exact_scene(panda, world, geometry="polytopes")
    for row in q[wide]:
        exact.touching(row)
        assert exact.clearance(0.05) > 0.02 - 1e-4


def test_rooms_go_from_the_wariest_to_the_world_itself(panda):
    post = Obstacle(name="post", kind="box", position=(0.6, 0.6, 0.2), size=(0.05, 0.05, 0.2))
    world = vrrt_jax.build_world(panda, [post])
    wary, alone, last = rooms(world, panda.home[None], 0.01)
    assert last is world and float(wary.margin) == pytest.approx(0.01)
    assert wary.spheres.narrow_phase is None and alone.spheres.narrow_phase is None
    assert rooms(alone, panda.home[None], 0.0) == [alone]


def test_a_start_that_only_spheres_touch_is_planned_from(panda, rng):
    """Start and goal are free for C MuJoCo, and were refused as the spheres stick out."""
    solved = 0
    while solved < 2:
        obstacles = scene_of(panda, rng, 8)
        world = vrrt_jax.build_world(panda, obstacles, engine="closed_form", num_slots=8)
        alone = world.by_spheres_alone()
        q = rng.uniform(panda.lower, panda.upper, (400, 7)).astype(np.float32)
        free, wary = (np.asarray(batch_is_free(w, q)) for w in (world, alone))
        if not (free & ~wary).any() or not wary.any():
            continue
        start, goal = q[free & ~wary][0], q[wary][0]
        with pytest.raises(ValueError, match="start is in collision"):
            vrrt_jax.plan(
                panda, alone, vrrt_jax.ConfigurationGoal(q=goal), start, key=jax.random.key(0)
            )
        result = vrrt_jax.plan(
            panda, world, vrrt_jax.ConfigurationGoal(q=goal), start, key=jax.random.key(0)
        )
        assert result.ok, result.status
        np.testing.assert_allclose(result.trajectory[0], start, atol=1e-6)
        solved += 1


def test_objects_that_are_held_have_no_polytopes(panda, rng):
    can = Obstacle(name="can", kind="cylinder", position=(0.4, 0.0, 0.3), size=(0.03, 0.05, 0.0))
    world = vrrt_jax.build_world(panda, [], engine="closed_form")
    held = vrrt_jax.attach(world, can, "hand")
    phase = held.spheres.narrow_phase
    num = len(phase.polytopes.link)
    assert np.all(np.asarray(phase.body)[-held.spheres.num_held[0] :] == num)
    assert np.all(np.asarray(phase.bulge)[-held.spheres.num_held[0] :] == 0)
    assert np.all(np.asarray(phase.slack)[:, -held.spheres.num_held[1] :] == 0)
    again = held.spheres.with_narrow_phase(None).with_narrow_phase(phase)
    np.testing.assert_allclose(again.contact_distance, held.spheres.contact_distance, atol=1e-7)
    assert dataclasses.replace(again, narrow_phase=None).self_margin == 0
