"""Which spheres of a robot are checked against each other."""

import mujoco
import numpy as np

from vrrt_jax.robots import text
from vrrt_jax.robots.mjcf import joint_ranges

_SAMPLES = 500
_ALWAYS = 0.98  # a pair of bodies that touches more often than this is allowed to


def checked_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Pairs of thin spheres that C MuJoCo checks in a collision model.

    Args:
        model: compiled from :func:`vrrt_jax.robots.text.collision_mjcf`.

    Returns:
        (P, 2) i32 indices among the thin spheres, in the order of the geoms.
    """
    geoms = np.flatnonzero(model.geom_group == int(text.THIN["group"]))
    body = model.geom_bodyid[geoms]
    first, second = np.triu_indices(len(geoms), 1)
    weld = model.body_weldid[body]
    parent = model.body_weldid[model.body_parentid[weld]]
    a, b = weld[first], weld[second]
    # as in MuJoCo: a parent and its child touch at the joint, unless the parent is the base
    is_adjacent = ((a == parent[second]) | (b == parent[first])) & (a != 0) & (b != 0)
    banned = np.isin(_signature(body[first], body[second]), model.exclude_signature)
    keep = (a != b) & ~is_adjacent & ~banned
    return np.stack([first[keep], second[keep]], -1).astype(np.int32)


def _signature(first: np.ndarray | int, second: np.ndarray | int) -> np.ndarray:
    """MuJoCo's number of a pair of bodies."""
    return (np.int64(np.minimum(first, second)) << 16) + np.maximum(first, second)


def excluded(model: mujoco.MjModel) -> list[tuple[str, str]]:
    """Names of the pairs of bodies that a model excludes from contact."""
    found = []
    for signature in model.exclude_signature:
        found.append((model.body(signature >> 16).name, model.body(signature & 0xFFFF).name))
    return found


def always_touching(model: mujoco.MjModel) -> list[tuple[str, str]]:
    """Pairs of bodies whose thin spheres touch at home, or nearly everywhere.

    The base and the bodies that it carries are among them: MuJoCo checks those.

    Args:
        model: compiled from :func:`vrrt_jax.robots.text.collision_mjcf`.
    """
    rng = np.random.default_rng(0)
    lower, upper = joint_ranges(model)
    data = mujoco.MjData(model)
    count: dict[tuple[int, int], int] = {}
    for sample in range(_SAMPLES + 1):
        data.qpos[:] = rng.uniform(lower, upper) if sample else model.key_qpos[0]
        for pair in touching_bodies(model, data):
            # one touch at home is as good as touching always
            count[pair] = count.get(pair, 0) + (1 if sample else _SAMPLES)
    for joint in np.flatnonzero(model.body_weldid[model.body_parentid[model.jnt_bodyid]] == 0):
        moving = model.jnt_bodyid[joint]
        count[int(model.body_parentid[moving]), int(moving)] = _SAMPLES
    return [
        (model.body(first).name, model.body(second).name)
        for (first, second), times in sorted(count.items())
        if times > _ALWAYS * _SAMPLES and _signature(first, second) not in model.exclude_signature
    ]


def touching_bodies(model: mujoco.MjModel, data: mujoco.MjData) -> set[tuple[int, int]]:
    """Pairs of bodies (smaller index first) that penetrate each other at ``data.qpos``."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    geoms = data.contact.geom[data.contact.dist < 0]
    bodies = np.sort(model.geom_bodyid[geoms], axis=1)
    return {(int(first), int(second)) for first, second in bodies}
