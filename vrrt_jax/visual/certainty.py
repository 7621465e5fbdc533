"""How sure it is that a match is the right pose: a logistic regression on what polishing found.

Its weights were fitted to plans of the packaged robots at tasks, and in lights, of their own; see
``docs/arms_results.md``.
"""

import dataclasses
import math

import numpy as np

LEAST_RATIO = 0.05  # of a loss to its threshold; a lower one says no more
MOST_AHEAD = 10.0  # how many times worse the best rival is; more says no more


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """Of the log odds that a pose is right."""

    constant: float
    loss: float  # times the log of the loss over its threshold
    rival: float  # times the log of the best rival's cost over the pose's
    untold: float  # times the largest uncertainty of a joint [rad] or [m]


WEIGHTS = Weights(constant=-2.1, loss=-3.3, rival=4.3, untold=-0.3)


def features(
    loss: float, threshold: float, cost: np.ndarray, end: int, uncertainty: np.ndarray
) -> tuple[float, float, float]:
    """What the probability of an end depends on.

    Args:
        loss: of the end, on the fine image.
        threshold: loss of a match there.
        cost: (n,) of all distinct ends, infinite in collision.
        end: which of them.
        uncertainty: (D,) how far off each joint of the end may be [rad] or [m].

    Returns:
        The log of the loss over its threshold, the log of the best rival's cost over the end's,
        and the largest uncertainty [rad] or [m].
    """
    rivals = np.delete(cost, end)
    ahead = float(np.min(rivals, initial=np.inf)) / float(cost[end])
    return (
        math.log(max(loss / threshold, LEAST_RATIO)),
        math.log(float(np.clip(ahead, 1.0 / MOST_AHEAD, MOST_AHEAD))),
        float(np.max(uncertainty)),
    )


def match_probability(
    loss: float, threshold: float, cost: np.ndarray, end: int, uncertainty: np.ndarray
) -> float:
    """The probability that an end is the right pose; arguments are those of :func:`features`."""
    over, ahead, untold = features(loss, threshold, cost, end, uncertainty)
    odds = WEIGHTS.constant + WEIGHTS.loss * over + WEIGHTS.rival * ahead + WEIGHTS.untold * untold
    return 1.0 / (1.0 + math.exp(-odds))
