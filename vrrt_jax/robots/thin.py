"""Self-collision: which pairs of bodies matter, and how thick the spheres of each should be."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax

from vrrt_jax.robots import text
from vrrt_jax.robots.mjcf import joint_ranges
from vrrt_jax.robots.pairs import checked_pairs, touching_bodies

_ALWAYS = 0.98  # a pair of bodies that touches more often than this is allowed to
_MISS_COST = 20.0  # false alarms that one missed self-collision is worth
_STEPS = 600
_SHRINK = 0.007  # [m] to start with: covering spheres stick out by about twice as much
_NEAR = 0.005  # [m] free configurations with more room between spheres teach nothing


@dataclasses.dataclass(frozen=True, kw_only=True)
class SelfCollisions:
    """Random configurations of a robot with its true geometry."""

    q: np.ndarray  # (n, D) [rad] or [m]
    touching: list[set[tuple[int, int]]]  # (n,) pairs of bodies that touch, smaller index first


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


def allowed_pairs(model: mujoco.MjModel, found: SelfCollisions) -> list[tuple[int, int]]:
    """Pairs of bodies that need no check: they never touch, or nearly always do.

    A body and the base that carries it are among them: they share a joint.

    Args:
        model: the robot with its true geometry.
        found: random configurations.
    """
    count: dict[tuple[int, int], int] = {}
    for pairs in found.touching:
        for pair in pairs:
            count[pair] = count.get(pair, 0) + 1
    bodies = np.unique(model.geom_bodyid)
    weld = model.body_weldid
    allowed = []
    for a, b in ((int(a), int(b)) for a in bodies for b in bodies if a < b):
        parents = weld[model.body_parentid[weld[[a, b]]]]
        # C MuJoCo skips these by itself
        if weld[a] == weld[b] or (weld[a] and weld[b] and weld[b] == parents[0]):
            continue
        if weld[a] and weld[b] and weld[a] == parents[1]:
            continue
        is_joined = weld[a] == 0 and parents[1] == 0
        if is_joined or not 0 < count.get((a, b), 0) < _ALWAYS * len(found.q):
            allowed.append((a, b))
    return allowed


def fit_radii(
    draft: mujoco.MjModel, found: SelfCollisions, allowed: list[tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Radii with which thin spheres touch where the true geometry does.

    Args:
        draft: the collision model, with radii to start from.
        found: random configurations of the true geometry.
        allowed: pairs of bodies of the true geometry that may touch.

    Returns:
        Radii (n,) [m]; (n,) bool, which spheres are checked against any other.
    """
    geoms = np.flatnonzero(draft.geom_group == int(text.THIN["group"]))
    start = draft.geom_size[geoms, 0]
    pairs = checked_pairs(draft)
    is_used = np.isin(np.arange(len(geoms)), pairs)
    truth = np.array([bool(touching - set(allowed)) for touching in found.touching])
    if not (len(pairs) and truth.any()):
        return start, is_used
    data = mujoco.MjData(draft)
    reach = start[pairs].sum(1)
    rows, labels = [], []
    for q, is_colliding in zip(found.q, truth, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(draft, data)
        centres = data.geom_xpos[geoms]
        apart = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
        if is_colliding or np.max(reach - apart) > -_NEAR:
            rows.append(apart.astype(np.float32))
            labels.append(is_colliding)
    shrink = _descend(
        jnp.asarray(start, jnp.float32), jnp.asarray(pairs), np.array(rows), np.array(labels)
    )
    return start - np.asarray(shrink, np.float64), is_used


@jax.jit
def _descend(
    start: jax.Array, pairs: jax.Array, apart: jax.Array, is_colliding: jax.Array
) -> jax.Array:
    """How much thinner (n,) each sphere should be [m]."""
    optimizer = optax.adam(optax.cosine_decay_schedule(5e-4, _STEPS, 0.02))

    def loss(shrink, progress):
        width = 0.004 * (1 - progress) + 0.0008
        radii = start - shrink
        depth = jnp.max(radii[pairs[:, 0]] + radii[pairs[:, 1]] - apart, axis=1)
        missed = _MISS_COST * jax.nn.sigmoid((5e-4 - depth) / width)
        return jnp.mean(jnp.where(is_colliding, missed, jax.nn.sigmoid(depth / width)))

    def step(carry, progress):
        shrink, state = carry
        updates, state = optimizer.update(jax.grad(loss)(shrink, progress), state)
        return (jax.tree.map(jnp.add, shrink, updates), state), None

    shrink = jnp.full_like(start, _SHRINK)
    progress = jnp.arange(_STEPS) / _STEPS
    (shrink, _), _ = jax.lax.scan(step, (shrink, optimizer.init(shrink)), progress)
    return shrink
