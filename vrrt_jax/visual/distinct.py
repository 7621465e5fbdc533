"""Configurations that are far enough from each other to count as different."""

from collections.abc import Callable

import numpy as np

from vrrt_jax.core.edges import StraightLineEdges, steps_between

MIN_SEPARATION = 0.3  # [rad] distance at which configurations count as different


def distances_to(world: StraightLineEdges, q: np.ndarray, q_other: np.ndarray) -> np.ndarray:
    """Distances (n,) of configurations (n, D) from another (D,), the short way round."""
    return np.linalg.norm(steps_between(world, q_other, q), axis=1)


def distinct(
    world: StraightLineEdges,
    q: np.ndarray,
    candidates: np.ndarray,
    num: int,
    choose: Callable[[np.ndarray], int] = lambda candidates: int(candidates[0]),
) -> list[int]:
    """At most ``num`` configurations that differ from each other.

    Args:
        world: whose joints they are.
        q: (n, D) configurations.
        candidates: indices of those that may be taken, the best first.
        num: at most so many.
        choose: which of the remaining candidates to take next; the first by default.

    Returns:
        Their indices, in the order in which they were taken.
    """
    taken: list[int] = []
    while len(candidates) and len(taken) < num:
        taken.append(choose(candidates))
        far = distances_to(world, q[candidates], q[taken[-1]]) > MIN_SEPARATION
        candidates = candidates[far]
    return taken
