"""Seeds: samples around the start that look most like the goal, found before the search.

They are rendered at low resolution, improved by random changes and by Adam, and become roots of
the tree beside the start.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.edges import enforce_bounds
from vrrt_jax.core.parallel import map_on_threads
from vrrt_jax.core.types import Goal, pytree, static
from vrrt_jax.scene.world import World
from vrrt_jax.splat.lanes import LANES, map_lanes
from vrrt_jax.visual.descent import adam_descent

CHILDREN = 16  # of a seed, in a generation
SPREAD_FIRST, SPREAD_LAST = 0.8, 0.2  # [rad] standard deviations of their joints


@pytree
class SeedSampling:
    """Where to sample before the search, and how.

    It is done in parts of few enough lanes, which differ in their keys and run side by side.
    """

    goal: Goal  # at low resolution
    alpha: jax.Array  # () first Adam step, falling to zero [rad]
    beta1: jax.Array  # ()
    beta2: jax.Array  # ()
    radius: jax.Array  # () largest distance from the start [rad]
    rounds: jax.Array  # () i32 times that each kept one looks for something better around it
    steps: jax.Array  # () i32 Adam steps that each kept one takes
    parts: int = static()  # none gives the plain tree of the paper
    num: int = static()  # configurations that a part renders
    kept: int = static()  # best of them that descend

    @classmethod
    def from_config(cls, goal: Goal, config: PlannerConfig) -> "SeedSampling":
        """The seeds that the settings of a plan ask for."""
        seeds = config.seeds
        kept = min(seeds.num, seeds.kept)
        parts = -(-kept // LANES)
        return cls(
            goal=goal,
            alpha=jnp.float32(seeds.alpha),
            beta1=jnp.float32(config.expand.beta1),
            beta2=jnp.float32(config.expand.beta2),
            radius=jnp.float32(seeds.radius),
            rounds=jnp.int32(seeds.rounds),
            steps=jnp.int32(seeds.steps),
            parts=parts,
            num=-(-seeds.num // max(parts, 1)),
            kept=-(-kept // max(parts, 1)),
        )


def seeded_roots(
    world: World, seeds: SeedSampling, q_roots: np.ndarray, key: jax.Array
) -> np.ndarray:
    """Roots (R', D) of a tree: those that are given (R, D), the start first, and then the seeds."""
    keys = jax.random.split(key, seeds.parts)
    found = map_on_threads(lambda key: sample_seeds(world, seeds, q_roots[0], key), keys)
    # As many in all as descended, so that lanes come out even and compile once.
    num = max(seeds.parts * seeds.kept, len(q_roots))
    return np.concatenate([q_roots, *found])[:num]


@jax.jit
def sample_seeds(
    world: World, seeds: SeedSampling, q_start: jax.Array, key: jax.Array
) -> jax.Array:
    """Configurations (kept, D) around the start that are free and render most like the goal."""
    key_direction, key_distance, key_children = jax.random.split(key, 3)

    # Sample in a ball around the start; the distance is uniform, so that near ones are many.
    direction = jax.random.normal(key_direction, (seeds.num, len(q_start)))
    direction /= jnp.linalg.norm(direction, axis=1, keepdims=True)
    distance = seeds.radius * jax.random.uniform(key_distance, (seeds.num, 1))
    q = enforce_bounds(world, q_start + distance * direction)

    # Keep the best, improve them by random changes, then by Adam.
    loss = _free_losses(world, seeds, q)
    _, best = jax.lax.top_k(-loss, seeds.kept)
    q = _evolve(world, seeds, q[best], loss[best], key_children)
    return _descend(world, seeds, q)


def _free_losses(world: World, seeds: SeedSampling, q: jax.Array) -> jax.Array:
    """Losses (n,) on the small image, infinite in collision."""
    loss = map_lanes(lambda q: seeds.goal.loss(world, q), q)
    return jnp.where(jax.vmap(world.is_free)(q), loss, jnp.inf)


def _evolve(
    world: World, seeds: SeedSampling, q: jax.Array, loss: jax.Array, key: jax.Array
) -> jax.Array:
    """Seeds (kept, D), each replaced by the best of its children while that is better.

    Children differ in some of the joints, by ever less. Where gradients end in the nearest local
    minimum, children jump out of it; and as no seed competes with another's children, the seeds
    stay diverse.
    """
    num, joints = q.shape
    shape = (num, CHILDREN, joints)

    def generation(k, state):
        q, loss = state
        key_step, key_share, key_moved = jax.random.split(jax.random.fold_in(key, k), 3)
        progress = k / jnp.maximum(seeds.rounds - 1, 1)
        spread = SPREAD_FIRST * (SPREAD_LAST / SPREAD_FIRST) ** progress

        # Each child moves a random share of its joints.
        share = jax.random.uniform(key_share, (*shape[:2], 1), minval=0.2)
        moved = jax.random.uniform(key_moved, shape) < share
        step = spread * moved * jax.random.normal(key_step, shape)
        children = enforce_bounds(world, (q[:, None] + step).reshape(-1, joints))

        # The best child of a seed takes its place, if it is better.
        losses = _free_losses(world, seeds, children).reshape(num, CHILDREN)
        best = jnp.argmin(losses, axis=1)
        lowest = jnp.min(losses, axis=1)
        child = children.reshape(shape)[jnp.arange(num), best]
        better = lowest < loss
        return jnp.where(better[:, None], child, q), jnp.where(better, lowest, loss)

    return jax.lax.fori_loop(0, seeds.rounds, generation, (q, loss))[0]


def _descend(world: World, seeds: SeedSampling, q: jax.Array) -> jax.Array:
    """Follow the gradient from ``q`` (kept, D); what ends in collision goes back."""
    gradient: Callable = jax.grad(lambda q: seeds.goal.loss(world, q))
    end, _ = adam_descent(
        world,
        lambda q: (map_lanes(gradient, q), None),
        q,
        steps=seeds.steps,
        step_size=lambda i: seeds.alpha * (1.0 - i / seeds.steps),
        beta1=seeds.beta1,
        beta2=seeds.beta2,
    )
    free = jax.vmap(world.is_free)(end)
    return jnp.where(free[:, None], end, q)
