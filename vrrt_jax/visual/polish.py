"""Tell apart what a small image cannot: matched configurations, looked at more closely.

Many configurations look nearly like the goal: half a turn of a gripper, another elbow, a wrist that
makes up for another. Each is a valley of the loss of its own, which gradients do not leave. So
samples spread widely around the best nodes of a search, with some joints moved and others not, and
all descend by Levenberg-Marquardt, for which with few joints forward renders suffice. The distinct
ends start the next round. The last of them descend on a larger image with more splats, which tells
what the small one does not, and then on a close-up of the hand beside it, where half a turn becomes
visible. What no image tells stays near the start: a weak prior sees to that.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.edges import difference, enforce_bounds
from vrrt_jax.core.parallel import map_on_threads
from vrrt_jax.core.types import pytree
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.scene.world import World, is_free
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.images import cut_goal
from vrrt_jax.splat.lanes import map_lanes
from vrrt_jax.splat.loss import weighted_goal, weighted_image
from vrrt_jax.splat.types import Camera, SplatModel
from vrrt_jax.visual.policy import VisualPolicy

LOOKS = 4  # configurations looked at in one call: with their differences, a batch of renders
CLOSE_LOOKS = 2  # the same at a close-up: few ends are left, and each core takes some
GLANCES = 32  # configurations whose cost alone is asked for, in one call
PROBE = 2e-4  # [rad] step of the finite differences; longer ones lose the weak directions
RIDGE = 1e-7  # keeps joints that no pixel sees where they are
LONGEST = 0.3  # [rad] of one step of a joint
FEWEST_MOVED = 0.2  # share of its joints that a sample moves, at least, on average
TURNS = 12  # in which the last joint goes all the way round
NARROWER = 0.5  # how far samples spread in a round, in units of the round before
LEAST_COVERED = 0.01  # share of a close-up; a hand that is hidden tells nothing
DISTINCT = 0.3  # [rad] distance at which configurations count as different


@pytree
class Closer:
    """A look at the goal."""

    policy: VisualPolicy  # only its loss is used
    q_start: jax.Array  # (D,)
    prior: jax.Array  # () loss that a radian away from the start costs


@dataclasses.dataclass(frozen=True, kw_only=True)
class CloseUp:
    """How to look at the outermost link alone, in full detail."""

    policy: VisualPolicy  # only its loss is used; it sees whole images, of which a part is cut
    px: int  # height and width of the part
    match_threshold: float  # loss of a match, in units of the part's covered share


@dataclasses.dataclass(frozen=True, kw_only=True)
class Polishing:
    """How configurations are polished."""

    coarse: Closer  # samples descend on this image
    fine: Closer  # and the last of them on this one
    close_up: CloseUp | None  # and their hands at last here
    coarse_goal_loss: float  # that counts as matched on the coarse image
    goal_loss: float  # and on the fine one
    samples: int  # of a round, in all
    lanes: int  # best of them, which descend
    kept: int  # distinct configurations that leave a round
    rounds: int  # of spreading and descending, each less widely; twice as many if nothing matches
    spread: float  # standard deviation of a joint that moves, in the first round [rad]
    steps: int  # that each descends, in every round and on the fine image


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
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spread configurations (H, D) and descend.

    Returns:
        Distinct configurations (at most kept, D), best first; their losses on the fine image; and
        their costs, those of a close-up included, infinite in collision.
    """
    rng = np.random.default_rng(seed)
    coarse, fine, steps = polishing.coarse, polishing.fine, polishing.steps
    for k in range(2 * polishing.rounds):
        spread = polishing.spread * NARROWER ** min(k, polishing.rounds - 1)
        samples = _spread(q, _last_hinge(world), polishing.samples, spread, rng)
        cost = _in_blocks(glance, world, coarse, samples, GLANCES)[0]
        best = samples[np.argsort(cost, kind="stable")[: polishing.lanes]]
        ends = _descend(lambda q: _look(world, coarse, q), best, steps)
        kept = _distinct(world, ends, polishing.kept)
        q, matched = kept.q, np.any(kept.free & (kept.cost <= polishing.coarse_goal_loss))
        if matched and k + 1 >= polishing.rounds:
            break
    turned = _turned(world, fine, q, polishing.kept)
    ends = _descend(lambda q: _look(world, fine, q), turned, steps)
    kept = _distinct(world, ends, polishing.kept)
    loss = kept.loss
    if polishing.close_up is not None:
        ends = _descend_closely(world, polishing, polishing.close_up, kept)
        kept = _distinct(world, ends, polishing.kept)
        loss = _look(world, fine, kept.q).loss
    return kept.q, loss, np.where(kept.free, kept.cost, np.inf)


def _distinct(world: World, look: _Look, num: int) -> _Look:
    """At most num, the free ones first and by rising cost; of near ones only the first."""
    rows: list[int] = []
    for k in np.lexsort([look.cost, ~look.free]):
        if np.all(apart(world, look.q[rows], look.q[k]) > DISTINCT):
            rows.append(k)
    return _Look(*(column[rows[:num]] for column in look))


def apart(world: World, q: np.ndarray, q_other: np.ndarray) -> np.ndarray:
    """Distances (n,) of configurations (n, D) from another (D,), the short way round."""
    return np.linalg.norm(_steps(world, q_other, q), axis=1)


def _steps(world: World, q_from: np.ndarray, q_to: np.ndarray) -> np.ndarray:
    """From configurations (n, D) to others, the short way round."""
    step = q_to - q_from
    return step - 2 * np.pi * np.round(step / (2 * np.pi)) * np.asarray(world.is_continuous)


def _last_hinge(world: World) -> int:
    """The joint that turns the hand, behind which there may be sliding fingers."""
    hinges = np.flatnonzero(~np.any(np.asarray(world.chain.slide), axis=(1, 2)))
    return int(hinges[-1]) if len(hinges) else -1


def _spread(
    q: np.ndarray, hinge: int, num: int, spread: float, rng: np.random.Generator
) -> np.ndarray:
    """Samples (num, D) around configurations (H, D), which are the first of them."""
    # Grippers look alike after half a turn of the last joint.
    turned = q.copy()
    turned[:, hinge] += np.where(q[:, hinge] > 0, -np.pi, np.pi)
    shape = (-(-num // len(q)), *q.shape)
    moved = rng.uniform(size=shape) < rng.uniform(FEWEST_MOVED, 1.0, (*shape[:2], 1))
    around = q + spread * moved * rng.normal(size=shape)
    return np.concatenate([q, turned, around.reshape(-1, q.shape[1])])[:num]


def _turned(world: World, closer: Closer, q: np.ndarray, num: int) -> np.ndarray:
    """The best (at most num, D) of configurations (H, D) and their minima over the last joint.

    Its turn is what images tell least: a gripper spins about its axis and hardly changes.
    """
    joints = q.shape[1]
    turn = 2 * np.pi / TURNS * np.arange(TURNS)
    around = (q[:, None] + turn[:, None] * np.eye(joints)[_last_hinge(world)]).reshape(-1, joints)
    cost = _in_blocks(glance, world, closer, around, GLANCES)[0].reshape(-1, TURNS)
    allowed = (cost < np.roll(cost, 1, axis=1)) & (cost <= np.roll(cost, -1, axis=1))
    allowed[:, 0] = True
    order = np.argsort(np.where(allowed, cost, np.inf), axis=None, kind="stable")
    return around[order[: min(num, np.sum(allowed))]]


def _descend_closely(world: World, polishing: Polishing, close_up: CloseUp, ends: _Look) -> _Look:
    """Descend on the fine image and a close-up of the first one's hand together.

    The cost is the sum of both; the fine image's is taken for the parabola that it is around ends.
    """
    closer, goal_loss = _at_hand(world, polishing.fine, close_up, ends.q[0])
    weight = polishing.goal_loss / goal_loss

    def look(q: np.ndarray) -> _Look:
        near = _look(world, closer, q, CLOSE_LOOKS)
        step = _steps(world, ends.q, near.q)
        bent = np.einsum("nij,nj->ni", ends.matrix, step)
        return near._replace(
            cost=ends.cost + np.sum(step * (bent + 2 * ends.slope), axis=1) + weight * near.loss,
            matrix=ends.matrix + weight * near.matrix,
            slope=ends.slope + bent + weight * near.slope,
        )

    return _descend(look, ends.q, polishing.steps)


def _at_hand(world: World, fine: Closer, close_up: CloseUp, q: np.ndarray) -> tuple[Closer, float]:
    """A close-up of the hand that a configuration (D,) has, and the loss of a match there."""
    whole = close_up.policy
    middle = np.asarray(_hand_px(world, whole.splats, whole.cameras, q))
    goal, cameras = cut_goal(whole.goal, whole.cameras, middle, close_up.px)
    # The fewer of its pixels are known, the less it says.
    known = max(float(np.mean(goal.valid)), 1e-6)
    covered = float(np.mean(goal.valid * goal.alpha)) / known
    policy = dataclasses.replace(whole, goal=goal, cameras=cameras)
    closer = dataclasses.replace(fine, policy=policy, prior=jnp.float32(0))
    return closer, close_up.match_threshold * max(covered, LEAST_COVERED) / known


@jax.jit
def _hand_px(world: World, splats: SplatModel, cameras: Camera, q: jax.Array) -> jax.Array:
    """Where (V, 2) the middle of the last link is in V views [px]."""
    last = splats.link == splats.link[-1]
    middle = jnp.sum(last[:, None] * splats.mean, axis=0) / jnp.sum(last)
    pose = link_poses(world.chain, q)[splats.link[-1]]
    return jax.vmap(project, (0, None))(cameras, pose[:3, :3] @ middle + pose[:3, 3])[0]


def _descend(look: Callable[[np.ndarray], _Look], q: np.ndarray, steps: int) -> _Look:
    """Levenberg-Marquardt: steps that lower the cost; those that do not raise the damping."""
    now = look(q)
    damping = np.full(len(now.q), 1e-3)
    for _ in range(steps):
        diagonal = np.einsum("nii->ni", now.matrix)
        ridge = damping[:, None] * diagonal + RIDGE
        matrix = now.matrix + ridge[:, :, None] * np.eye(now.q.shape[1])
        change = -np.linalg.solve(matrix, now.slope[..., None])[..., 0]
        tried = look(now.q + np.clip(change, -LONGEST, LONGEST))
        better = tried.cost < now.cost
        damping *= np.where(better, 0.3, 4.0)
        now = _Look(
            *(
                np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(tried, now, strict=True)
            )
        )
    return now


def _look(world: World, closer: Closer, q: np.ndarray, size: int = LOOKS) -> _Look:
    """Look at configurations (n, D)."""
    return _Look(*_in_blocks(look_at, world, closer, q, size))


def _in_blocks(
    function: Callable, world: World, closer: Closer, q: np.ndarray, size: int
) -> list[np.ndarray]:
    """Arrays (n, ...) about configurations (n, D), a few at a time: one program serves any n."""
    blocks = -(-len(q) // size)
    padded = np.resize(q, (blocks * size, q.shape[1])).astype(np.float32)
    seen = map_on_threads(lambda block: function(world, closer, block), np.split(padded, blocks))
    return [np.concatenate(column)[: len(q)] for column in zip(*seen, strict=True)]


@jax.jit
def glance(world: World, closer: Closer, q: jax.Array) -> tuple[jax.Array]:
    """The cost alone (n,), see :class:`_Look`."""
    q = enforce_bounds(world, q)
    loss = map_lanes(lambda q: closer.policy.loss(world, q), q)
    away = difference(world, closer.q_start, q)
    return (loss + closer.prior * jnp.sum(away**2, axis=1),)


@jax.jit
def look_at(world: World, closer: Closer, q: jax.Array) -> tuple[jax.Array, ...]:
    """Columns of a :class:`_Look`; derivatives are finite differences."""
    policy, joints = closer.policy, q.shape[1]
    q = enforce_bounds(world, q)
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
