"""Self-collision: how thick the spheres of each body should be."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.convex_parts import STEP
from vrrt_jax.robots.pairs import SelfCollisions, checked_pairs

_MISS_COST = 20.0  # false alarms that one missed self-collision is worth
_STEPS = 600
_SHRINK = 0.007  # [m] to start with: covering spheres stick out by about twice as much
_LEAST = 0.3  # of its first radius: no sphere gets thinner
_NEAREST = 32  # pairs of spheres looked at in one configuration
_MAX_ROWS = 10_000
_NEAR = 0.005  # [m] free configurations with more room between spheres teach nothing


def refine(
    model: mujoco.MjModel,
    spheres: mjcf_writer.BodySpheres,
    found: SelfCollisions,
    allowed: list[tuple[str, str]],
    write: Callable[..., str],
) -> mjcf_writer.BodySpheres:
    """Give covering spheres radii that agree with the true geometry in self-collision.

    Args:
        model: the robot with its true geometry.
        spheres: to start from, on all bodies and sorted by body.
        found: random configurations of ``model``.
        allowed: pairs of bodies that may touch.
        write: :func:`vrrt_jax.robots.mjcf_writer.collision_mjcf` but for ``thin`` and ``allowed``.

    Returns:
        Those of the spheres that are checked against any other, with new radii.
    """
    banned = {(model.body(first).id, model.body(second).id) for first, second in allowed}
    truth = np.array([bool(touching - banned) for touching in found.touching])
    draft = mujoco.MjModel.from_xml_string(write(thin=spheres, allowed=allowed))
    radii, is_used = _fit_radii(draft, found.q, truth)
    return mjcf_writer.BodySpheres(
        body=spheres.body[is_used],
        center=spheres.center[is_used],
        radius=np.round(radii[is_used] / STEP) * STEP,
    )


def _fit_radii(
    draft: mujoco.MjModel, configurations: np.ndarray, truth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Radii with which thin spheres touch where the true geometry does.

    Args:
        draft: the collision model, with radii to start from.
        configurations: (m, D) random ones [rad] or [m].
        truth: (m,) bool, in which of them the true geometry collides with itself.

    Returns:
        Radii (n,) [m]; (n,) bool, which spheres are checked against any other.
    """
    geoms = np.flatnonzero(draft.geom_group == int(mjcf_writer.THIN["group"]))
    start = draft.geom_size[geoms, 0]
    pairs = checked_pairs(draft)
    is_used = np.isin(np.arange(len(geoms)), pairs)
    if not (len(pairs) and truth.any()):
        return start, is_used
    data = mujoco.MjData(draft)
    reach = start[pairs].sum(1)
    nearest = min(_NEAREST, len(pairs))
    rows, indices, labels = [], [], []
    for q, is_colliding in zip(configurations, truth, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(draft, data)
        centers = data.geom_xpos[geoms]
        apart = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
        if is_colliding or np.max(reach - apart) > -_NEAR:
            first = np.argpartition(apart - reach, nearest - 1)[:nearest]
            rows.append(apart[first].astype(np.float32))
            indices.append(pairs[first])
            labels.append(is_colliding)
        if len(rows) == _MAX_ROWS:
            break
    arrays = (np.float32(start), np.array(indices), np.array(rows), np.array(labels))
    return np.asarray(_descend(*arrays), np.float64), is_used


@jax.jit
def _descend(
    start: jax.Array, pairs: jax.Array, apart: jax.Array, is_colliding: jax.Array
) -> jax.Array:
    """The best radii (n,), given ``pairs`` (m, k, 2) and their distances ``apart`` (m, k) [m]."""
    optimizer = optax.adam(optax.cosine_decay_schedule(5e-4, _STEPS, 0.02))

    def radii_of(shrink):
        return jnp.maximum(start - shrink, _LEAST * start)

    def loss(shrink, progress):
        width = 0.004 * (1 - progress) + 0.0008
        depth = jnp.max(jnp.sum(radii_of(shrink)[pairs], axis=-1) - apart, axis=1)
        missed = _MISS_COST * jax.nn.sigmoid((5e-4 - depth) / width)
        return jnp.mean(jnp.where(is_colliding, missed, jax.nn.sigmoid(depth / width)))

    def step(carry, progress):
        shrink, state = carry
        updates, state = optimizer.update(jax.grad(loss)(shrink, progress), state)
        return (jax.tree.map(jnp.add, shrink, updates), state), None

    shrink = jnp.full_like(start, _SHRINK)
    progress = jnp.arange(_STEPS) / _STEPS
    (shrink, _), _ = jax.lax.scan(step, (shrink, optimizer.init(shrink)), progress)
    return radii_of(shrink)
