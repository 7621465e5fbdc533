"""Levenberg-Marquardt on images: few joints, so that forward renders suffice for derivatives.

Far from a minimum every step asks for derivatives anew. Near one they hardly change: a step then
costs one render, and not one more for each joint.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.compiling import host_jit
from vrrt_jax.core.edges import difference, enforce_bounds
from vrrt_jax.core.parallel import map_on_threads
from vrrt_jax.core.types import pytree
from vrrt_jax.scene.world import World
from vrrt_jax.splat.lanes import map_lanes

EVALUATE_BATCH = 8  # configurations whose cost alone is asked for, in one call
FD_STEP = 2e-4  # [rad] step of the finite differences; longer ones lose the weak directions
RIDGE = 1e-7  # keeps joints that no pixel sees where they are
MAX_STEP = 0.3  # [rad] of one step of a joint
DAMPING = 1e-3  # at first, in units of the diagonal
NEAR_DAMPING = 1e-4  # the same near a minimum, where weak directions are to be followed too
LESS, MORE = 0.3, 4.0  # times as much damping after a step that lowers the cost, and after others
PAYS = 0.01  # share of the cost; steps that save less are idle
IDLE_STEPS = 2  # in a row, after which a configuration is left
FEWEST = 8  # configurations that go on, if there are as many


@pytree
class Parabola:
    """A cost around a configuration: ``cost + step @ (2 * slope + matrix @ step)``."""

    q: jax.Array  # (D,)
    cost: jax.Array  # ()
    slope: jax.Array  # (D,) half of its first derivatives
    matrix: jax.Array  # (D, D) half of its second derivatives

    def at(self, world: World, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The cost () at a configuration (D,), and half of its derivatives (D,)."""
        step = difference(world, self.q, q)
        bent = self.matrix @ step
        return self.cost + step @ (bent + 2 * self.slope), bent + self.slope


@pytree
class Objective:
    """What is minimized: the loss of a goal, times a weight, and a parabola."""

    goal: Any  # a LeastSquaresGoal
    weight: jax.Array  # ()
    prior: Parabola


class Ends(NamedTuple):
    """Configurations, their cost, and a parabola around each."""

    q: np.ndarray  # (n, D)
    loss: np.ndarray  # (n,) of the goal alone
    cost: np.ndarray  # (n,) with the prior
    slope: np.ndarray  # (n, D)
    matrix: np.ndarray  # (n, D, D) of Gauss and Newton
    free: np.ndarray  # (n,) bool

    def take(self, rows: Any) -> "Ends":
        """The same of some configurations."""
        return Ends(*(column[rows] for column in self))


def descend(world: World, objective: Objective, q: np.ndarray, steps: int) -> Ends:
    """Levenberg-Marquardt from configurations (n, D): steps that lower the cost.

    Others raise the damping. A configuration whose steps hardly pay any more is left where it is,
    and with every step the worse half of all.
    """
    now = derivatives(world, objective, q)
    damping, idle = np.full(len(now.q), DAMPING), np.zeros(len(now.q), int)
    for step in range(steps):
        rows = np.flatnonzero(idle < IDLE_STEPS)
        rows = rows[np.argsort(now.cost[rows], kind="stable")[: max(len(q) >> step, FEWEST)]]
        if not len(rows):
            break
        # Solve the damped normal equations of every configuration that goes on.
        old = now.take(rows)
        ridge = damping[rows, None] * np.einsum("nii->ni", old.matrix) + RIDGE
        matrix = old.matrix + ridge[:, :, None] * np.eye(now.q.shape[1])
        change = -np.linalg.solve(matrix, old.slope[..., None])[..., 0]
        tried = derivatives(world, objective, old.q + np.clip(change, -MAX_STEP, MAX_STEP))
        # Take what is better; elsewhere go on from where it was, with shorter steps.
        better = tried.cost < old.cost
        damping[rows] *= np.where(better, LESS, MORE)
        idle[rows] = np.where(tried.cost < (1 - PAYS) * old.cost, 0, idle[rows] + 1)
        for column, new in zip(now, tried, strict=True):
            column[rows[better]] = new[better]
    return now


def derivatives(world: World, objective: Objective, q: np.ndarray) -> Ends:
    """Configurations (n, D) as they are, inside the limits."""
    return _each(lambda q: linearize(world, objective, q), np.asarray(q, np.float32))


def settle_each(world: World, objectives: list[Objective], q: np.ndarray, steps: int) -> Ends:
    """Each of configurations (n, D) near its minimum, see :func:`settle`."""
    items = zip(objectives, q, strict=True)
    return _each(lambda item: settle(world, *item, jnp.int32(steps)), items)


def _each(program: Callable, items: Iterable[Any]) -> Ends:
    """Ends of a program that makes one of each item."""
    found = map_on_threads(program, items)
    return Ends(*(np.stack(column) for column in zip(*found, strict=True)))


def evaluate_each(world: World, objective: Objective, q: np.ndarray) -> list[np.ndarray]:
    """Loss (n,) of the goal and cost (n,) at configurations (n, D)."""
    # A few at a time: one program serves any number.
    batches = -(-len(q) // EVALUATE_BATCH)
    padded = np.resize(q, (batches * EVALUATE_BATCH, q.shape[1])).astype(np.float32)
    found = map_on_threads(
        lambda batch: evaluate(world, objective, batch), np.split(padded, batches)
    )
    return [np.concatenate(column)[: len(q)] for column in zip(*found, strict=True)]


@host_jit
def evaluate(world: World, objective: Objective, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Loss (n,) of the goal and cost (n,) at configurations (n, D)."""
    q = enforce_bounds(world, q)
    loss = map_lanes(lambda q: objective.goal.loss(world, q), q)
    prior, _ = jax.vmap(lambda q: objective.prior.at(world, q))(q)
    return loss, objective.weight * loss + prior


@host_jit
def linearize(world: World, objective: Objective, q: jax.Array) -> tuple[jax.Array, ...]:
    """A row of :class:`Ends` at a configuration (D,); derivatives are finite differences.

    One at a time: the images of several and of their differences are more than the caches hold.
    """
    q = enforce_bounds(world, q)
    seen, jacobian = _prediction(world, objective, q)
    weight = objective.weight
    residual = seen - objective.goal.target()
    loss = jnp.sum(residual**2)
    prior, slope = objective.prior.at(world, q)
    return (
        q,
        loss,
        weight * loss + prior,
        weight * jacobian @ residual + slope,
        weight * jacobian @ jacobian.T + objective.prior.matrix,
        world.is_free(q),
    )


@host_jit
def settle(
    world: World, objective: Objective, q: jax.Array, steps: jax.Array
) -> tuple[jax.Array, ...]:
    """Levenberg-Marquardt with the derivatives of where it begins, for few joints near a minimum.

    Args:
        world: robot and obstacles.
        objective: what is minimized.
        q: (D,).
        steps: () i32 at most so many.

    Returns:
        A row of :class:`Ends`; its slope is that of the first derivatives.
    """
    q = enforce_bounds(world, q)
    seen, jacobian = _prediction(world, objective, q)
    target, weight = objective.goal.target(), objective.weight
    matrix = weight * jacobian @ jacobian.T + objective.prior.matrix
    diagonal = jnp.diag(matrix)

    def place(q: jax.Array, seen: jax.Array) -> tuple[jax.Array, ...]:
        residual = seen - target
        loss = jnp.sum(residual**2)
        prior, slope = objective.prior.at(world, q)
        return q, loss, weight * loss + prior, weight * jacobian @ residual + slope

    def goes_on(state: tuple) -> jax.Array:
        _, _, idle, step = state
        return (idle < IDLE_STEPS) & (step < steps)

    def try_step(state: tuple) -> tuple:
        now, damping, idle, step = state
        q, _, cost, slope = now
        change = -jnp.linalg.solve(matrix + jnp.diag(damping * diagonal + RIDGE), slope)
        q = enforce_bounds(world, q + jnp.clip(change, -MAX_STEP, MAX_STEP))
        tried = place(q, objective.goal.prediction(world, q))
        better = tried[2] < cost
        idle = jnp.where(tried[2] < (1 - PAYS) * cost, 0, idle + 1)
        now = jax.tree.map(lambda a, b: jnp.where(better, a, b), tried, now)
        return now, damping * jnp.where(better, LESS, MORE), idle, step + 1

    first = place(q, seen), jnp.float32(NEAR_DAMPING), jnp.int32(0), jnp.int32(0)
    (q, loss, cost, slope), *_ = jax.lax.while_loop(goes_on, try_step, first)
    return q, loss, cost, slope, matrix, world.is_free(q)


def _prediction(world: World, objective: Objective, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The prediction (M,) of a configuration (D,), and its derivatives (D, M)."""
    joints = len(q)
    places = q + FD_STEP * jnp.eye(joints + 1, joints, -1)
    seen = map_lanes(lambda q: objective.goal.prediction(world, q), places)
    return seen[0], (seen[1:] - seen[0]) / FD_STEP
