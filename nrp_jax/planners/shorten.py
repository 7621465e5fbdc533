"""Shorter paths of few corners, at which a base that drives curves all but stops."""

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
