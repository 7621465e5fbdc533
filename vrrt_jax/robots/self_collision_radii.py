"""How large the self-collision spheres of a robot should be."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.convex_parts import STEP
from vrrt_jax.robots.kinematics import BodySpheres
from vrrt_jax.robots.self_collision import SelfCollisions, checked_pairs

_MISS_COST = 20.0  # false alarms that one missed self-collision is worth
_STEPS = 600
_SHRINK = 0.007  # [m] to start with: covering spheres stick out by about twice as much
_MIN_SHARE = 0.3  # of its first radius: no sphere gets smaller
_NEAREST = 32  # pairs of spheres considered in one configuration
_MAX_ROWS = 10_000  # configurations that the radii are fitted to
_MOST_DISTANCES = 100_000_000  # between spheres: where there are many, fewer configurations do
_NEAR = 0.005  # [m] free configurations with more room between spheres teach nothing


def fit_radii(
    model: mujoco.MjModel,
    spheres: BodySpheres,
    sample: SelfCollisions,
    ignored_pairs: Sequence[tuple[str, str]],
    write: Callable[..., str],
) -> BodySpheres:
    """Give covering spheres radii that agree with the true geometry in self-collision.

    Args:
        model: the robot with its true geometry.
        spheres: to start from, on all bodies and sorted by body.
        sample: random configurations of ``model``.
        ignored_pairs: pairs of bodies that may touch.
        write: :func:`vrrt_jax.robots.mjcf_writer.collision_mjcf` but for ``self_collision`` and
            ``ignored_pairs``.

    Returns:
        The spheres that are checked against any other, with new radii.
    """
    ignored = {(model.body(first).id, model.body(second).id) for first, second in ignored_pairs}
    truth = np.array([bool(touching - ignored) for touching in sample.touching])
    draft = mujoco.MjModel.from_xml_string(
        write(self_collision=spheres, ignored_pairs=ignored_pairs)
    )
    radii, is_used = _fit_to(draft, sample.q, truth)
    return BodySpheres(
        body=spheres.body[is_used],
        center=spheres.center[is_used],
        radius=np.maximum(np.round(radii[is_used] / STEP), 1) * STEP,
    )


def _fit_to(
    draft: mujoco.MjModel, configurations: np.ndarray, truth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Radii with which self-collision spheres touch where the true geometry does.

    Args:
        draft: the collision model, with radii to start from.
        configurations: (m, D) random ones [rad] or [m].
        truth: (m,) bool, in which of them the true geometry collides with itself.

    Returns:
        Radii (n,) [m]; (n,) bool, which spheres are checked against any other.
    """
    geoms = np.flatnonzero(draft.geom_group == int(mjcf_writer.SELF_COLLISION_GEOM["group"]))
    start = draft.geom_size[geoms, 0]
    pairs = checked_pairs(draft, geoms)
    is_used = np.isin(np.arange(len(geoms)), pairs)
    if not (len(pairs) and truth.any()):
        return start, is_used
    data = mujoco.MjData(draft)
    contact_distance = start[pairs].sum(1)
    num_nearest = min(_NEAREST, len(pairs))
    rows, indices, labels = [], [], []
    num = _MOST_DISTANCES // len(pairs)
    for q, is_colliding in zip(configurations[:num], truth[:num], strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(draft, data)
        centers = data.geom_xpos[geoms]
        apart = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)
        # Only collisions and near misses say something about the radii.
        if is_colliding or np.max(contact_distance - apart) > -_NEAR:
            first = np.argpartition(apart - contact_distance, num_nearest - 1)[:num_nearest]
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
        return jnp.maximum(start - shrink, _MIN_SHARE * start)

    def loss(shrink, progress):
        # A soft count of errors, which gets sharper as the descent goes on.
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
