"""Joints that an equality couples: a follower is where a polynomial of its leader puts it."""

import dataclasses
import warnings
from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.polynomial import Polynomial

_TOLERANCE = 1e-6  # [rad] or [m] between where a follower is and where it should be
_REAL = 1e-9  # a root with a smaller imaginary part is real


@dataclasses.dataclass(frozen=True, kw_only=True)
class Coupling:
    """A follower, its leader, and the position of the one as a polynomial of the other's."""

    follower: str
    leader: str | None  # None: the follower stays where it is
    polynomial: Polynomial
    leader_range: tuple[float, float]  # [rad] or [m]
    follower_range: tuple[float, float]  # [rad] or [m]


def couplings(model: mujoco.MjModel) -> list[Coupling]:
    """The active equalities of joints of a model, those of a URDF's ``mimic`` among them."""
    found = []
    for k in range(model.neq):
        if model.eq_type[k] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[k]:
            continue
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        has_leader = leader >= 0
        # MuJoCo counts both positions from those of reference.
        zero, lead = (
            model.qpos0[model.jnt_qposadr[joint]] if joint >= 0 else 0.0
            for joint in (follower, leader)
        )
        polynomial = Polynomial(model.eq_data[k, : 5 if has_leader else 1])
        found.append(
            Coupling(
                follower=model.joint(follower).name,
                leader=model.joint(leader).name if has_leader else None,
                polynomial=polynomial(Polynomial([-lead, 1.0])) + zero,
                leader_range=_range(model, leader) if has_leader else (-np.inf, np.inf),
                follower_range=_range(model, follower),
            )
        )
    return found


def _range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf)
    return float(low), float(high)


def follow(
    model: mujoco.MjModel, home: Mapping[str, float], frozen: Mapping[str, float]
) -> dict[str, float]:
    """Where coupled joints are that are not fixed yet.

    A joint that follows a fixed one is where its polynomial puts it, and a joint that leads a fixed
    one is where the polynomial has that value. Leaders of which nothing is known are at home.

    Args:
        model: with the equalities of the file.
        home: positions of all joints [rad] or [m].
        frozen: positions of the joints that are fixed already [rad] or [m].

    Returns:
        Positions [rad] or [m] of the other coupled joints.

    Raises:
        ValueError: no position of a leader puts its follower where ``frozen`` has it, or one that
            does is out of range.
    """
    pairs = couplings(model)
    followers = [pair.follower for pair in pairs]
    found = dict(frozen)
    while True:
        # What follows from what is known, on and on; then the next leader is put at its home.
        while any([_settle(pair, found, home) for pair in pairs]):
            pass
        unknown = [p.leader for p in pairs if p.leader is not None and p.leader not in found]
        if not unknown:
            break
        first = next((leader for leader in unknown if leader not in followers), unknown[0])
        found[first] = home[first]
    for pair in pairs:
        _check(pair, found, frozen)
    names = dict.fromkeys(n for p in pairs for n in (p.follower, p.leader) if n is not None)
    return {name: found[name] for name in names if name not in frozen}


def _settle(pair: Coupling, found: dict[str, float], home: Mapping[str, float]) -> bool:
    """Whether one of the two positions became known from the other, which is written down."""
    if pair.follower not in found and (pair.leader is None or pair.leader in found):
        at = 0.0 if pair.leader is None else found[pair.leader]
        found[pair.follower] = float(pair.polynomial(at))
        return True
    if pair.leader is None or pair.leader in found or pair.follower not in found:
        return False
    # Where the polynomial has the follower's value: the place in the leader's range near its home.
    roots = (pair.polynomial - found[pair.follower]).roots()
    real = roots[np.abs(np.imag(roots)) < _REAL].real
    low, high = pair.leader_range
    inside = real[(real >= low - _TOLERANCE) & (real <= high + _TOLERANCE)]
    if len(inside):
        nearest = inside[np.abs(inside - home[pair.leader]).argmin()]
        found[pair.leader] = float(np.clip(nearest, low, high))
        return True
    is_constant = np.all(np.abs(pair.polynomial.coef[1:]) < _REAL)
    if is_constant and np.abs(pair.polynomial(0.0) - found[pair.follower]) < _TOLERANCE:
        return False
    raise ValueError(
        f"freeze: joint '{pair.follower}' follows '{pair.leader}' by an equality, and no position "
        f"of '{pair.leader}' in its range, [{low:g}, {high:g}], puts it at "
        f"{found[pair.follower]:g}; freeze '{pair.leader}' instead"
    )


def _check(pair: Coupling, found: Mapping[str, float], frozen: Mapping[str, float]) -> None:
    """Tell where a follower is not where it should be, or out of its range."""
    value, at = found[pair.follower], 0.0 if pair.leader is None else found[pair.leader]
    should = float(pair.polynomial(at))
    if abs(value - should) > _TOLERANCE:
        warnings.warn(
            f"joint '{pair.follower}' is fixed at {value:g}, but the equality with "
            f"'{pair.leader}' at {at:g} would have it at {should:g}; the robot is planned with "
            f"{value:g}",
            stacklevel=5,
        )
    low, high = pair.follower_range
    if not low - _TOLERANCE <= value <= high + _TOLERANCE:
        text = (
            f"joint '{pair.follower}' follows '{pair.leader}' to {value:g}, which is out of its "
            f"range, [{low:g}, {high:g}]"
        )
        if pair.leader in frozen:
            raise ValueError(f"freeze: {text}; freeze '{pair.leader}' elsewhere")
        warnings.warn(f"{text}; freeze '{pair.leader}' where it is inside", stacklevel=5)
