"""Tell apart what a small image cannot: matched configurations, looked at more closely.

At the resolution of the search some directions are open: a wrist may turn by a radian and the image
hardly changes. Near a match these are the weak eigenvectors of the Gauss-Newton matrix. Polishing
spreads samples along them and lets all descend by Levenberg-Marquardt on a larger image with more
splats. With few joints that takes forward renders alone. What no image tells, such as the turn of a
bare flange, stays near the start: a weak prior sees to that.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.edges import difference, into_limits
from vrrt_jax.core.types import pytree
from vrrt_jax.core.world import World, is_free
from vrrt_jax.splat.loss import weighted_goal, weighted_image
from vrrt_jax.splat.raster import map_lanes
from vrrt_jax.visual import VisualPolicy

LANES = 8  # configurations looked at in one call, and that descend
GLANCES = 32  # configurations whose cost alone is asked for, in one call
PROBE = 0.01  # [rad] step of the finite differences
OTHERS = 0.5  # standard deviations that samples spread along all but the weakest direction
RIDGE = 1e-7  # keeps joints that no pixel sees where they are
LONGEST = 0.3  # [rad] of one step of a joint
DISTINCT = 0.3  # [rad] distance at which configurations count as different


@pytree
class Closer:
    """A closer look at the goal."""

    policy: VisualPolicy  # with the larger goal; only its loss is used
    q_start: jax.Array  # (D,)
    prior: jax.Array  # () loss that a radian away from the start costs


@dataclasses.dataclass(frozen=True, kw_only=True)
class Polishing:
    """How configurations are polished."""

    closer: Closer
    goal_loss: float  # that counts as matched there
    slack: float  # how much loss the first spread of samples may add, to second order
    reach: float  # how far they spread at most [rad]
    lanes: int  # samples of each configuration, itself and half a turn among them
    kept: int  # distinct configurations that leave a round
    rounds: int  # of spreading and descending, each with a third of the slack of the one before
    steps: int  # that a round descends


class _Look(NamedTuple):
    """What is seen of n configurations."""

    q: np.ndarray  # (n, D)
    loss: np.ndarray  # (n,) of the image alone
    cost: np.ndarray  # (n,) and with the prior
    matrix: np.ndarray  # (n, D, D) of Gauss and Newton, half of the cost's second derivatives
    slope: np.ndarray  # (n, D) half of its first
    free: np.ndarray  # (n,) bool


def polish(
    world: World, polishing: Polishing, q: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Spread configurations (H, D) and descend.

    Returns:
        Distinct configurations (at most kept, D), best first, and their image losses; infinite in
        collision.
    """
    rng = np.random.default_rng(seed)
    kept = _look(world, polishing, q)
    for k in range(polishing.rounds):
        samples = _spread(kept, polishing, polishing.slack / 3.0**k, rng)
        cost = _in_blocks(glance, world, polishing, samples, GLANCES)[0]
        best = _look(world, polishing, samples[np.argsort(cost, kind="stable")[:LANES]])
        best = _descend(world, polishing, best, polishing.steps)
        kept = _rows(best, _distinct(world, best, polishing.kept))
    kept = _rows(kept, np.argsort(np.where(kept.free, kept.cost, np.inf), kind="stable"))
    return kept.q, np.where(kept.free, kept.loss, np.inf)


def _rows(look: _Look, rows: np.ndarray) -> _Look:
    return _Look(*(column[rows] for column in look))


def _distinct(world: World, look: _Look, num: int) -> np.ndarray:
    """Rows (at most num,) by rising cost, of those that are near each other only the first."""
    kept: list[int] = []
    for k in np.argsort(look.cost, kind="stable"):
        if np.all(apart(world, look.q[kept], look.q[k]) > DISTINCT):
            kept.append(k)
    return np.array(kept[:num])


def apart(world: World, q: np.ndarray, q_other: np.ndarray) -> np.ndarray:
    """Distances (n,) of configurations (n, D) from another (D,), the short way round."""
    step = q - q_other
    turns = np.round(step / (2 * np.pi)) * np.asarray(world.wraps)
    return np.linalg.norm(step - 2 * np.pi * turns, axis=1)


def _spread(
    near: _Look, polishing: Polishing, slack: float, rng: np.random.Generator
) -> np.ndarray:
    """Samples (H * lanes, D) along the directions that the image tells little about."""
    values, vectors = np.linalg.eigh(2.0 * near.matrix)  # rising
    reach = np.minimum(np.sqrt(2.0 * slack / np.maximum(values, 1e-9)), polishing.reach)
    num, joints = polishing.lanes - 2, near.q.shape[1]
    along = OTHERS * rng.normal(size=(len(near.q), num, joints))
    along[:, :, 0] = np.linspace(-1.0, 1.0, num)
    samples = near.q[:, None] + np.einsum("hij,hlj->hli", vectors, reach[:, None] * along)
    # Grippers look alike after half a turn of the last joint.
    turned = near.q.copy()
    turned[:, -1] += np.where(near.q[:, -1] > 0, -np.pi, np.pi)
    return np.concatenate([near.q[:, None], turned[:, None], samples], axis=1).reshape(-1, joints)


def _descend(world: World, polishing: Polishing, now: _Look, steps: int) -> _Look:
    """Levenberg-Marquardt: steps that lower the cost; those that do not raise the damping."""
    damping = np.full(len(now.q), 1e-3)
    for _ in range(steps):
        diagonal = np.einsum("nii->ni", now.matrix)
        ridge = damping[:, None] * diagonal + RIDGE
        matrix = now.matrix + ridge[:, :, None] * np.eye(now.q.shape[1])
        change = -np.linalg.solve(matrix, now.slope[..., None])[..., 0]
        tried = _look(world, polishing, now.q + np.clip(change, -LONGEST, LONGEST))
        better = tried.cost < now.cost
        damping *= np.where(better, 0.3, 4.0)
        now = _Look(
            *(
                np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(tried, now, strict=True)
            )
        )
    return now


def _look(world: World, polishing: Polishing, q: np.ndarray) -> _Look:
    """Look at configurations (n, D)."""
    return _Look(*_in_blocks(look_at, world, polishing, q, LANES))


def _in_blocks(
    function: Callable, world: World, polishing: Polishing, q: np.ndarray, size: int
) -> list[np.ndarray]:
    """Arrays (n, ...) about configurations (n, D), a few at a time: one program serves any n."""
    blocks = -(-len(q) // size)
    padded = np.resize(q, (blocks * size, q.shape[1])).astype(np.float32)
    seen = [function(world, polishing.closer, block) for block in np.split(padded, blocks)]
    return [np.concatenate(column)[: len(q)] for column in zip(*jax.device_get(seen), strict=True)]


@jax.jit
def glance(world: World, closer: Closer, q: jax.Array) -> tuple[jax.Array]:
    """The cost alone (n,), see :class:`_Look`."""
    q = into_limits(world, q)
    loss = map_lanes(lambda q: closer.policy.loss(world, q), q)
    away = difference(world, closer.q_start, q)
    return (loss + closer.prior * jnp.sum(away**2, axis=1),)


@jax.jit
def look_at(world: World, closer: Closer, q: jax.Array) -> tuple[jax.Array, ...]:
    """Columns of a :class:`_Look`; derivatives are finite differences."""
    policy, joints = closer.policy, q.shape[1]
    q = into_limits(world, q)
    places = q[:, None] + PROBE * jnp.eye(joints + 1, joints, -1)

    def image(q):
        return weighted_image(
            world.chain, policy.splats, policy.cameras, policy.goal, q, policy.windows
        )

    images = map_lanes(image, places.reshape(-1, joints)).reshape(len(q), joints + 1, -1)
    residual = images[:, 0] - weighted_goal(policy.goal)
    jacobian = (images[:, 1:] - images[:, :1]) / PROBE
    away = difference(world, closer.q_start, q)
    loss = jnp.sum(residual**2, axis=1)
    return (
        q,
        loss,
        loss + closer.prior * jnp.sum(away**2, axis=1),
        jnp.einsum("nip,njp->nij", jacobian, jacobian) + closer.prior * jnp.eye(joints),
        jnp.einsum("nip,np->ni", jacobian, residual) + closer.prior * away,
        jax.vmap(is_free, (None, 0))(world, q),
    )
