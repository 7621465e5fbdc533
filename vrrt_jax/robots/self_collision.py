"""Self-collision: which bodies of a robot touch, and which spheres are checked for it."""

import collections
import dataclasses

import mujoco
import numpy as np

from vrrt_jax.robots.limits import joint_ranges

_NUM_DRAFT = 500  # configurations in which a draft of spheres is checked
_ALWAYS = 0.98  # a pair of bodies that touches in a larger share of configurations is ignored


def checked_pairs(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Pairs of geoms that C MuJoCo checks for contact, by its own rules.

    Args:
        model: a compiled robot.
        geoms: (n,) indices of geoms. A geom that several spheres stand for may come several times.

    Returns:
        (P, 2) i32 indices into ``geoms``, the smaller one first.
    """
    first, second = np.triu_indices(len(geoms), 1)
    # The contact bits of the two geoms must meet.
    types, affinities = model.geom_contype[geoms], model.geom_conaffinity[geoms]
    do_bits_meet = (types[first] & affinities[second]) | (types[second] & affinities[first])
    # Bodies welded together are one. A parent and its child touch at the joint, and are left out
    # unless the parent is the base.
    body = model.geom_bodyid[geoms]
    weld = model.body_weldid[body]
    parent = model.body_weldid[model.body_parentid[weld]]
    a, b = weld[first], weld[second]
    is_adjacent = ((a == parent[second]) | (b == parent[first])) & (a != 0) & (b != 0)
    is_excluded = np.isin(_signature(body[first], body[second]), model.exclude_signature)
    keep = (do_bits_meet != 0) & (a != b) & ~is_adjacent & ~is_excluded
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class SelfCollisions:
    """Random configurations of a robot with its true geometry."""

    q: np.ndarray  # (n, D) [rad] or [m]
    touching: list[set[tuple[int, int]]]  # (n,) pairs of bodies that touch, smaller index first


def can_touch_itself(model: mujoco.MjModel) -> bool:
    """Whether the contact bits of any two links meet; true of a robot with one link only."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(collides)
    link = model.body_weldid[model.geom_bodyid[geoms]]
    types, affinities = model.geom_contype[geoms], model.geom_conaffinity[geoms]
    do_bits_meet = (types[:, None] & affinities) | (affinities[:, None] & types)
    return bool(len(np.unique(link)) < 2 or np.any((do_bits_meet != 0) & (link[:, None] != link)))


def sample_self_collisions(
    model: mujoco.MjModel, num: int, rng: np.random.Generator
) -> SelfCollisions:
    """Find out what touches what in random configurations.

    Args:
        model: the robot with its true geometry, and nothing else.
        num: number of configurations.
        rng: source of randomness.
    """
    data = mujoco.MjData(model)
    q = rng.uniform(*joint_ranges(model), (num, model.njnt))
    touching = []
    for row in q:
        data.qpos[:] = row
        touching.append(touching_bodies(model, data))
    return SelfCollisions(q=q, touching=touching)


def _count(sample: SelfCollisions) -> dict[tuple[int, int], int]:
    """How often each pair of bodies touches."""
    return collections.Counter(pair for pairs in sample.touching for pair in pairs)


def find_ignored_pairs(model: mujoco.MjModel, sample: SelfCollisions) -> list[tuple[str, str]]:
    """Pairs of bodies that need no check: they never touch, or nearly always do.

    A body and the one that carries it are among them, as they share a joint, where C MuJoCo does
    not skip them by itself.

    Args:
        model: the robot with its true geometry.
        sample: random configurations.
    """
    count = _count(sample)
    bodies = np.unique(model.geom_bodyid)
    weld = model.body_weldid
    ignored = []
    for a, b in ((int(a), int(b)) for a in bodies for b in bodies if a < b):
        first, second = weld[a], weld[b]
        parents = weld[model.body_parentid[[first, second]]]
        # Bodies welded together: C MuJoCo skips them by itself.
        if first == second:
            continue
        # Neighbors along the chain: C MuJoCo skips them too, but for those of the base. A body with
        # several joints is written as several, which puts the carrier out of MuJoCo's sight.
        is_joined = second == parents[0] or first == parents[1]
        child = first if second == parents[0] else second
        if is_joined and first and second and model.body_jntnum[child] == 1:
            continue
        if is_joined or not 0 < count.get((a, b), 0) < _ALWAYS * len(sample.q):
            ignored.append((model.body(a).name, model.body(b).name))
    return ignored


def always_touching(model: mujoco.MjModel) -> list[tuple[str, str]]:
    """Pairs of bodies whose self-collision spheres touch at home, or nearly everywhere.

    Args:
        model: compiled from :func:`vrrt_jax.robots.mjcf_writer.collision_mjcf`.
    """
    sample = sample_self_collisions(model, _NUM_DRAFT, np.random.default_rng(0))
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0]
    pairs = touching_bodies(model, data) | {
        pair for pair, times in _count(sample).items() if times > _ALWAYS * _NUM_DRAFT
    }
    return [(model.body(first).name, model.body(second).name) for first, second in sorted(pairs)]


def touching_bodies(model: mujoco.MjModel, data: mujoco.MjData) -> set[tuple[int, int]]:
    """Pairs of bodies (smaller index first) that penetrate each other at ``data.qpos``."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    geoms = data.contact.geom[data.contact.dist < 0]
    bodies = np.sort(model.geom_bodyid[geoms], axis=1)
    return {(int(first), int(second)) for first, second in bodies}
