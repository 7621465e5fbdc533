"""The table of kinds of obstacles."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.scene.exact import exact_scene
from vrrt_jax.scene.obstacle_kinds import KINDS, ObstacleKind, SlotShape

pytestmark = pytest.mark.light_compilation


@pytest.mark.parametrize("name", [name for name in KINDS if name != "plane"])
def test_sizes_survive_a_slot(name):
    kind, size = KINDS[name], np.array([0.1, 0.2, 0.3])
    used = kind.num_sizes
    np.testing.assert_array_equal(kind.decode(kind.encode(size))[:used], size[:used])
    assert mujoco.mjtGeom(kind.geom).name == f"mjGEOM_{name.upper()}"


def test_a_new_kind_is_one_entry(panda, monkeypatch):
    cube = ObstacleKind(
        geom=mujoco.mjtGeom.mjGEOM_BOX,
        num_sizes=1,
        encode=lambda size: SlotShape(half=(size[0], size[0], size[0])),
        decode=lambda shape: (shape.half[0], 0.0, 0.0),
        geom_size=lambda size: (size[0], size[0], size[0]),
    )
    monkeypatch.setitem(KINDS, "cube", cube)
    q = jnp.asarray(panda.home, jnp.float32)
    hand = np.asarray(vrrt_jax.link_poses(panda.chain, q))[-1, :3, 3]
    for position, is_free in ((hand, False), (hand + [0, 0, 2.0], True)):
        cube_there = vrrt_jax.Obstacle(
            name="cube", kind="cube", position=tuple(map(float, position)), size=(0.1, 0.0, 0.0)
        )
        world = vrrt_jax.build_world(panda, [cube_there])
        (back,) = vrrt_jax.obstacle_list(world)
        assert back.kind == "cube" and back.size == pytest.approx((0.1, 0.0, 0.0))
        fast = vrrt_jax.build_world(panda, [cube_there], engine="closed_form")
        assert bool(vrrt_jax.is_free(world, q)) == bool(vrrt_jax.is_free(fast, q)) == is_free
        exact = exact_scene(panda, [cube_there], geometry="spheres")
        assert (not exact.touching(panda.home)) == is_free
    with pytest.raises(ValueError, match="expected 1 positive numbers"):
        vrrt_jax.build_world(
            panda, [vrrt_jax.Obstacle(name="c", kind="cube", position=(0, 0, 0), size=(0, 0, 0))]
        )
