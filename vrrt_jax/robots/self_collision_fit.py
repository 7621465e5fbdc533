"""Move and resize the self-collision spheres of a robot until they touch where its meshes do.

Radii alone, as :mod:`vrrt_jax.robots.self_collision_radii` fits them while a robot is loaded, leave
spheres where they cover best, which is not where they tell best. Here centers move too. At last
radii grow until no collision of the sample is missed.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax

from vrrt_jax.robots.convex_parts import STEP
from vrrt_jax.robots.kinematics import BodySpheres

_ROUNDS = 2  # of choosing the pairs that nearly touch, and of descending
_STEPS = 300
_NEAREST = 16  # pairs of spheres considered in one configuration
_MAX_ROWS = 4000  # configurations of one descent that collide, and as many that nearly do
_SHRINK = 0.007  # [m] to start with: covering spheres stick out by about as much
_NEAR = 0.005  # [m] free configurations with more room between spheres teach nothing
_MISS_COST = 20.0  # false alarms that one missed self-collision is worth
_MIN_DEPTH = 1e-3  # [m] that spheres should be in each other where the robot collides
_MIN_RADIUS = 2e-3  # [m]
_CHANGE = 0.01  # [m] of a radius at most, where centers stay
_SWEEPS = 3  # over all radii then
_BLOCK = 2000  # configurations at a time


def fit_to_sample(
    model: mujoco.MjModel,
    spheres: BodySpheres,
    pairs: np.ndarray,
    configurations: np.ndarray,
    is_colliding: np.ndarray,
) -> BodySpheres:
    """Spheres that touch each other where a robot collides with itself.

    Args:
        model: the robot's bodies and joints.
        spheres: n that cover the bodies, to start from.
        pairs: (P, 2) int, those that are checked against each other.
        configurations: (m, D) random ones [rad] or [m].
        is_colliding: (m,) bool, in which of them the true geometry does.

    Returns:
        As many spheres, on the same bodies. No collision among the configurations is missed.
    """
    center, radius = spheres.center, np.maximum(spheres.radius - _SHRINK, spheres.radius / 3)
    if not (len(pairs) and is_colliding.any()):
        return spheres
    frames = _body_frames(model, configurations)
    first, second = spheres.body[pairs].T
    for _ in range(_ROUNDS):
        # What collides or nearly does, and by which spheres.
        depth = _depths(frames, spheres.body, center, radius, pairs)
        near_misses = np.flatnonzero(~is_colliding & (depth.max(axis=1) > -_NEAR))
        groups = (np.flatnonzero(is_colliding), near_misses)
        rows = np.concatenate([rows[:: 1 + len(rows) // _MAX_ROWS] for rows in groups])
        num = min(_NEAREST, len(pairs))
        nearest = np.argpartition(-depth[rows], num - 1, axis=1)[:, :num]
        # The second sphere's body in the frame of the first one's.
        a, b = frames[rows[:, None], first[nearest]], frames[rows[:, None], second[nearest]]
        to_first = np.swapaxes(a[..., :3], -1, -2)
        turn = to_first @ b[..., :3]
        shift = (to_first @ (b[..., 3:] - a[..., 3:]))[..., 0]
        arrays = (center, radius, turn, shift)
        found = _descend(
            *(jnp.asarray(x, jnp.float32) for x in arrays), pairs[nearest], is_colliding[rows]
        )
        center, radius = (np.asarray(part, np.float64) for part in found)
    center = np.round(center / STEP) * STEP
    depth = _depths(frames[is_colliding], spheres.body, center, radius, pairs)
    radius = np.ceil(_grown(depth, pairs, radius) / STEP - 1e-9) * STEP
    return BodySpheres(body=spheres.body, center=center, radius=radius)


def fit_radii_to_sample(
    model: mujoco.MjModel,
    spheres: BodySpheres,
    pairs: np.ndarray,
    configurations: np.ndarray,
    is_colliding: np.ndarray,
) -> BodySpheres:
    """The same spheres with radii of fewer errors, where a miss counts as many false alarms.

    One radius after another takes the value that is best while the others stay, so that no step
    makes it worse. Arguments as of :func:`fit_to_sample`.
    """
    frames = _body_frames(model, configurations)
    depth = _depths(frames, spheres.body, spheres.center, spheres.radius, pairs)
    is_near = depth.max(axis=1, initial=-np.inf) > -_CHANGE
    depth = depth[is_near]
    weight = np.where(is_colliding[is_near], -_MISS_COST, 1.0)
    radius = spheres.radius.copy()
    for k in list(range(len(radius))) * _SWEEPS:
        mine = np.any(pairs == k, axis=1)
        if not mine.any():
            continue
        # What no other pair tells of, in the order in which a larger radius does.
        is_alone = depth[:, ~mine].max(axis=1, initial=-np.inf) <= 0
        needed = -depth[:, mine].max(axis=1)
        rows = np.flatnonzero(is_alone & (np.abs(needed) < _CHANGE))
        rows = rows[np.argsort(needed[rows])]
        cost = np.concatenate([[0.0], np.cumsum(weight[rows])])
        edges = np.concatenate([[-_CHANGE], needed[rows], [_CHANGE]])
        # The middle of the best interval; no change if it is as good.
        low, high = (part[cost <= cost.min()] for part in (edges[:-1], edges[1:]))
        change = np.where((low < 0) & (high > 0), 0.0, (low + high) / 2)
        change = max(change[np.abs(change).argmin()], _MIN_RADIUS - radius[k])
        radius[k] += change
        depth[:, mine] += np.float32(change)
    radius = np.maximum(np.round(radius / STEP), 1) * STEP
    return BodySpheres(body=spheres.body, center=spheres.center, radius=radius)


def _body_frames(model: mujoco.MjModel, configurations: np.ndarray) -> np.ndarray:
    """Rotations and positions (m, nbody, 3, 4) of all bodies."""
    data = mujoco.MjData(model)
    frames = np.zeros((len(configurations), model.nbody, 3, 4), np.float32)
    for row, q in zip(frames, configurations, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        row[:, :, :3], row[:, :, 3] = data.xmat.reshape(-1, 3, 3), data.xpos
    return frames


def _depths(
    frames: np.ndarray, body: np.ndarray, center: np.ndarray, radius: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """How deep the spheres of each pair are in each other, (m, P) [m]."""
    first, second = pairs.T
    depths = []
    for block in np.array_split(frames, 1 + len(frames) // _BLOCK):
        own = block[:, body]
        place = np.einsum("mnij,nj->mni", own[..., :3], center.astype(np.float32)) + own[..., 3]
        apart = np.linalg.norm(place[:, first] - place[:, second], axis=-1)
        depths.append((radius[first] + radius[second]).astype(np.float32) - apart)
    return np.concatenate(depths)


def _grown(depth: np.ndarray, pairs: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Radii (n,) [m] with which some pair touches in each of m collisions, given depths (m, P)."""
    radius, depth = radius.copy(), depth[depth.max(axis=1) <= 0]
    while len(depth):
        # The collision that is missed by most, and the pair that is nearest to touching there.
        row = depth.max(axis=1).argmin()
        pair = depth[row].argmax()
        more = (STEP - depth[row, pair]) / 2
        for sphere in pairs[pair]:
            radius[sphere] += more
            depth += more * np.any(pairs == sphere, axis=1)
        depth = depth[depth.max(axis=1) <= 0]
    return radius


@jax.jit
def _descend(
    center: jax.Array,
    radius: jax.Array,
    turn: jax.Array,
    shift: jax.Array,
    pairs: jax.Array,
    is_colliding: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Better centers (n, 3) and radii (n,), for m configurations with k pairs (m, k, 2) each.

    ``turn`` (m, k, 3, 3) and ``shift`` (m, k, 3) are the second body's frame in the first one's.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(5e-4, _STEPS, 0.02))
    first, second = pairs[..., 0], pairs[..., 1]

    def loss(spheres, progress):
        # A soft count of errors, which gets sharper; misses by much count more.
        center, radius = spheres
        width = 0.004 * (1 - progress) + 0.0008
        moved = jnp.sum(turn * center[second][..., None, :], axis=-1) + shift
        apart = jnp.sqrt(jnp.sum((moved - center[first]) ** 2, axis=-1) + 1e-12)
        reach = jnp.maximum(radius, _MIN_RADIUS)
        depth = jnp.max(reach[first] + reach[second] - apart, axis=1)
        lack = (_MIN_DEPTH - depth) / width
        missed = _MISS_COST * (jax.nn.sigmoid(lack) + 0.2 * jax.nn.relu(lack))
        return jnp.mean(jnp.where(is_colliding, missed, jax.nn.sigmoid(depth / width)))

    def step(carry, progress):
        spheres, state = carry
        updates, state = optimizer.update(jax.grad(loss)(spheres, progress), state)
        return (jax.tree.map(jnp.add, spheres, updates), state), None

    spheres = (center, radius)
    progress = jnp.arange(_STEPS) / _STEPS
    ((center, radius), _), _ = jax.lax.scan(step, (spheres, optimizer.init(spheres)), progress)
    return center, jnp.maximum(radius, _MIN_RADIUS)
