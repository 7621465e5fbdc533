"""A path as wheels and motors see it: how far the base has driven, its heading, and the joints.

Along a piece of a Reeds-Shepp curve, the distance driven, the heading and the arm change in
proportion. So a path is straight lines in these numbers, and limits of wheels and motors hold for
them one by one. Letters: ``P`` waypoints, ``n`` corners, ``T`` configurations, ``D`` joints.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nrp_jax.scene import reeds_shepp
from nrp_jax.scene.exact import STEP
from nrp_jax.scene.grid_world import GridWorld
from nrp_jax.scene.nearest import shifted, working_world
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.shortcut import padded


@single_precision
def odometry(world: GridWorld, path: np.ndarray) -> np.ndarray:
    """The corners (n, D - 1) of a path in the numbers of wheels and motors.

    Args:
        world: the Fetch in a home.
        path: (P, D) waypoints.

    Returns:
        The distance driven [m], negative in reverse, the heading [rad] and the other joints; each
        goes on from the path's start, so that it may pass a whole turn. The curve between two
        waypoints has five pieces at most; those of no length are left out.
    """
    inner, corner = working_world(world)
    local = np.asarray(shifted(path, -corner), np.float32)
    pieces = np.asarray(_pieces(inner, padded(local)))[:, : len(path) - 1]  # (5, P - 1, D - 1)
    steps = np.swapaxes(pieces, 0, 1).reshape(-1, pieces.shape[-1]).astype(float)
    start = np.array([0.0, *np.asarray(path[0], float)[2:]])
    return np.concatenate([start[None], start + np.cumsum(steps[np.any(steps != 0, axis=1)], 0)])


def poses_along(pose: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Poses (n + 1, 3) of the base: where it begins, and at the end of each step.

    Args:
        pose: (3,) at the beginning, x, y [m] and heading [rad].
        steps: (n, 2 or more) distance driven [m] and turn [rad], and what else changes.
    """
    drive, turn = steps[:, 0], steps[:, 1]
    heading = pose[2] + np.append(0.0, np.cumsum(turn))
    # The chord of an arc points in its middle heading.
    chord, middle = drive * np.sinc(turn / (2 * np.pi)), heading[:-1] + turn / 2
    x, y = (np.append(0.0, np.cumsum(chord * f(middle))) for f in (np.cos, np.sin))
    return np.stack([pose[0] + x, pose[1] + y, heading], axis=1)


def configurations_along(q: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Configurations (T, D) along steps, 0.02 m or rad apart at most; undoes :func:`odometry`.

    Args:
        q: (D,) at the beginning.
        steps: (n, D - 1) from one corner to the next.
    """
    parts = np.maximum(np.ceil(np.abs(steps).max(axis=1) / STEP), 1).astype(int)
    fine = np.repeat(steps / parts[:, None], parts, axis=0)
    arm = np.concatenate([q[None, 3:], q[3:] + np.cumsum(fine[:, 2:], axis=0)])
    return np.concatenate([poses_along(q[:3], fine), arm], axis=1)


@jax.jit
def _pieces(world: Any, path: jax.Array) -> jax.Array:
    """Steps (5, P - 1, D - 1) of the pieces of the edges of a path (P, D)."""
    edge = world.edge(path[:-1], path[1:])
    extents = jnp.stack(reeds_shepp.piece_extents(edge.curve, world.radius))
    total = jnp.sum(extents, axis=0)
    # The arm moves along with the extent; where the base stays, all of it in the first piece.
    first = jnp.arange(len(extents))[:, None] == 0
    share = jnp.where(total > 0, extents / jnp.maximum(total, 1e-12), first)
    drive, turn = jnp.stack(edge.curve.drive), jnp.stack(edge.curve.turn)
    base = jnp.stack([drive * world.radius, drive * turn], axis=-1)
    return jnp.concatenate([base, share[..., None] * edge.arm], axis=-1)
