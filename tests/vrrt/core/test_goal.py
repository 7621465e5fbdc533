"""Goals fitted by least squares: what a subclass overrides, and what it gets."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from vrrt_jax.core.goal import ConfigurationGoal, LeastSquaresGoal
from vrrt_jax.core.types import pytree

Q, PLACE = jnp.array([0.3, -0.4]), jnp.array([0.6, -0.8])  # 0.5 apart


@pytree
class ByResidual(LeastSquaresGoal):
    place: jax.Array
    threshold: Any = 1e-4

    def residual(self, world, q):
        return q - self.place


class ByPrediction(ByResidual):
    def prediction(self, world, q):
        return 2.0 * q

    def target(self):
        return 2.0 * self.place


class ByBoth(ByResidual):
    def loss(self, world, q):
        return jnp.sum((q - self.place) ** 2)

    def prediction(self, world, q):
        return q

    def target(self):
        return self.place


class OnlyAField(ByBoth):
    weight: Any = 3.0


class MoreResidual(ByBoth):
    def residual(self, world, q):
        return 3.0 * super().residual(world, q)


class HalfOfDerived(ByResidual):
    def loss(self, world, q):
        return 0.5 * super().loss(world, q)


class HalfOfHalf(HalfOfDerived):
    def loss(self, world, q):
        return 0.5 * super().loss(world, q)


class ResidualOverLoss(HalfOfDerived):
    def residual(self, world, q):
        return 2.0 * super().residual(world, q)


class HalfLoss:
    """Mixed in, it comes before the goal's own loss."""

    def loss(self, world, q):
        return 0.5 * super().loss(world, q)  # type: ignore[misc]


class Mixed(HalfLoss, ByBoth):
    pass


@pytest.mark.parametrize(
    "kind, loss",
    [
        (ByResidual, 0.25),
        (ByPrediction, 1.0),
        (ByBoth, 0.25),
        (OnlyAField, 0.25),
        (MoreResidual, 9 * 0.25),
        (HalfOfDerived, 0.125),
        (HalfOfHalf, 0.0625),
        (ResidualOverLoss, 4 * 0.125),
        (Mixed, 0.125),
    ],
)
def test_loss_residual_and_prediction_agree(kind, loss):
    goal = kind(place=PLACE)
    assert float(goal.loss(None, Q)) == pytest.approx(loss, rel=1e-5)
    assert float(jnp.sum(goal.residual(None, Q) ** 2)) == pytest.approx(loss, rel=1e-5)
    difference = goal.prediction(None, Q) - goal.target()
    assert float(jnp.sum(difference**2)) == pytest.approx(loss, rel=1e-5)
    slope = jax.grad(lambda q: goal.loss(None, q))(Q)
    assert jnp.allclose(slope, 2 * loss / 0.25 * (Q - PLACE), rtol=1e-4)


def test_a_goal_overrides_one_of_them():
    class Nothing(LeastSquaresGoal):
        pass

    with pytest.raises(NotImplementedError, match="a goal overrides loss or residual"):
        Nothing(threshold=0.0).loss(None, Q)


def test_a_joint_goal_measures_the_edge(wall_world):
    q = jnp.linspace(-0.5, 0.5, 7)
    goal = ConfigurationGoal(q=jnp.zeros(7))
    assert float(goal.loss(wall_world, q)) == pytest.approx(float(jnp.linalg.norm(q)), rel=1e-6)
    assert jnp.allclose(goal.residual(wall_world, q), q)
