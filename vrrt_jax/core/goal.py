"""Goals that the kernel knows, and the base of those that are fitted by least squares."""

from typing import Any

import jax
import jax.numpy as jnp

from vrrt_jax.core.edges import difference
from vrrt_jax.core.types import pytree

REACHED = 1e-4  # [rad] a path that ends this near to a joint goal ends there


@pytree
class ConfigurationGoal:
    """A joint goal. The loss is the length of the edge to it."""

    q: Any  # (D,) [rad] or [m]
    threshold: Any = REACHED  # () [rad]

    def loss(self, world: Any, q: jax.Array) -> jax.Array:
        """Distance () of a configuration (D,)."""
        return world.distance(q, self.q)

    def residual(self, world: Any, q: jax.Array) -> jax.Array:
        """Step (D,) from the goal to a configuration (D,)."""
        return difference(world, self.q, q)


class LeastSquaresGoal:
    """Base of goals whose loss is a sum of squares: ``loss = sum(residual ** 2)``.

    A subclass overrides ``loss`` or ``residual`` and gets the other. Gradients descend on the
    loss, Levenberg-Marquardt on the residual, so that both see what was overridden. A subclass is
    a pytree as well: decorate it with :func:`~vrrt_jax.core.types.pytree`.

    A residual that is a prediction less a target may override these two instead: differences of
    predictions keep the low bits that a subtraction of the target would cost.
    """

    def __init_subclass__(cls, **kwargs: Any):
        """Derive what a subclass leaves out."""
        super().__init_subclass__(**kwargs)
        own = vars(cls)
        if "prediction" in own:
            cls.residual = own.get("residual", _prediction_less_target)
        elif "residual" in own:
            cls.prediction, cls.target = own["residual"], _no_target
        elif "loss" in own:
            cls.prediction, cls.target = _root_of_loss, _no_target
            cls.residual = _root_of_loss
        if "loss" not in own and cls.residual is not LeastSquaresGoal.residual:
            cls.loss = own.get("loss", _sum_of_squares)

    def loss(self, world: Any, q: jax.Array) -> jax.Array:
        """How far a configuration (D,) is from the goal, ()."""
        raise NotImplementedError("a goal overrides loss or residual")

    def residual(self, world: Any, q: jax.Array) -> jax.Array:
        """Errors (M,) of a configuration (D,)."""
        raise NotImplementedError("a goal overrides loss or residual")

    def prediction(self, world: Any, q: jax.Array) -> jax.Array:
        """What a configuration (D,) looks like to the goal, (M,)."""
        raise NotImplementedError("a goal overrides loss or residual")

    def target(self) -> jax.Array:
        """What it should look like, (M,)."""
        raise NotImplementedError("a goal overrides loss or residual")


def _prediction_less_target(self: LeastSquaresGoal, world: Any, q: jax.Array) -> jax.Array:
    return self.prediction(world, q) - self.target()


def _no_target(self: LeastSquaresGoal) -> jax.Array:
    return jnp.zeros(())


def _root_of_loss(self: LeastSquaresGoal, world: Any, q: jax.Array) -> jax.Array:
    """One error (1,) whose square is the loss."""
    return jnp.sqrt(jnp.maximum(self.loss(world, q), 1e-20))[None]


def _sum_of_squares(self: LeastSquaresGoal, world: Any, q: jax.Array) -> jax.Array:
    return jnp.sum(self.residual(world, q) ** 2)
