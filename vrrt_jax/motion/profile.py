"""Motion along a line with bounded velocity, acceleration and jerk: double-S profiles.

A motion is a list of phases ``(duration [s], jerk)``. Each speed is reached without acceleration.
"""

from collections.abc import Callable

import numpy as np

Phase = tuple[float, float]  # duration [s] and jerk

_HALVINGS = 60  # of an interval, down to rounding


def largest(holds: Callable[[float], bool], low: float, high: float) -> float:
    """The largest value in an interval for which something holds that holds for the lowest.

    Args:
        holds: true up to some value, false beyond.
        low: where it holds.
        high: end of the interval.
    """
    if holds(high):
        return high
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def change_of_speed(v_from: float, v_to: float, acceleration: float, jerk: float) -> list[Phase]:
    """The quickest change from one speed to another, without acceleration at both ends."""
    change = abs(v_to - v_from)
    jerk_s = min(np.sqrt(change / jerk), acceleration / jerk)
    steady_s = change / (jerk_s * jerk) - jerk_s if change else 0.0
    signed = np.copysign(jerk, v_to - v_from)
    return [(jerk_s, signed), (max(steady_s, 0.0), 0.0), (jerk_s, -signed)]


def change_length(v_from: float, v_to: float, acceleration: float, jerk: float) -> float:
    """The length that :func:`change_of_speed` covers: it is as fast as the mean of its ends."""
    phases = change_of_speed(v_from, v_to, acceleration, jerk)
    return (v_from + v_to) / 2 * sum(duration for duration, _ in phases)


def straight(
    length: float, v_from: float, v_to: float, velocity: float, acceleration: float, jerk: float
) -> list[Phase]:
    """The quickest motion along a length from one speed to another.

    Args:
        length: at least :func:`change_length` of the two speeds.
        v_from: speed at the beginning.
        v_to: speed at the end.
        velocity: largest speed.
        acceleration: largest acceleration.
        jerk: largest jerk.
    """

    def left(peak: float) -> float:
        both = [change_length(v, peak, acceleration, jerk) for v in (v_from, v_to)]
        return length - sum(both)

    # As fast as there is room to become, and then on at that speed.
    peak = largest(lambda v: left(v) >= 0, max(v_from, v_to), velocity)
    steady_s = max(left(peak), 0.0) / peak
    return [
        *change_of_speed(v_from, peak, acceleration, jerk),
        (steady_s, 0.0),
        *change_of_speed(peak, v_to, acceleration, jerk),
    ]


def positions_at(phases: list[Phase], time: np.ndarray) -> np.ndarray:
    """Position, speed, acceleration and jerk (4, n) at some times (n,) of a motion from rest."""
    durations, jerks = np.array(phases).T
    # The state at the beginning of each phase.
    states = np.zeros((len(phases) + 1, 3))
    for k, (t, j) in enumerate(phases):
        s, v, a = states[k]
        states[k + 1] = s + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2), a + t * j
    ends = np.cumsum(durations)
    phase = np.minimum(np.searchsorted(ends, time, side="right"), len(phases) - 1)
    t, j = time - (ends - durations)[phase], jerks[phase]
    s, v, a = states[phase].T
    return np.stack([s + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2), a + t * j, j])
