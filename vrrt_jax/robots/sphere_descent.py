"""Descend to spheres that contain points and stick out little where obstacles could be.

That points are contained is a constraint, each with a multiplier of its own (the augmented
Lagrangian; Nocedal and Wright, Numerical Optimization, chapter 17.3). A penalty alone leaves a few
points bare, and spheres that grow over them at last stick out twice as far.
"""

import jax
import jax.numpy as jnp
import numpy as np
import optax

STEPS = 600
_RATE = 2e-3  # [m] a step, to begin with
_SLACK = 2e-4  # [m] how deep points should be in a sphere: there are others between them
_STIFFNESS = 30.0  # [1/m] of what is bare, in shares of false alarms
_EVERY = 10  # steps between two changes of the multipliers
_WIDTHS = (6e-3, 1.5e-3)  # [m] over which false alarms are counted softly, at first and at last
_BATCH = 2048  # places of obstacles that a step looks at


def descend(
    center: np.ndarray,
    radius: np.ndarray,
    obstacles: tuple[np.ndarray, np.ndarray],
    contained: np.ndarray,
    *,
    seed: int,
    begin: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Better spheres.

    Args:
        center: (n, 3) to begin with [m].
        radius: (n,) [m].
        obstacles: centers (x, 3) and radii (x,) of balls that no sphere should touch [m].
        contained: (p, 3) points that spheres should contain [m].
        seed: of the places looked at in each step.
        begin: share of the descent that is left out: then it begins sharp, in small steps.

    Returns:
        Centers (n, 3) and radii (n,) [m]. Some of the points may be bare by a little.
    """
    num = len(radius)
    # One compiled descent serves up to four numbers of spheres: the spare ones have no effect.
    spare = (0, -num % 4)
    arrays = (
        np.pad(center, (spare, (0, 0))),
        np.pad(radius, spare, constant_values=-1.0),
        *obstacles,
        contained,
    )
    arrays = tuple(jnp.asarray(array, jnp.float32) for array in arrays)
    steps = jnp.arange(int(begin * STEPS), STEPS)
    found = _descend(num, jax.random.key(seed), steps / STEPS, *arrays)
    better_center, better_radius = (np.asarray(part, np.float64)[:num] for part in found)
    return better_center, better_radius


@jax.jit
def _descend(
    num: jax.Array,
    key: jax.Array,
    progress: jax.Array,
    center: jax.Array,
    radius: jax.Array,
    places: jax.Array,
    ball: jax.Array,
    contained: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Better centers and radii, after a step for each share in ``progress`` (steps,)."""
    used = jnp.arange(len(radius)) < num
    first, last = _WIDTHS
    optimizer = optax.scale_by_adam()

    def distance(spheres, points):
        center, radius = spheres
        squared = jnp.sum((points[:, None] - center) ** 2, axis=-1)
        # A center may be one of the points: the derivative of a norm is not a number there.
        gap = jnp.sqrt(squared + 1e-12) - radius
        return jnp.min(jnp.where(used, gap, jnp.inf), axis=-1)

    def loss(spheres, multiplier, looked_at, progress):
        width = first + (last - first) * progress
        depth = ball[looked_at] - distance(spheres, places[looked_at])
        lack = multiplier + _STIFFNESS * (distance(spheres, contained) + _SLACK)
        penalty = jnp.sum(jax.nn.relu(lack) ** 2) / (2 * _STIFFNESS)
        return jnp.mean(jax.nn.sigmoid(depth / width)) + penalty, jax.nn.relu(lack)

    def step(carry, now):
        spheres, state, multiplier = carry
        count, progress = now
        key_now = jax.random.fold_in(key, count)
        looked_at = jax.random.randint(key_now, (_BATCH,), 0, len(places))
        slope, lack = jax.grad(loss, has_aux=True)(spheres, multiplier, looked_at, progress)
        update, state = optimizer.update(slope, state)
        rate = _RATE * (0.51 + 0.49 * jnp.cos(jnp.pi * progress))
        spheres = jax.tree.map(lambda x, change: x - rate * change, spheres, update)
        multiplier = jnp.where(count % _EVERY == 0, lack, multiplier)
        return (spheres, state, multiplier), None

    spheres = (center, radius)
    carry = (spheres, optimizer.init(spheres), jnp.zeros(len(contained)))
    (spheres, _, _), _ = jax.lax.scan(step, carry, (jnp.arange(len(progress)), progress))
    return spheres
