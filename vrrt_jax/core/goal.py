"""Goals that the kernel knows, and the base of those that are fitted by least squares."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from vrrt_jax.core.edges import difference
from vrrt_jax.core.types import PytreeSubclasses, pytree

REACHED = 1e-4  # [rad] a path that ends this near to a joint goal ends there


@pytree
class ConfigurationGoal:
    """A joint goal, or any of G. The loss is the length of the edge to the nearest."""

    q: Any  # (D,) or (G, D) [rad] or [m]
    threshold: Any = REACHED  # () [rad]

    def loss(self, world: Any, q: jax.Array) -> jax.Array:
        """Distance () of a configuration (D,)."""
        if jnp.ndim(self.q) == 1:
            return world.distance(q, self.q)
        return jnp.min(jax.vmap(world.distance, (None, 0))(q, jnp.asarray(self.q)))

    def residual(self, world: Any, q: jax.Array) -> jax.Array:
        """Step (D,) from the nearest goal to a configuration (D,)."""
        return difference(world, self.nearest(world, q), q)

    def nearest(self, world: Any, q: jax.Array) -> jax.Array:
        """The goal (D,) that is nearest to a configuration (D,)."""
        goals = jnp.atleast_2d(jnp.asarray(self.q))
        return goals[jnp.argmin(jax.vmap(world.distance, (None, 0))(q, goals))]


def starts_at(goal: ConfigurationGoal, world: Any, q_start: Any) -> bool:
    """Whether a plan that starts at ``q_start`` (D,) is at its goal; on the host."""
    far = float(nearest_and_loss(goal, world, q_start)[1])
    return far <= min(float(goal.threshold), REACHED)


@jax.jit
def nearest_and_loss(
    goal: ConfigurationGoal, world: Any, q: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The goal (D,) that is nearest to a configuration (D,), and the loss () there; for the host.

    One program: operation by operation this takes many times as long as it computes.
    """
    return goal.nearest(world, q), goal.loss(world, q)


class LeastSquaresGoal(PytreeSubclasses):
    """Base of goals whose loss is a sum of squares: ``loss = sum(residual ** 2)``.

    A subclass overrides ``loss`` or ``residual`` and gets the other; one that overrides both keeps
    them so. Gradients descend on the loss, Levenberg-Marquardt on the residual, so that both see
    what was overridden.

    A residual that is a prediction less a target may override these two instead: differences of
    predictions keep the low bits that a subtraction of the target would cost.
    """

    threshold: Any  # () the goal is reached by configurations whose loss is at most this

    def __init_subclass__(cls, **kwargs: Any):
        """Derive what a subclass leaves out, from what it overrides last."""
        super().__init_subclass__(**kwargs)
        # The class that overrides any of the three first: this one, or one that is mixed in.
        names = {"loss", "residual", "prediction"}
        owner = next(kind for kind in cls.__mro__ if names & vars(kind).keys())
        if owner is not cls and issubclass(owner, LeastSquaresGoal):
            return  # derived when that class was made
        own = vars(owner)
        if "prediction" in own and "residual" not in own:
            cls.residual = _residual_from_prediction(own["prediction"], cls.target)
        elif "residual" in own:
            cls.prediction, cls.target = own["residual"], _no_target
        elif "loss" in own:
            cls.residual = cls.prediction = _residual_from_loss(own["loss"])
            cls.target = _no_target
        if "loss" not in own and ("residual" in own or "prediction" in own):
            cls.loss = _loss_from_residual(cls.residual)

    def loss(self, world: Any, q: jax.Array) -> jax.Array:
        """How far a configuration (D,) is from the goal, ()."""
        raise NotImplementedError(_NEITHER)

    @property
    def judge(self) -> Any:
        """The goal whose loss tells whether it is reached, where that is not this one's."""
        return self

    def residual(self, world: Any, q: jax.Array) -> jax.Array:
        """Errors (M,) of a configuration (D,)."""
        raise NotImplementedError(_NEITHER)

    def prediction(self, world: Any, q: jax.Array) -> jax.Array:
        """What a configuration (D,) looks like to the goal, (M,)."""
        raise NotImplementedError(_NEITHER)

    def target(self) -> jax.Array:
        """What it should look like, (M,)."""
        raise NotImplementedError(_NEITHER)


_NEITHER = "a goal overrides loss or residual"


# What is derived calls the function of the class that it was derived from, never that of ``self``:
# a subclass may call ``super()`` from either method without going round in circles.
def _residual_from_prediction(prediction: Callable, target: Callable) -> Callable:
    def residual(self: Any, world: Any, q: jax.Array) -> jax.Array:
        return prediction(self, world, q) - target(self)

    return residual


def _residual_from_loss(loss: Callable) -> Callable:
    def residual(self: Any, world: Any, q: jax.Array) -> jax.Array:
        return jnp.sqrt(jnp.maximum(loss(self, world, q), 1e-20))[None]

    return residual


def _loss_from_residual(residual: Callable) -> Callable:
    def loss(self: Any, world: Any, q: jax.Array) -> jax.Array:
        return jnp.sum(residual(self, world, q) ** 2)

    return loss


def _no_target(self: Any) -> jax.Array:
    return jnp.zeros(())
