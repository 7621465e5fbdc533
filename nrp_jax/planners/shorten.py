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


def accepted(
    world: Space,
    path: np.ndarray,
    short: np.ndarray,
    accept: Callable[[np.ndarray], bool],
    *,
    key: jax.Array,
    halvings: int = 3,
) -> np.ndarray | None:
    """A shortened path (P', D) if it is accepted; else the path (P, D), shortened in parts.

    One shortcut that all but touches something would cost the path all others. So halves are
    shortened by themselves, and halves of those that are refused. What cannot be halved stays.

    Args:
        world: the robot in a home.
        path: as it was found.
        short: what :func:`shorten` makes of it.
        accept: whether a part of a path may be kept, such as the exact check.
        key: random key.
        halvings: at most.

    Returns:
        None if a part is refused as it was found.
    """
    if accept(short):
        return short
    if len(path) < 3 or not halvings:
        return path if accept(path) else None
    found, middle = [], len(path) // 2
    for index, part in enumerate((path[: middle + 1], path[middle:])):
        own = jax.random.fold_in(key, index)
        shorter = shorten(world, part, key=own)
        one = accepted(world, part, shorter, accept, key=own, halvings=halvings - 1)
        if one is None:
            return None
        found.append(one)
    return np.concatenate([found[0], found[1][1:]])
