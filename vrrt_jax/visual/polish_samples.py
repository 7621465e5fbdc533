"""Samples around the best configurations of a search, from which polishing descends."""

import numpy as np

from vrrt_jax.scene.world import World

FEWEST_MOVED = 0.2  # share of its joints that a sample moves, at least, on average
INNER_SPREAD = 0.05  # [rad] of joints that are not drawn anew


def last_hinge(world: World) -> int:
    """The joint that turns the hand, behind which there may be sliding fingers."""
    hinges = np.flatnonzero(world.chain.is_hinge)
    return int(hinges[-1]) if len(hinges) else -1


def nearer_turns(world: World, q: np.ndarray, q_start: np.ndarray) -> np.ndarray:
    """The same poses (n, D), of all turns inside the limits those next to a start (D,).

    Joints such as those of a UR5e have room for two turns, which no image tells apart.
    """
    turned = q - 2 * np.pi * np.round((q - q_start) / (2 * np.pi))
    inside = (turned >= np.asarray(world.lower)) & (turned <= np.asarray(world.upper))
    return np.where(inside & world.chain.is_hinge, turned, q)


def half_turned(world: World, q: np.ndarray) -> np.ndarray:
    """Configurations (n, D) after half a turn of the hand, where many grippers look the same."""
    hinge, turned = last_hinge(world), q.copy()
    turned[:, hinge] += np.where(q[:, hinge] > 0, -np.pi, np.pi)
    return turned


def sample_around(
    world: World, q: np.ndarray, num: int, spread: float, rng: np.random.Generator
) -> np.ndarray:
    """Samples (num, D) around configurations (H, D), which are the first of them."""
    # Each sample moves a random share of its joints.
    shape = (-(-num // len(q)), *q.shape)
    moved = rng.uniform(size=shape) < rng.uniform(FEWEST_MOVED, 1.0, (*shape[:2], 1))
    around = q + spread * moved * rng.normal(size=shape)
    return np.concatenate([q, half_turned(world, q), around.reshape(-1, q.shape[1])])[:num]


def redraw_outer(
    world: World,
    q: np.ndarray,
    num: int,
    rng: np.random.Generator,
    joints: int | None = None,
    spread: float = INNER_SPREAD,
) -> np.ndarray:
    """Samples (num, D): configurations (H, D), of which all joints from one on are drawn anew.

    The outer joints show least, so they are wrong most often. Where the inner ones are right, they
    are few numbers, which random changes of any joints seldom hit.

    Args:
        world: robot and obstacles.
        q: (H, D) configurations.
        num: of samples.
        rng: of the draws.
        joints: at most so many of the last ones are drawn anew; all but the first if None.
        spread: of the others [rad].
    """
    size = q.shape[1]
    anew = rng.uniform(np.asarray(world.lower), np.asarray(world.upper), (num, size))
    first = 1 if joints is None else max(size - joints, 0)
    is_redrawn = np.arange(size) >= rng.integers(first, size, (num, 1))
    kept = np.resize(q, (num, size))
    return np.where(is_redrawn, anew, kept + spread * rng.normal(size=kept.shape))
