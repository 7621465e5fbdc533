"""How sure a match is: what raises the probability, and where it ends."""

import numpy as np
import pytest

from vrrt_jax.visual.certainty import match_probability

SURE = {
    "loss": 0.3,
    "colored_loss": 0.6,
    "threshold": 1.0,
    "cost": np.array([1.0, 8.0]),
    "end": 0,
    "uncertainty": np.array([0.1, 0.05]),
}


def probability(**changes):
    return match_probability(**{**SURE, **changes})


def test_a_good_match_far_ahead_is_sure():
    assert probability() > 0.9
    assert probability(cost=np.array([1.0])) >= probability()  # without any rival


@pytest.mark.parametrize(
    "change",
    [
        {"loss": 3.0},
        {"cost": np.array([1.0, 1.05])},
        {"uncertainty": np.array([0.1, 2.0])},
    ],
    ids=["a worse match", "a rival nearly as good", "a joint that may be off"],
)
def test_what_makes_a_match_doubtful(change):
    assert 0.0 < probability(**change) < probability()


def test_rivals_in_collision_are_none():
    assert probability(cost=np.array([1.0, np.inf])) == probability(cost=np.array([1.0]))


def test_what_does_not_match_is_unlikely_without_rivals_too():
    assert probability(loss=1.2, colored_loss=1.5, cost=np.array([1.0])) < 0.1


def test_another_lamp_makes_a_match_no_less_likely():
    shaded = probability(loss=0.3 + 0.4, colored_loss=0.6 + 10 * 0.4)  # colors weigh a tenth
    assert shaded == pytest.approx(probability())
