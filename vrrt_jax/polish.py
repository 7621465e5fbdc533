"""Tell apart what a small image cannot: matched configurations, looked at more closely.

At the resolution of the search some directions are open: a wrist may turn by a radian and the image
hardly changes. Near a match these are the weak eigenvectors of the Gauss-Newton matrix. Polishing
spreads samples along them and lets all descend by Levenberg-Marquardt on a larger image with more
splats. With few joints that takes forward renders alone. What no image tells, such as the turn of a
bare flange, stays near the start: a weak prior sees to that.
"""

import dataclasses

import jax
import jax.numpy as jnp

from vrrt_jax.core.edges import difference, into_limits
from vrrt_jax.core.types import pytree, static
from vrrt_jax.core.world import World, is_free
from vrrt_jax.splat.loss import weighted_goal, weighted_image
from vrrt_jax.splat.raster import map_lanes
from vrrt_jax.visual import VisualPolicy

PROBE = 0.01  # [rad] step of the finite differences
OTHERS = 0.5  # standard deviations that samples spread along all but the weakest direction
RIDGE = 1e-7  # keeps joints that no pixel sees where they are
LONGEST = 0.3  # [rad] of one step of a joint


@pytree
class Polishing:
    """How configurations are polished."""

    policy: VisualPolicy  # with the larger goal; only its loss is used
    q_start: jax.Array  # (D,)
    prior: jax.Array  # () loss that a radian away from the start costs
    slack: jax.Array  # () how much loss the spread may add, to second order
    reach: jax.Array  # () how far samples spread at most [rad]
    steps: jax.Array  # (2,) i32 of all samples, and further ones of the best
    lanes: int = static()  # samples of each configuration, itself and half a turn among them
    kept: int = static()  # the best of all samples


@pytree
class _Descent:
    """Levenberg-Marquardt from n configurations at once."""

    q: jax.Array  # (n, D)
    loss: jax.Array  # (n,) of the image alone
    cost: jax.Array  # (n,) and with the prior
    residual: jax.Array  # (n, pixels + D)
    jacobian: jax.Array  # (n, D, pixels + D)
    damping: jax.Array  # (n,)


def polish(
    world: World, polishing: Polishing, q: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Spread configurations (H, D) and descend.

    Returns:
        Configurations (kept, D), best first, and their image losses; infinite in collision.
    """
    near = _begin(world, polishing, q)
    samples = _begin(world, polishing, _spread(world, polishing, near, key))
    samples = _descend(world, polishing, samples, polishing.steps[0])
    _, best = jax.lax.top_k(-samples.cost, polishing.kept)
    kept = jax.tree.map(lambda leaf: leaf[best], samples)
    kept = _descend(world, polishing, kept, polishing.steps[1])
    free = jax.vmap(is_free, (None, 0))(world, kept.q)
    order = jnp.argsort(jnp.where(free, kept.cost, jnp.inf))
    return kept.q[order], jnp.where(free, kept.loss, jnp.inf)[order]


def _spread(world: World, polishing: Polishing, near: _Descent, key: jax.Array) -> jax.Array:
    """Samples (H * lanes, D) along the directions that the image tells little about."""
    curvature = 2.0 * jnp.einsum("hip,hjp->hij", near.jacobian, near.jacobian)
    values, vectors = jnp.linalg.eigh(curvature)
    reach = jnp.sqrt(2.0 * polishing.slack / jnp.maximum(values, 1e-9))
    reach = jnp.minimum(reach, polishing.reach)[:, None]
    num, joints = polishing.lanes - 2, near.q.shape[1]
    along = OTHERS * jax.random.normal(key, (len(near.q), num, joints))
    along = along.at[:, :, 0].set(jnp.linspace(-1.0, 1.0, num))  # eigenvalues rise
    samples = near.q[:, None] + jnp.einsum("hij,hlj->hli", vectors, reach * along)
    # Grippers look alike after half a turn.
    weakest = vectors[:, :, 0]
    away_from_centre = jnp.sum(near.q * weakest, axis=1, keepdims=True) > 0
    turned = near.q + jnp.where(away_from_centre, -jnp.pi, jnp.pi) * weakest
    samples = jnp.concatenate([near.q[:, None], turned[:, None], samples], axis=1)
    return into_limits(world, samples.reshape(-1, joints))


def _begin(world: World, polishing: Polishing, q: jax.Array) -> _Descent:
    """Images at configurations (n, D), and their derivatives by finite differences."""
    policy, joints = polishing.policy, q.shape[1]
    places = q[:, None] + PROBE * jnp.eye(joints + 1, joints, -1)

    def image(q):
        return weighted_image(
            world.chain, policy.splats, policy.cameras, policy.goal, q, policy.windows
        )

    images = map_lanes(image, places.reshape(-1, joints)).reshape(len(q), joints + 1, -1)
    residual = images[:, 0] - weighted_goal(policy.goal)
    loss = jnp.sum(residual**2, axis=1)
    root = jnp.sqrt(polishing.prior)
    away = root * difference(world, polishing.q_start, q)
    outwards = jnp.broadcast_to(root * jnp.eye(joints), (len(q), joints, joints))
    slopes = (images[:, 1:] - images[:, :1]) / PROBE
    return _Descent(
        q=q,
        loss=loss,
        cost=loss + jnp.sum(away**2, axis=1),
        residual=jnp.concatenate([residual, away], axis=1),
        jacobian=jnp.concatenate([slopes, outwards], axis=2),
        damping=jnp.full(len(q), 1e-2),
    )


def _descend(world: World, polishing: Polishing, start: _Descent, steps: jax.Array) -> _Descent:
    """Steps that lower the cost; those that do not raise the damping."""

    def step(_, now: _Descent) -> _Descent:
        matrix = jnp.einsum("nip,njp->nij", now.jacobian, now.jacobian)
        slope = jnp.einsum("nip,np->ni", now.jacobian, now.residual)
        diagonal = jnp.einsum("nii->ni", matrix)
        matrix += jax.vmap(jnp.diag)(now.damping[:, None] * diagonal + RIDGE)
        change = -jnp.linalg.solve(matrix, slope[..., None])[..., 0]
        q = into_limits(world, now.q + jnp.clip(change, -LONGEST, LONGEST))
        tried = _begin(world, polishing, q)
        better = tried.cost < now.cost
        damping = now.damping * jnp.where(better, 0.3, 4.0)

        def choose(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return dataclasses.replace(jax.tree.map(choose, tried, now), damping=damping)

    return jax.lax.fori_loop(0, steps, step, start)
