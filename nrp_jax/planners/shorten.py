"""Shorter paths of few corners, at which a base that drives curves all but stops."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrrt_jax.core.edges import Space
from vrrt_jax.core.shortcut import prune, shortcut


def shorten(world: Space, path: np.ndarray, *, key: jax.Array, **options: Any) -> np.ndarray:
    """Prune a path (P, D), take shortcuts, and prune what they leave.

    Args:
        world: the robot in a home.
        path: free of collisions.
        key: random key.
        options: of :func:`vrrt_jax.core.shortcut.shortcut`.
    """
    return prune(world, shortcut(world, prune(world, path), key=key, **options))


def shorten_parts(
    world: Space,
    path: np.ndarray,
    accept: Callable[[np.ndarray], bool],
    *,
    key: jax.Array,
    how: Callable[..., np.ndarray] = shorten,
    halvings: int = 3,
) -> np.ndarray | None:
    """Shorten the halves of a path (P, D) by themselves, and halves of those that are refused.

    One shortcut that all but touches something would cost the path all others.

    Args:
        world: the robot in a home.
        path: whose shortcuts are refused as a whole.
        accept: whether a part of a path may be kept, such as the exact check.
        key: random key.
        how: what shortens a part.
        halvings: at most; what is refused then stays as it is.

    Returns:
        (P', D); None if a part is refused as it is.
    """
    if len(path) < 3 or not halvings:
        return path if accept(path) else None
    found, middle = [], len(path) // 2
    for index, part in enumerate((path[: middle + 1], path[middle:])):
        own = jax.random.fold_in(key, index)
        one = how(world, part, key=own)
        if not accept(one):
            one = shorten_parts(world, part, accept, key=own, how=how, halvings=halvings - 1)
        if one is None:
            return None
        found.append(one)
    return np.concatenate([found[0], found[1][1:]])
