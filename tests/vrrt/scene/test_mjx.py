"""The engine MJX: agrees with the closed form, re-compiles nothing, is fast in anybody's jit."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.core.timing import interleaved_ms
from vrrt_jax.problems import scenes_dir
from vrrt_jax.robots.kinematics import link_poses, place
from vrrt_jax.scene.obstacles import load_obstacles
from vrrt_jax.scene.world import batch_is_free, with_margin

SHELL = 1e-5  # [m] where the engines disagree, something is this near to touching
NUM = 2048  # configurations; one number, so that few programs are compiled
KINDS = ("sphere", "box", "capsule", "cylinder", "plane")


def obstacle(kind, name, rng):
    # Planes lie low and almost level, or nothing would be free.
    is_plane = kind == "plane"
    quaternion = rng.normal(size=4) * (0.1 if is_plane else 1.0) + (is_plane, 0, 0, 0)
    return vrrt_jax.Obstacle(
        name=name,
        kind=kind,
        position=tuple(rng.uniform((-0.7, -0.7, -0.2), (0.7, 0.7, 0.9)) - (0, 0, is_plane)),
        quaternion=tuple(quaternion / np.linalg.norm(quaternion)),
        size=tuple(rng.uniform(0.03, 0.12, 3)),
    )


def obstacles_of(kinds, rng):
    return [obstacle(kind, f"{kind}_{i}", rng) for i, kind in enumerate(kinds)]


def draw(robot, num, rng):
    q = rng.uniform(robot.lower, robot.upper, (num, robot.num_joints))
    return jnp.asarray(q, jnp.float32)


@jax.jit
def nearness(world, q):
    """How far (n,) each of q (n, D) is from just touching an obstacle or the robot itself [m]."""

    def one(q):
        centers = place(world.spheres.self_collision, link_poses(world.chain, q))
        rows, columns = world.spheres.contact_distance.shape
        between = centers[:, :rows, None] - centers[:, None, centers.shape[1] - columns :]
        beyond = jnp.abs(jnp.linalg.norm(between, axis=0) - world.spheres.contact_distance)
        to_itself = jnp.min(jnp.where(world.spheres.contact_distance > 0, beyond, jnp.inf))
        return jnp.minimum(jnp.abs(world.obstacle_clearance(q) - world.margin), to_itself)

    return jax.lax.map(one, q, batch_size=256)


def check_agreement(mjx, closed, q):
    """Both engines say the same, but where something is about to touch; returns what is free."""
    ours, theirs = np.asarray(batch_is_free(mjx, q)), np.asarray(batch_is_free(closed, q))
    assert np.all(np.asarray(nearness(closed, q))[ours != theirs] < SHELL)
    return ours


@pytest.fixture(scope="module")
def roomy(panda):
    """Room for four of every kind, and nothing there: one program for many tests."""
    rng = np.random.default_rng(3)
    return vrrt_jax.with_obstacles(vrrt_jax.build_world(panda, obstacles_of(KINDS, rng)), [])


def as_closed_form(robot, world):
    return vrrt_jax.build_world(robot, vrrt_jax.obstacle_list(world), engine="closed_form")


@pytest.mark.parametrize("name", ["panda", "ur5e", "fetch"])
def test_engines_agree_in_every_packaged_world(name, rng):
    robot = vrrt_jax.load_robot(name)
    files = sorted((scenes_dir() / "worlds").glob("*.xml"))
    files = [f for f in files if f.stem.startswith(name) or "_" not in f.stem]
    assert len(files) == 9
    world = vrrt_jax.build_world(robot)
    for file in files:  # first make room for all of them, so that one program serves all
        world = vrrt_jax.with_obstacles(world, load_obstacles(file))
    q = draw(robot, 10_000, rng)
    for file in files:
        world = vrrt_jax.with_obstacles(world, load_obstacles(file))
        free = check_agreement(world, as_closed_form(robot, world), q)
        assert 0.02 < free.mean() < 0.98, file


@pytest.mark.parametrize("kind", KINDS)
def test_engines_agree_on_each_kind(kind, panda, roomy, rng):
    world = vrrt_jax.with_obstacles(roomy, obstacles_of([kind] * 2, rng))
    assert world.scene is roomy.scene
    q = draw(panda, NUM, rng)
    free = check_agreement(world, as_closed_form(panda, world), q)
    alone = np.asarray(batch_is_free(roomy, q))
    assert 0 < free.sum() < alone.sum(), "some are blocked by the obstacles, not all"


def test_engines_agree_near_the_rim_of_a_thin_cylinder(panda, roomy, rng):
    """Where MJX's own routine for convex meshes misses contacts."""
    posts = [
        dataclasses.replace(obstacle("cylinder", f"post_{i}", rng), size=(0.02, 0.01, 0.0))
        for i in range(4)
    ]
    world = vrrt_jax.with_obstacles(roomy, posts)
    check_agreement(world, as_closed_form(panda, world), draw(panda, NUM, rng))


def test_margins_mean_the_same(panda, roomy, rng):
    mjx = vrrt_jax.with_obstacles(roomy, obstacles_of(KINDS, rng))
    closed = as_closed_form(panda, mjx)
    q = draw(panda, NUM, rng)
    free = check_agreement(mjx, closed, q)
    wary = check_agreement(with_margin(mjx, 0.04), with_margin(closed, 0.04), q)
    assert 0 < wary.sum() < free.sum()
    alone = as_closed_form(panda, roomy)
    wary_of_itself = check_agreement(with_margin(roomy, 0.04), with_margin(alone, 0.04), q)
    assert wary_of_itself.sum() < np.sum(np.asarray(batch_is_free(roomy, q)))
    built = vrrt_jax.build_world(panda, vrrt_jax.obstacle_list(mjx), margin=0.04)
    assert np.sum(np.asarray(batch_is_free(built, q))) >= wary.sum()


def test_clearance_is_that_of_the_closed_form(panda, roomy, rng):
    world = vrrt_jax.with_obstacles(roomy, obstacles_of(KINDS, rng))
    closed = as_closed_form(panda, world)
    q = draw(panda, 3, rng)
    ask = jax.jit(jax.vmap(vrrt_jax.obstacle_clearance, (None, 0)))
    np.testing.assert_array_equal(ask(world, q), ask(closed, q))


def test_obstacles_change_without_retracing(panda, roomy, rng):
    traces = []

    @jax.jit
    def ask(world, q):
        traces.append(1)
        return jax.vmap(world.is_free)(q)

    q = draw(panda, NUM, rng)
    at_hand = link_poses(panda.chain, jnp.asarray(panda.home, jnp.float32))[-1, :3, 3]
    ball = vrrt_jax.Obstacle(
        name="ball", kind="sphere", position=tuple(map(float, at_hand)), size=(0.1, 0, 0)
    )
    q = q.at[0].set(jnp.asarray(panda.home, jnp.float32))
    worlds = [roomy, vrrt_jax.with_obstacles(roomy, [ball])]
    worlds.append(vrrt_jax.move_obstacle(worlds[1], "ball", position=(0, 0, 3)))
    worlds.append(vrrt_jax.with_obstacles(worlds[2], obstacles_of(KINDS, rng)))
    worlds.append(vrrt_jax.with_obstacles(worlds[3], []))
    answers = [np.asarray(ask(world, q)) for world in worlds]
    assert len(traces) == 1
    assert [bool(a[0]) for a in answers[:3]] == [True, False, True]
    np.testing.assert_array_equal(answers[4], answers[0])
    assert answers[3].sum() < answers[0].sum()


def test_room_grows_where_it_is_missing(panda, roomy, rng):
    world = vrrt_jax.with_obstacles(roomy, obstacles_of(["box"] * 5, rng))
    assert world.scene is not roomy.scene and world.scene.room == (4, 4, 4, 6, 4)
    q = draw(panda, NUM, rng)
    check_agreement(world, as_closed_form(panda, world), q)


def test_a_kind_that_a_scene_lacks_costs_nothing(panda, roomy, rng):
    def checks(world):
        model = world.scene.model
        kinds = model.geom_type[model.pair_geom2] if model.npair else np.zeros(0, int)
        return [mujoco.mjtGeom(int(kind)).name for kind in kinds]

    empty = vrrt_jax.build_world(panda)
    assert len(empty.geoms.slots.rounding) == 0 and checks(empty) == []
    one = vrrt_jax.build_world(panda, obstacles_of(["capsule"], rng))
    assert len(one.geoms.slots.rounding) == 4 and checks(one) == ["mjGEOM_CAPSULE"] * 4
    assert len(roomy.geoms.slots.rounding) == 18
    assert len(checks(roomy)) == 14, "one pair for each obstacle that MJX has a routine for"
    assert len(empty.scene.program.equations) < len(roomy.scene.program.equations)


def test_worlds_of_as_much_room_share_their_scene(panda, rng):
    first, second = (vrrt_jax.build_world(panda, obstacles_of(["box"], rng)) for _ in range(2))
    assert first.scene is second.scene
    assert jax.tree.structure(first) == jax.tree.structure(second)


def test_every_way_of_asking_gets_the_same_answer(panda, roomy, rng):
    world = vrrt_jax.with_obstacles(roomy, obstacles_of(KINDS, rng))
    q = draw(panda, NUM, rng)
    expected = np.asarray(batch_is_free(world, q))
    assert 0.02 < expected.mean() < 0.98
    closure = jax.jit(jax.vmap(lambda q: vrrt_jax.is_free(world, q)))
    np.testing.assert_array_equal(closure(q), expected)
    nested = jax.jit(jax.vmap(jax.vmap(world.is_free)))(q.reshape(8, -1, 7))
    np.testing.assert_array_equal(np.asarray(nested).ravel(), expected)

    @jax.jit
    def looped(q):
        return jax.lax.fori_loop(0, 3, lambda _, free: jax.vmap(world.is_free)(q), expected)

    np.testing.assert_array_equal(looped(q), expected)
    np.testing.assert_array_equal([bool(world.is_free(row)) for row in q[:3]], expected[:3])
    # Several worlds at once, and gradients of what also asks.
    worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves), world, roomy)
    both = jax.jit(jax.vmap(jax.vmap(vrrt_jax.is_free, (None, 0)), (0, None)))(worlds, q)
    np.testing.assert_array_equal(both, [expected, batch_is_free(roomy, q)])
    slope = jax.grad(lambda q: jnp.where(world.is_free(q), q.sum(), 2 * q.sum()))(q[0])
    np.testing.assert_array_equal(slope, np.full(7, 1.0 if expected[0] else 2.0))
    assert batch_is_free(world, q[:0]).shape == (0,)
    # One configuration that is not finite spoils no other.
    spoiled = np.asarray(batch_is_free(world, q.at[0].set(jnp.nan)))
    assert not spoiled[0]
    np.testing.assert_array_equal(spoiled[1:], expected[1:])


def test_fast_in_a_users_plain_jit(panda, roomy, rng):
    """Off the cliff of XLA's fusions, where it would take thousands of times as long."""
    world, q = vrrt_jax.with_obstacles(roomy, obstacles_of(KINDS, rng)), draw(panda, NUM, rng)
    plain = jax.jit(jax.vmap(vrrt_jax.is_free, (None, 0)))
    best = jax.jit(
        jax.vmap(vrrt_jax.is_free, (None, 0)),
        compiler_options={"xla_cpu_use_fusion_emitters": False},
    )
    times = interleaved_ms({"plain": lambda: plain(world, q), "best": lambda: best(world, q)}, 40)
    assert times["plain"] < 3.0 * times["best"], times


def test_obstacles_meet_links_that_the_base_may_touch(tmp_path):
    """What a robot's file excludes for its base in the world's body says nothing of obstacles."""
    file = tmp_path / "pendulum.xml"
    file.write_text(
        "<mujoco><worldbody><geom name='base' size='.1'/><body name='arm' pos='0 0 .3'>"
        "<joint name='swing' axis='0 1 0' range='-2 2' limited='true'/>"
        "<geom size='.05' pos='.3 0 0'/></body></worldbody>"
        "<contact><exclude body1='world' body2='arm'/></contact></mujoco>"
    )
    robot = vrrt_jax.load_robot(file)
    ball = vrrt_jax.Obstacle(name="ball", kind="sphere", position=(0.3, 0, 0.3), size=(0.05, 0, 0))
    q = jnp.zeros((128, 1)).at[1:].set(1.5)
    free = np.asarray(batch_is_free(vrrt_jax.build_world(robot, [ball]), q))
    assert not free[0] and free[1:].all()


def test_an_engine_that_does_not_exist_is_refused(panda):
    with pytest.raises(ValueError, match="unknown engine 'bullet'; have: mjx, closed_form"):
        vrrt_jax.build_world(panda, engine="bullet")
    with pytest.raises(ValueError, match="unknown engine 'bullet'"):
        vrrt_jax.load_problem("panda_open", engine="bullet")


def test_a_world_says_which_engine_answers(panda, roomy):
    assert roomy.engine == "mjx"
    assert vrrt_jax.build_world(panda, engine="closed_form").engine == "closed_form"
    assert vrrt_jax.load_problem("panda_open").world.engine == "mjx"
    world = vrrt_jax.load_problem("panda_open", engine="closed_form").world
    assert isinstance(world, vrrt_jax.ClosedFormWorld)


class LowHand(vrrt_jax.MjxWorld):
    """A world where the hand stays below a height."""

    height: jax.Array  # () [m]

    def is_free(self, q):
        return super().is_free(q) & (link_poses(self.chain, q)[-1, 2, 3] < self.height)


def test_a_subclass_is_obeyed(panda, roomy, rng):
    q = draw(panda, NUM, rng)
    world = LowHand(**vars(roomy), height=jnp.float32(0.5))
    hand = np.asarray(jax.vmap(lambda q: link_poses(panda.chain, q)[-1, 2, 3])(q))
    expected = np.asarray(batch_is_free(roomy, q)) & (hand < 0.5)
    assert 0 < expected.sum()
    assert world.engine == "mjx"
    grown = vrrt_jax.with_obstacles(world, obstacles_of(["box"] * 5, rng))
    for same in (world, with_margin(world, 0.0), vrrt_jax.with_obstacles(grown, [])):
        assert isinstance(same, LowHand)
        np.testing.assert_array_equal(batch_is_free(same, q), expected)
