"""How far a robot may go on from one configuration before something can touch."""

from collections.abc import Callable

import mujoco
import numpy as np

NEAR = 0.025  # [m] farther pairs of bodies are no contacts: fewer of them cost less to find
FINEST = 5e-4  # [m] two bodies approach each other by no more between two checks, if they are near
_NOTHING = np.zeros(0), np.zeros((0, 2), int)

Near = tuple[np.ndarray, np.ndarray]  # distances (c,) [m] and pairs of bodies (c, 2)


def near_pairs(model: mujoco.MjModel, data: mujoco.MjData, q: np.ndarray) -> Near:
    """Distances and bodies of the pairs that are nearer than the margins of their geoms.

    Args:
        model: whose geoms have the margin ``NEAR / 2``; MuJoCo adds up the two of a pair. How far
            apart shapes are has to be right, see :mod:`vrrt_jax.scene.exact_pairs`.
        data: to compute in.
        q: (D,); negative distances are penetrations.
    """
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    if data.ncon == 0:
        return _NOTHING
    contact = data.contact
    return contact.dist, model.geom_bodyid[contact.geom]


def first_touch(
    near_at: Callable[[np.ndarray], Near],
    lever_arms: np.ndarray,
    q_from: np.ndarray,
    turn: np.ndarray,
    *,
    step: float,
    end: float = 1.0,
    tolerance: float = 0.0,
) -> tuple[float | None, int]:
    """Where on a straight piece of a path two bodies penetrate each other first.

    From a configuration that is free, a pair of bodies may approach by its distance. So far the
    next check goes; but a pair that is nearer than :data:`FINEST` may approach by that. Nothing
    that is deeper than half of it is missed, however thin.

    Args:
        near_at: of q (D,), distances and pairs of bodies nearer than :data:`NEAR`.
        lever_arms: (D, nbody, nbody) from :func:`vrrt_jax.scene.exact_slots.lever_arms`.
        q_from: (D,) where the piece begins.
        turn: (D,) to its end.
        step: longest step that distances do not vouch for, as a share of the piece.
        end: share of the piece at which to stop, itself not checked.
        tolerance: penetrations that are less deep do not count [m].

    Returns:
        The share of the piece, None if it is free, and how many configurations were checked.
    """
    # How fast bodies approach each other at most, (nbody, nbody) [m] on the whole piece.
    speeds = np.tensordot(np.abs(turn), lever_arms, 1) + 1e-9
    far = NEAR / speeds.max()  # what is not near is at least so far away
    at, checked = 0.0, 0
    while at < end:
        distance, bodies = near_at(q_from + at * turn)
        checked += 1
        if len(distance) == 0:
            at += far
            continue
        if distance.min() < -tolerance:
            return at, checked
        own = speeds[bodies[:, 0], bodies[:, 1]]
        span = float((distance / own).min(initial=far))
        if span < step:
            span = min(step, float((np.maximum(distance, FINEST) / own).min(initial=far)))
        at += span
    return None, checked
