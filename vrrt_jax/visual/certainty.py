"""How sure it is that a match is the right pose: a logistic regression on what polishing found.

Its weights were fitted to plans of the packaged robots at tasks, and in lights, of their own; see
``docs/arms_results.md``.
"""

import dataclasses
import math

import numpy as np

from vrrt_jax.splat.loss import COLOR_WEIGHT, MATCH_COLOR_WEIGHT

LEAST_RATIO = 0.05  # of a loss to its threshold; a lower one says no more
MOST_AHEAD = 10.0  # how many times worse the best rival is; more says no more


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """Of the log odds that a pose is right."""

    constant: float
    coverage: float  # times the log of the coverage's loss over the threshold
    rival: float  # times the log of the best rival's cost over the pose's
    untold: float  # times the largest uncertainty of a joint [rad] or [m]


WEIGHTS = Weights(constant=-2.8, coverage=-3.1, rival=5.2, untold=-1.0)


def match_probability(
    loss: float,
    colored_loss: float,
    threshold: float,
    cost: np.ndarray,
    end: int,
    uncertainty: np.ndarray,
) -> float:
    """The probability that an end is the right pose.

    It depends on the loss that is left without colors, which no lamp changes, on the best rival's
    cost if the end matches, and on the least certain joint.

    Args:
        loss: of the end, on the fine image.
        colored_loss: the same with colors as they count in a search.
        threshold: loss of a match there.
        cost: (n,) of all distinct ends, infinite in collision.
        end: which of them.
        uncertainty: (D,) how far off each joint of the end may be [rad] or [m].
    """
    # Both losses are the coverage's and so many times the colors'.
    colors = (colored_loss - loss) / (COLOR_WEIGHT - MATCH_COLOR_WEIGHT)
    coverage = loss - MATCH_COLOR_WEIGHT * colors
    rivals = np.delete(cost, end)
    ahead = float(np.min(rivals, initial=np.inf)) / float(cost[end]) if loss <= threshold else 1.0
    odds = (
        WEIGHTS.constant
        + WEIGHTS.coverage * math.log(max(coverage / threshold, LEAST_RATIO))
        + WEIGHTS.rival * math.log(float(np.clip(ahead, 1.0 / MOST_AHEAD, MOST_AHEAD)))
        + WEIGHTS.untold * float(np.max(uncertainty))
    )
    return 1.0 / (1.0 + math.exp(-odds))
