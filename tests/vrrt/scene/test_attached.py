"""A held object: the planner and the exact check agree on what it may touch."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_cases import START, fingertips, place

import vrrt_jax
from vrrt_jax.core.types import pytree
from vrrt_jax.robots.sphere_cover import MAX_BULGE
from vrrt_jax.scene.attached import pose_of
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.held_cover import BULGE, MOST_SPHERES, corners, cover
from vrrt_jax.scene.verify import contacts, verify_path
from vrrt_jax.scene.world import batch_is_free, with_margin

SHAPES = {
    "sphere": (0.05, 0.0, 0.0),
    "capsule": (0.02, 0.1, 0.0),
    "cylinder": (0.033, 0.06, 0.0),
    "box": (0.12, 0.02, 0.02),
}
AHEAD = (0.0, 0.0, 0.13)  # of the hand, between the fingers and beyond


def thing(kind="box", position=AHEAD, **fields):
    fields = {"name": "can", "size": SHAPES[kind]} | fields
    return vrrt_jax.Obstacle(kind=kind, position=tuple(map(float, position)), **fields)


def bare_world(panda, obstacles=(), engine="closed_form"):
    """Mostly of the engine that compiles sooner; held objects are measured alike in both."""
    return vrrt_jax.build_world(panda, obstacles, engine=engine)


def free(world, q):
    return bool(batch_is_free(world, jnp.asarray(q, jnp.float32)[None])[0])


@pytest.fixture(scope="module")
def around(panda):
    """Obstacles of several kinds, near enough to be touched often."""
    return bare_world(
        panda,
        [
            thing("box", (0.5, 0.0, 0.2), name="table", size=(0.3, 0.4, 0.02)),
            thing("cylinder", (0.3, 0.5, 0.5), name="post", size=(0.03, 0.5, 0.0)),
            thing("sphere", (-0.3, -0.3, 0.8), name="ball", size=(0.1, 0.0, 0.0)),
        ],
    )


@pytest.fixture(scope="module")
def on_table(panda):
    """A can between the fingers at START that stands 3 mm deep in a table."""
    x, y, z = fingertips(panda, START)
    half = SHAPES["cylinder"][1]
    table = thing("box", (x, y, z - half - 0.02 + 0.003), name="table", size=(0.3, 0.3, 0.02))
    return bare_world(panda, [thing("cylinder", (x, y, z)), table])


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("scale", [1.0, 3.0, 8.0])
def test_the_spheres_contain_the_object(kind, scale, rng):
    x, y, z = SHAPES[kind]
    size = (scale * x, scale * y, scale * z)
    found = cover(kind, size)
    assert found.bulge <= MAX_BULGE
    assert len(found.radius) <= MOST_SPHERES or scale > 1
    if scale == 1.0 and kind != "box":
        assert found.bulge <= BULGE + 1e-9
    # The object is the hull of its corners, which are spheres of one radius.
    center, radius = corners(kind, size)
    inside = rng.dirichlet(np.full(len(center), 0.2), 5000) @ center
    direction = rng.normal(size=inside.shape)
    inside += radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    if kind == "cylinder":  # the hull is that of a prism around it
        inside = inside[np.hypot(inside[:, 0], inside[:, 1]) <= size[0]]
    reach = np.linalg.norm(inside[:, None] - found.center, axis=-1) - found.radius
    assert reach.min(axis=1).max() <= 1e-6


@pytest.mark.parametrize("kind", SHAPES)
def test_the_planner_agrees_with_c_mujoco(panda, around, kind, rng):
    world = vrrt_jax.attach(around, thing(kind), "hand").by_spheres_alone()
    q = rng.uniform(panda.lower, panda.upper, (400, 7)).astype(np.float32)
    is_free = np.asarray(batch_is_free(world, jnp.asarray(q)))
    touching = [contacts(panda, world, row, geometry="spheres") for row in q]
    touches = np.array([bool(found) for found in touching])
    assert not (is_free & touches).any()
    assert sum(any("can" in words for words in found) for found in touching) > 10
    # False alarms: only what sticks out of the object.
    assert (~is_free & ~touches).mean() <= (0.03 if cover(kind, SHAPES[kind]).bulge else 0.0)


def test_the_object_moves_with_the_hand(panda, around):
    world = vrrt_jax.attach(around, thing("sphere", name="egg"), "hand")
    with_egg = exact_scene(panda, world, geometry="spheres")
    for q in (START, START + 0.4):
        with_egg.near(q)
        hand = with_egg.data.body("hand")
        expected = hand.xpos + hand.xmat.reshape(3, 3) @ AHEAD
        np.testing.assert_allclose(with_egg.data.geom("held: 0").xpos, expected, atol=1e-9)
        gone = vrrt_jax.detach(world, "egg", q=q)
        (egg,) = (o for o in vrrt_jax.obstacle_list(gone) if o.name == "egg")
        np.testing.assert_allclose(egg.position, expected, atol=1e-6)


def test_the_hand_may_touch_it_and_other_links_may_not(panda):
    empty = bare_world(panda)
    inside = vrrt_jax.attach(empty, thing("box", (0, 0, 0.05)), "hand")  # in the palm and fingers
    assert free(inside, START)
    for geometry in ("spheres", "meshes"):
        assert contacts(panda, inside, START, geometry=geometry) == []
    # Turned back along the wrist: the link before the hand's own is found too.
    for name in ("link6", "link4", "link0"):
        far = np.linalg.inv(_hand_pose(panda, START)) @ [*place(panda, START, name), 1.0]
        back = vrrt_jax.attach(empty, thing("sphere", far[:3]), "hand")
        assert not free(back, START)
        for geometry in ("spheres", "meshes"):
            found = contacts(panda, back, START, geometry=geometry)
            assert f"{name} touches can" in found, (geometry, found)


def _hand_pose(panda, q):
    scene = exact_scene(panda, [], geometry="spheres")
    scene.near(q)
    hand, pose = scene.data.body("hand"), np.eye(4)
    pose[:3, :3], pose[:3, 3] = hand.xmat.reshape(3, 3), hand.xpos
    return pose


def test_two_held_objects_are_checked_against_each_other(panda):
    empty = bare_world(panda)
    x, y, z = fingertips(panda, START)
    world = vrrt_jax.attach(empty, thing("sphere", (x, y, z)), "hand", q=START)
    apart = vrrt_jax.attach(world, thing("sphere", (x, y, z - 0.3), name="egg"), "link4", q=START)
    assert free(apart, START)
    for other in ("link4", "link6"):
        near = vrrt_jax.attach(world, thing("sphere", (x, y, z), name="egg"), other, q=START)
        assert not free(near, START)
        found = contacts(panda, near, START)
        assert {"egg touches can", "can touches egg"} & {*found}, found
    assert [held.obstacle.name for held in vrrt_jax.detach(near, "can").attached] == ["egg"]


def test_what_it_stands_on_may_be_as_near_as_where_it_is_gripped(panda, on_table):
    world = vrrt_jax.attach(on_table, "can", "hand", q=START)
    assert [o.name for o in vrrt_jax.obstacle_list(world)] == ["table"]
    for geometry in ("spheres", "meshes"):
        assert contacts(panda, world, START, geometry=geometry) == []
    wide = vrrt_jax.attach(with_margin(on_table, 0.02), "can", "hand", q=START)
    assert free(world, START) and free(with_margin(world, 0.02), START) and free(wide, START)
    # Lifted, it is free; lowered into the table, it is not.
    lift = np.array([0, -0.1, 0, 0, 0, 0, 0])
    for turn, is_allowed in ((lift, True), (-0.5 * lift, False)):
        assert free(world, START + turn) == is_allowed, turn
        assert (not contacts(panda, world, START + turn)) == is_allowed, turn
    # Nothing else is as near as the table: a plate at the same place is not its support.
    (table,) = vrrt_jax.obstacle_list(world)
    plate = dataclasses.replace(table, name="plate")
    for other in ([plate], [plate, table]):
        assert "can touches plate" in contacts(
            panda, vrrt_jax.with_obstacles(world, other), START, geometry="meshes"
        )
        assert not free(vrrt_jax.with_obstacles(world, other), START)
    assert free(vrrt_jax.with_obstacles(world, [table]), START)


def test_around_its_support_the_planner_is_right(panda, on_table, rng):
    """Lifted and tilted in all ways, it is never free for the planner alone."""
    world = vrrt_jax.attach(on_table, "can", "hand", q=START)
    q = (START + rng.normal(size=(500, 7)) * 0.15).astype(np.float32)
    is_free = np.asarray(batch_is_free(world, jnp.asarray(q)))
    touches = np.array([bool(contacts(panda, world, row)) for row in q])
    assert 50 < touches.sum() < 450
    assert not (is_free & touches).any() and (~is_free & ~touches).mean() < 0.1


def test_an_object_deep_in_something_is_named(panda, on_table):
    (table,) = (o for o in vrrt_jax.obstacle_list(on_table) if o.name == "table")
    x, y, z = table.position
    deep = vrrt_jax.move_obstacle(on_table, "table", position=(x, y, z + 0.02))
    world = vrrt_jax.attach(deep, "can", "hand", q=START)
    with pytest.raises(ValueError, match="the start is in collision: can touches table"):
        vrrt_jax.plan(
            panda, world, vrrt_jax.ConfigurationGoal(q=START), START, key=jax.random.key(0)
        )


def test_spheres_that_stick_out_are_named(panda):
    x, y, z = fingertips(panda, START)
    sheet = thing("box", (x, y, z - 0.06 - 0.014), name="sheet", size=(0.3, 0.3, 0.01))
    world = bare_world(panda, [sheet])
    can = dataclasses.replace(thing("cylinder"), position=_in_hand(panda, (x, y, z)))
    world = vrrt_jax.attach(world, can, "hand")  # without q: no support is known
    with pytest.raises(ValueError, match="the spheres around can, which stick out of it by 10 mm"):
        vrrt_jax.plan(
            panda, world, vrrt_jax.ConfigurationGoal(q=START), START, key=jax.random.key(0)
        )


def _in_hand(panda, position):
    """A position (3,) in the world at START in the frame of the hand."""
    return tuple((np.linalg.inv(_hand_pose(panda, START)) @ [*position, 1.0])[:3])


STICK = (0.02, 0.25, 0.0)  # a long capsule across the hand
WALL = thing("box", (0.573, 0.436, 0.35), name="wall", size=(0.02, 0.02, 0.35))


def test_a_path_that_drags_the_object_through_a_wall_is_refused(panda):
    """The bare arm passes beside the wall; the stick does not, and is carried around."""
    stick = thing("capsule", size=STICK, quaternion=(0.7071, 0.7071, 0, 0), name="stick")
    world = bare_world(panda, [WALL])
    goal = START + np.array([1.3, 0, 0, 0, 0, 0, 0])
    path = np.stack([START, goal])
    assert verify_path(panda, world, path).ok
    held = vrrt_jax.attach(world, stick, "hand")
    seen = verify_path(panda, held, path)
    assert not seen.ok and "stick touches wall" in str(seen.contact)
    result = vrrt_jax.plan_to_configuration(panda, held, START, goal, key=jax.random.key(0))
    assert result.ok and result.cost > 1.35  # the straight line is 1.3 long
    assert verify_path(panda, held, result.path, step=0.002).ok


def test_obstacles_move_while_it_is_held(panda, on_table):
    world = vrrt_jax.attach(on_table, "can", "hand", q=START)
    for off, is_free in (((0, 0, 0), True), ((0, 0, 0.03), False), ((0, 0, -0.1), True)):
        (table,) = vrrt_jax.obstacle_list(world)
        moved = vrrt_jax.move_obstacle(
            world, "table", position=tuple(np.add(table.position, off).tolist())
        )
        assert free(moved, START) == is_free and [h.body for h in moved.attached] == ["hand"]
        assert jax.tree.structure(moved) == jax.tree.structure(world)


def test_both_engines_agree_on_held_objects(panda, around, on_table, rng):
    """On configurations, on spans of edges, with a margin, and after obstacles have moved."""
    uniform = rng.uniform(panda.lower, panda.upper, (300, 7)).astype(np.float32)
    near = (START + rng.normal(size=(300, 7)) * 0.1).astype(np.float32)
    edge = jnp.asarray(rng.normal(size=7), jnp.float32)
    spans = jax.jit(jax.vmap(lambda world, q: world.free_span(q, edge), (None, 0)))
    for world, body, q in ((around, "link7", uniform), (on_table, "hand", near)):
        obstacles = [o for o in vrrt_jax.obstacle_list(world) if o.name != "can"]
        q = jnp.asarray(q)
        answers = []
        for engine in ("closed_form", "mjx"):
            own = bare_world(panda, vrrt_jax.obstacle_list(world), engine)
            grip = ("can", body) if world is on_table else (thing(), body)
            own = vrrt_jax.attach(own, *grip, q=START if world is on_table else None)
            moved = vrrt_jax.with_obstacles(own, obstacles[::-1])
            answers.append(
                [batch_is_free(w, q) for w in (own, with_margin(own, 0.01), moved)]
                + [spans(own, q)]
            )
        for ours, theirs in zip(*answers, strict=True):
            differs = ~np.isclose(ours, theirs, atol=1e-3)
            assert differs.mean() < 0.01
        assert 0.05 < np.mean(answers[0][0]) < 0.95


class NeverLeft(vrrt_jax.ClosedFormWorld):
    """A rule of one's own."""

    limit: jax.Array

    def is_free(self, q):
        """No turn of the base beyond the limit."""
        return super().is_free(q) & (q[0] < self.limit)


def test_a_subclass_keeps_what_is_held(panda, around):
    world = vrrt_jax.attach(around, thing("box"), "hand")
    mine = NeverLeft(**vars(world), limit=jnp.float32(0.5))
    assert mine.attached == world.attached and free(mine, START)
    x, y, z = fingertips(panda, START)
    block = [thing("sphere", (x, y + 0.1, z), name="block")]
    for held in (vrrt_jax.with_obstacles(mine, block), vrrt_jax.with_obstacles(world, block)):
        assert not free(held, START) and "can touches block" in contacts(panda, held, START)
    later = vrrt_jax.attach(NeverLeft(**vars(around), limit=jnp.float32(0.5)), thing("box"), "hand")
    assert isinstance(later, NeverLeft) and len(later.spheres.radius) > len(around.spheres.radius)


def test_the_margin_is_asked_of_held_objects_too(panda):
    empty = bare_world(panda)
    for world in (
        with_margin(vrrt_jax.attach(empty, thing("box"), "hand"), 0.03),
        vrrt_jax.attach(with_margin(empty, 0.03), thing("box"), "hand"),
    ):
        bare = vrrt_jax.attach(empty, thing("box"), "hand")
        pairs = np.asarray(bare.spheres.contact_distance) > 0
        wider = np.asarray(world.spheres.contact_distance - bare.spheres.contact_distance)
        np.testing.assert_allclose(wider, 0.03 * pairs, atol=1e-6)


def test_what_makes_no_sense_is_refused(panda, around):
    held = vrrt_jax.attach(around, thing("box"), "hand")
    plane = vrrt_jax.Obstacle(name="plane", kind="plane", position=(0, 0, 0))
    for match, attempt in (
        ("'gripper' is no link of the robot; have: link1, .*hand, ", ("box", "gripper")),
        ("'link0' does not move; have: link1", ("box", "link0")),
        ("a plane cannot be held; expected one of: sphere", (plane, "hand")),
    ):
        obstacle = thing() if attempt[0] == "box" else attempt[0]
        with pytest.raises(ValueError, match=match):
            vrrt_jax.attach(around, obstacle, attempt[1])
    with pytest.raises(ValueError, match=r"no obstacle named 'cup'; the world has \['table'"):
        vrrt_jax.attach(around, "cup", "hand", q=START)
    with pytest.raises(ValueError, match="'post' stands in the world; give q"):
        vrrt_jax.attach(around, "post", "hand")
    with pytest.raises(ValueError, match="'can' is the name of an obstacle already"):
        vrrt_jax.attach(held, thing(), "hand")
    with pytest.raises(ValueError, match=r"the robot holds \['can'\] already"):
        vrrt_jax.with_obstacles(held, [thing()])
    with pytest.raises(ValueError, match=r"no obstacle named 'can'.* the robot holds \['can'\]"):
        vrrt_jax.move_obstacle(held, "can", position=(0, 0, 0))
    with pytest.raises(ValueError, match="expected 7 finite numbers, for the joints joint1"):
        vrrt_jax.attach(around, "post", "hand", q=START[:3])
    with pytest.raises(ValueError, match=r"the robot holds no 'cup'; it holds \['can'\]"):
        vrrt_jax.detach(held, "cup")


def test_a_world_is_a_pytree_with_what_it_holds(panda, around):
    """Other objects of as many spheres share the compiled functions."""
    first, second = (
        vrrt_jax.attach(around, thing("cylinder", size=(r, 0.06, 0.0)), "hand")
        for r in (0.033, 0.032)
    )
    assert jax.tree.structure(first) == jax.tree.structure(second)
    shapes = [[jnp.shape(leaf) for leaf in jax.tree.leaves(world)] for world in (first, second)]
    assert shapes[0] == shapes[1]
    assert pytree(type(first)) is vrrt_jax.ClosedFormWorld
    assert pose_of(first.attached[0].obstacle)[:3, 3] == pytest.approx(AHEAD)
