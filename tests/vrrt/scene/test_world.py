import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import batch_link_poses, link_poses
from vrrt_jax.scene.closed_form import ClosedFormWorld
from vrrt_jax.scene.obstacles import load_obstacles, signed_distances
from vrrt_jax.scene.rows import least
from vrrt_jax.scene.world import (
    World,
    batch_clearance,
    batch_is_free,
    keeping_clearance,
    pose_error,
    with_margin,
)

DISTANCE_TOLERANCE = 2e-5  # [m]; worst seen 4e-6, near a plane drawn as a 100 m box


def random_obstacles(rng, kinds):
    quaternions = rng.normal(size=(len(kinds), 4))
    return [
        vrrt_jax.Obstacle(
            name=f"{kind}_{i}",
            kind=kind,
            position=tuple(rng.uniform(-0.6, 0.6, 3)),
            quaternion=tuple(q / np.linalg.norm(q)),
            size=tuple(rng.uniform(0.05, 0.25, 3)),
        )
        for i, (kind, q) in enumerate(zip(kinds, quaternions, strict=True))
    ]


def mujoco_distances(obstacles, points):
    """Distances of points to obstacles by C MuJoCo, with a tiny sphere as the point."""
    spec = mujoco.MjSpec()
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0], name="probe")
    for o in obstacles:
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{o.kind.upper()}")
        size = o.size if o.kind != "plane" else (0, 0, 1)
        spec.worldbody.add_geom(
            name=o.name, type=kind, pos=o.position, quat=o.quaternion, size=size
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    found = np.zeros((len(points), len(obstacles)))
    for i, point in enumerate(points):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        for k, o in enumerate(obstacles):
            pair = model.geom("probe").id, model.geom(o.name).id
            found[i, k] = 1e-3 + mujoco.mj_geomDistance(model, data, *pair, 10.0, None)
    return found


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "cylinder", "plane"])
def test_distance_outside_equals_mujoco(kind, panda, rng):
    obstacles = random_obstacles(rng, [kind] * 3)
    world = vrrt_jax.build_world(panda, obstacles)
    points = rng.uniform(-1, 1, (200, 3))
    distances = jax.jit(signed_distances)(world.obstacles, jnp.asarray(points.T, jnp.float32))
    ours = np.asarray(distances).T
    theirs = mujoco_distances(obstacles, points)
    outside = theirs > 2e-3
    assert outside.sum() > 50
    np.testing.assert_allclose(ours[:, :3][outside], theirs[outside], atol=DISTANCE_TOLERANCE)
    assert np.all(ours[:, :3][theirs < 0] < 2e-3)
    assert np.all(ours[:, 3:] > 100), "empty slots are far away"


def test_margin_makes_it_stricter(panda, wall_world, free, rng):
    q = rng.uniform(panda.lower, panda.upper, (256, 7)).astype(np.float32)
    obstacles = vrrt_jax.obstacle_list(wall_world)
    wide = vrrt_jax.build_world(panda, obstacles, engine="closed_form", margin=0.05)
    tight_free, wide_free = np.asarray(free(wall_world, q)), np.asarray(free(wide, q))
    assert np.all(tight_free | ~wide_free)
    assert tight_free.sum() > wide_free.sum()


def test_obstacles_move_without_retracing(panda, wall_world, rng):
    traces = []

    @jax.jit
    def clearance(world, q):
        traces.append(1)
        return vrrt_jax.obstacle_clearance(world, q)

    q = jnp.asarray(panda.home, jnp.float32)
    first = clearance(wall_world, q)
    moved = vrrt_jax.move_obstacle(wall_world, "ball", position=(0.3, 0.0, 0.75), size=(0.2,))
    other = vrrt_jax.with_obstacles(wall_world, random_obstacles(rng, ["box", "capsule", "sphere"]))
    empty = vrrt_jax.with_obstacles(wall_world, [])
    values = [float(clearance(w, q)) for w in (moved, other, empty)]
    assert len(traces) == 1
    assert values[0] < float(first) and values[2] > 100


def test_more_margin_only_forbids_more_of_obstacles_and_itself(panda, wall_world, free, rng):
    q = rng.uniform(panda.lower, panda.upper, (2000, 7)).astype(np.float32)
    empty = vrrt_jax.build_world(panda, engine="closed_form")  # itself alone
    for world in (wall_world, empty):
        now, wary = free(world, q), free(with_margin(world, 0.03), q)
        assert not np.any(wary & ~now)
        assert 0 < np.sum(wary) < np.sum(now)
        np.testing.assert_array_equal(free(with_margin(world, 0.0), q), now)


def test_obstacle_list_gives_back_what_went_in(panda, rng):
    obstacles = random_obstacles(rng, ["sphere", "box", "capsule", "cylinder"])
    back = vrrt_jax.obstacle_list(vrrt_jax.build_world(panda, obstacles))
    assert [(o.name, o.kind) for o in back] == [(o.name, o.kind) for o in obstacles]
    for a, b in zip(obstacles, back, strict=True):
        used = {"sphere": 1, "box": 3, "capsule": 2, "cylinder": 2}[a.kind]
        np.testing.assert_allclose(a.position, b.position, atol=1e-6)
        np.testing.assert_allclose(a.size[:used], b.size[:used], atol=1e-6)
        assert abs(np.dot(a.quaternion, b.quaternion)) > 1 - 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "ellipsoid"}, r"robot's spheres and 'thing' \(ellipsoid\) is not supported"),
        ({"size": (0.1, -0.1, 0.1)}, "3 positive numbers"),
        ({"size": 0.1}, "3 positive numbers"),
        ({"size": (0.1, 0.1)}, "3 positive numbers"),
        ({"position": (0.0, float("nan"), 0.0)}, "not finite"),
        ({"position": (0.0, 1.0)}, "expected x, y, z"),
        ({"position": "0 0 1"}, "expected x, y, z"),
        ({"quaternion": (1.0, 0.0, 0.0)}, "w, x, y, z"),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "a quaternion of zeros"),
    ],
)
def test_bad_obstacles_are_refused(panda, change, message):
    fields = {"name": "thing", "kind": "box", "position": (0, 0, 0), "size": (0.1, 0.1, 0.1)}
    with pytest.raises(ValueError, match=message):
        vrrt_jax.build_world(panda, [vrrt_jax.Obstacle(**{**fields, **change})])


def test_too_many_obstacles_and_unknown_names(panda, wall_world, rng):
    with pytest.raises(ValueError, match="17 obstacles do not fit into 16 slots"):
        vrrt_jax.with_obstacles(wall_world, random_obstacles(rng, ["box"] * 17))
    with pytest.raises(ValueError, match="no obstacle named 'bal'.*'ball'"):
        vrrt_jax.move_obstacle(wall_world, "bal", position=(0, 0, 0))
    assert vrrt_jax.build_world(panda, num_slots=9).obstacles.rounding.shape == (16,)


def test_world_files(tmp_path):
    file = tmp_path / "world.xml"
    file.write_text(
        "<mujoco><worldbody><body pos='1 0 0'><geom name='e' type='ellipsoid' size='.1 .2 .3'/>"
        "</body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="'e' \\(ellipsoid\\) is not supported"):
        load_obstacles(file)
    file.write_text(
        "<mujoco><worldbody><body pos='1 0 0' quat='0 1 0 0'>"
        "<geom type='box' size='.1 .2 .3'/></body></worldbody></mujoco>"
    )
    (box,) = load_obstacles(file)
    assert box.position == (1, 0, 0) and box.kind == "box" and box.name == "geom_0"
    file.write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="stand still"):
        load_obstacles(file)
    file.write_text("<mujoco><worldbo")
    with pytest.raises(ValueError, match="not a valid MJCF"):
        load_obstacles(file)
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        load_obstacles(tmp_path / "nowhere.xml")


class KeepOut(ClosedFormWorld):
    """A world where the hand must keep away from a point."""

    keep_out: jax.Array  # (3,) [m]

    def is_free(self, q):
        hand = link_poses(self.chain, q)[-1, :3, 3]
        return super().is_free(q) & (jnp.linalg.norm(hand - self.keep_out) > 0.4)


@pytest.fixture
def keep_out(wall_world):
    return KeepOut(**vars(wall_world), keep_out=jnp.array([0.4, 0.0, 0.5]))


def test_a_subclass_is_obeyed_by_every_function(panda, wall_world, keep_out, free, rng):
    q = rng.uniform(panda.lower, panda.upper, (512, 7)).astype(np.float32)
    hand = np.asarray(batch_link_poses(panda.chain, jnp.asarray(q)))[:, -1, :3, 3]
    outside = np.linalg.norm(hand - np.array([0.4, 0.0, 0.5]), axis=1) > 0.4
    before = np.asarray(batch_is_free(wall_world, q))  # compiled for the world it extends
    expected = before & outside
    assert before.sum() > expected.sum() > 0
    np.testing.assert_array_equal(batch_is_free(keep_out, q), expected)
    np.testing.assert_array_equal(free(keep_out, q), expected)
    np.testing.assert_array_equal(jax.vmap(keep_out.is_free)(jnp.asarray(q)), expected)
    assert bool(vrrt_jax.is_free(keep_out, jnp.asarray(q[np.argmax(expected)])))
    blocked = q[np.argmax(before & ~outside)]
    assert not bool(vrrt_jax.is_free(keep_out, jnp.asarray(blocked)))
    with pytest.raises(ValueError, match="the start is refused by KeepOut.is_free"):
        vrrt_jax.plan_to_configuration(
            panda, keep_out, blocked, q[np.argmax(expected)], key=jax.random.key(0)
        )


def test_a_subclass_stays_itself(keep_out):
    changed = (with_margin(keep_out, 0.1), vrrt_jax.with_obstacles(keep_out, []))
    for world in (*changed, vrrt_jax.move_obstacle(keep_out, "ball", position=(0, 0, 2))):
        assert isinstance(world, KeepOut)
        np.testing.assert_array_equal(world.keep_out, keep_out.keep_out)


def test_only_a_users_answer_counts_as_an_override(wall_world, keep_out):
    assert overrides_is_free(keep_out) and not overrides_is_free(wall_world)


def test_a_new_zone_does_not_retrace(keep_out):
    traces = []

    @jax.jit
    def ask(world, q):
        traces.append(1)
        return vrrt_jax.is_free(world, q)

    ask(keep_out, jnp.zeros(7))
    ask(dataclasses.replace(keep_out, keep_out=jnp.array([9.0, 9.0, 9.0])), jnp.zeros(7))
    assert len(traces) == 1


def test_the_decorator_is_optional_for_subclasses(wall_world):
    @pytree
    class Decorated(ClosedFormWorld):
        height: jax.Array

    for kind, extra in ((Decorated, {"height": jnp.float32(1.0)}), (KeepOut, None)):
        extra = extra or {"keep_out": jnp.zeros(3)}
        world = kind(**vars(wall_world), **extra)
        assert isinstance(jax.jit(lambda world: world)(world), kind)


def test_an_engine_must_answer(wall_world):
    names = [field.name for field in dataclasses.fields(World)]
    world = World(**{name: getattr(wall_world, name) for name in names})
    with pytest.raises(NotImplementedError, match="subclass the world of an engine"):
        vrrt_jax.is_free(world, jnp.zeros(7))


@pytest.mark.parametrize("shape", [(1,), (8,), (3, 7), ()])
def test_configurations_of_another_shape_are_refused(wall_world, shape):
    """One value for all joints would be an answer about another configuration."""
    for ask in (vrrt_jax.is_free, vrrt_jax.obstacle_clearance):
        with pytest.raises(
            ValueError, match=r"has shape .*; expected \(7,\) for the joints joint1"
        ):
            ask(wall_world, np.zeros(shape, np.float32))


def test_a_whole_turn_is_the_same_pose():
    """Of hinges; a rail that is 2 pi meters off is elsewhere."""
    ur5e, fetch = (vrrt_jax.load_robot(name) for name in ("ur5e", "fetch"))
    world = vrrt_jax.build_world(ur5e, [], engine="closed_form")
    off = np.array([0.1, 0.0, -0.2, 6.0, -4.0, 3.0])
    error = pose_error(world, ur5e.home + off, ur5e.home)
    expected = [0.1, 0.0, 0.2, 2 * np.pi - 6.0, 2 * np.pi - 4.0, 3.0]
    np.testing.assert_allclose(error, expected, atol=1e-6)
    world = vrrt_jax.build_world(fetch, [], engine="closed_form")
    rail = np.flatnonzero(~np.asarray(world.chain.is_hinge))
    assert len(rail) == 1
    lifted = fetch.home + 6.0 * np.eye(fetch.num_joints)[rail[0]]
    assert pose_error(world, lifted, fetch.home)[rail[0]] == pytest.approx(6.0)


def test_the_smallest_clearance_is_that_of_the_first_ones(wall_world, rng):
    q = rng.uniform(wall_world.lower, wall_world.upper, (150, 7)).astype(np.float32)
    each = np.array(jax.vmap(wall_world.obstacle_clearance)(jnp.asarray(q)))
    q, each = q[np.argsort(-each)], np.sort(each)[::-1]  # the nearest to obstacles last
    # Whole blocks of 64 are looked at.
    for num, last in ((1, 63), (64, 63), (100, 127), (150, 149)):
        assert float(batch_clearance(wall_world, q, num)) == pytest.approx(each[last], abs=1e-6)
    assert each[127] > each[149] + 1e-3


@pytest.mark.parametrize("num", [0, 1, 2, 3, 7, 16, 44])
def test_least_is_the_minimum_of_rows(num, rng):
    rows = rng.normal(size=(num, 5)).astype(np.float32)
    rows[num // 2 : num // 2 + 1, 3] = np.nan
    np.testing.assert_array_equal(least(jnp.asarray(rows)), jnp.min(rows, axis=0, initial=jnp.inf))


def test_a_world_that_keeps_a_clearance_has_its_own_names(panda):
    """The program that finds it may have been compiled for a world of other names."""
    ball = vrrt_jax.Obstacle(name="ball", kind="sphere", position=(2, 0, 0), size=(0.1, 0, 0))
    for name in ("first", "second"):
        world = vrrt_jax.build_world(
            panda, [dataclasses.replace(ball, name=name)], engine="closed_form"
        )
        wary = keeping_clearance(world, panda.home[None], 0.01)
        assert [o.name for o in vrrt_jax.obstacle_list(wary)] == [name]
        assert float(wary.margin) == pytest.approx(0.01)
