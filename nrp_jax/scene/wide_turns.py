"""Wider turns for a path of wheels and joints: proposals of what could replace a part of it.

A part between two straight lines is replaced by one turn, or by two with a new line in between.
Turns begin as far before their corner as there is room, and their curvature may rise and fall in a
few arcs. A base that turns while it drives need not slow down as on the smallest circle. The arm
moves along. Letters: ``n`` steps, ``k`` new ones, ``D`` joints.
"""

import dataclasses

import numpy as np

# Curvatures of the arcs of a turn, in proportion; all arcs of a turn are equally long.
PROFILES = ((1.0,), (1.0, 2.0, 1.0), (1.0, 2.0, 3.0, 2.0, 1.0))
MOST_TURN = 2.6  # of one corner [rad]
_LEAST_TURN = 1e-4  # [rad]
_SPAN = 12  # steps that are replaced at most
_FARTHER = 0.6  # how often a line is taken, of the one before it
_SPREADS = (0.1, 0.3, 1.0)  # of new corners along their lines, around where they are now [m]
_SHARES = (1.0, 0.7, 0.5, 0.3, 0.2)  # of the room that a turn takes


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Gap:
    """Steps ``first`` to ``last`` (not included), which go from one line to another.

    A line is a straight step, or a pose where the robot stands: then it has no room.
    """

    first: int
    last: int
    gear: float  # 1 ahead, -1 in reverse
    room: np.ndarray  # (2,) lengths of the straight steps before and after [m], or 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Proposal:
    """Steps, some of which are new."""

    before: np.ndarray  # (n, D - 1), the last of which may be shorter than it was
    new: np.ndarray  # (k, D - 1)
    after: np.ndarray  # (n', D - 1), the first of which may be shorter than it was

    @property
    def steps(self) -> np.ndarray:
        """(n + k + n', D - 1) without those of no length."""
        steps = np.concatenate([self.before, self.new, self.after])
        return steps[np.linalg.norm(steps, axis=1) > 1e-6]


def propose(
    steps: np.ndarray, poses: np.ndarray, radius: float, rng: np.random.Generator
) -> Proposal | None:
    """Draw something that could replace a part of a path; None if what is drawn does not fit.

    Args:
        steps: (n, D - 1) distance driven [m], turn [rad] and steps of the other joints.
        poses: (n + 1, 3) of the base before and after each step.
        radius: smallest turning radius [m].
        rng: what to draw with.
    """
    gap = _draw_gap(steps, rng)
    if gap is None:
        return None
    draw = _one_corner if rng.random() < 0.4 else _two_corners
    found = draw(gap, poses[gap.first], poses[gap.last], radius, rng)
    if found is None or np.any(found[1] > gap.room + 1e-9):
        return None
    return _spliced(steps, gap, *found)


def _draw_gap(steps: np.ndarray, rng: np.random.Generator) -> _Gap | None:
    """A part of a path on which the base drives all the time."""
    count, gears = len(steps), np.sign(steps[:, 0])
    straight = (gears != 0) & (steps[:, 1] == 0)
    begin = int(rng.integers(count))
    stands = begin == 0 or gears[begin - 1] != gears[begin]
    if straight[begin] and rng.random() < 0.85:
        first, gear, room = begin + 1, gears[begin], abs(steps[begin, 0])
    elif gears[begin] != 0 and stands:
        first, gear, room = begin, 0.0, 0.0
    else:
        return None
    # The lines that follow: straight steps, and poses where the robot stands.
    lines = []
    for last in range(first, min(first + _SPAN, count) + 1):
        if last > first and (last == count or gears[last] != gears[last - 1]):
            lines.append((last, 0.0, 0.0))
        if last == count or gears[last] == 0:
            break
        if last > first and straight[last] and gear in (0.0, gears[last]):
            lines.append((last, gears[last], abs(steps[last, 0])))
    if not lines:
        return None
    weight = _FARTHER ** np.array([last - first for last, *_ in lines])
    last, own, behind = lines[rng.choice(len(lines), p=weight / weight.sum())]
    gear = gear or own or rng.choice([-1.0, 1.0])
    return _Gap(first=first, last=last, gear=gear, room=np.array([room, behind]))


def _one_corner(gap, begin, end, radius, rng) -> tuple[np.ndarray, np.ndarray] | None:
    """One turn between two lines: its arcs (k, 2), and what it takes of both lines (2,) [m]."""
    turn = _wrapped(end[2] - begin[2])
    if not _LEAST_TURN < abs(turn) < MOST_TURN:
        return None
    # Where the lines cross: so far after the first ends, and so far before the second begins.
    ways = np.stack([_way(gap, begin[2]), _way(gap, end[2])], axis=1)
    ahead = np.linalg.solve(ways, end[:2] - begin[:2])
    least, most = max(*ahead, 0.0), np.min(ahead + gap.room)
    if most < least:
        return None
    reach = max(least, most * rng.choice(_SHARES))
    arcs = _arcs(gap.gear, turn, reach, radius, rng)
    return None if arcs is None else (arcs, reach - ahead)


def _two_corners(gap, begin, end, radius, rng) -> tuple[np.ndarray, np.ndarray] | None:
    """Two turns with a new line in between; see :func:`_one_corner`."""
    drawn = rng.normal(size=2) * rng.choice(_SPREADS)
    ahead = np.where(gap.room > 0, np.maximum(drawn, -gap.room), np.abs(drawn))
    corner = begin[:2] + ahead[0] * _way(gap, begin[2])
    line = end[:2] - ahead[1] * _way(gap, end[2]) - corner
    length, heading = np.hypot(*line), np.arctan2(*(gap.gear * line)[::-1])
    turns = _wrapped(np.array([heading - begin[2], end[2] - heading]))
    if not np.all((_LEAST_TURN < np.abs(turns)) & (np.abs(turns) < MOST_TURN)):
        return None
    share = rng.uniform(0.3, 0.7)
    reach = np.minimum(ahead + gap.room, length * np.array([share, 1 - share]))
    reach *= rng.choice(_SHARES, 2)
    both = [_arcs(gap.gear, *one, radius, rng) for one in zip(turns, reach, strict=True)]
    if both[0] is None or both[1] is None:
        return None
    straight = np.array([[gap.gear * (length - reach.sum()), 0.0]])
    return np.concatenate([both[0], straight, both[1]]), reach - ahead


def _arcs(
    gear: float, turn: float, reach: float, radius: float, rng: np.random.Generator
) -> np.ndarray | None:
    """The arcs (k, 2) of a turn [m] and [rad] that begins ``reach`` before its corner."""
    profile = np.array(PROFILES[rng.integers(len(PROFILES))])
    turns = turn * profile / profile.sum()
    # Of arcs of length one: where they end, as a chord; how far from the corner they begin.
    middle = np.cumsum(turns) - turns / 2
    chord = np.sinc(turns / (2 * np.pi)) @ np.exp(1j * middle)
    length = reach * 2 * np.cos(turn / 2) / np.abs(chord)
    if length < radius * np.abs(turns).max():
        return None
    return np.stack([np.full(len(turns), gear * length), turns], axis=1)


def _spliced(steps: np.ndarray, gap: _Gap, arcs: np.ndarray, taken: np.ndarray) -> Proposal:
    """The path with new arcs, which take so much (2,) [m] of the lines, or lengthen them."""
    # What is taken of a straight step is taken of its arm's motion too.
    share = np.divide(np.maximum(taken, 0.0), gap.room, out=np.zeros(2), where=gap.room > 0)
    share = np.minimum(share, 1.0)
    begin, end = gap.first - (gap.room[0] > 0), gap.last + (gap.room[1] > 0)
    head, tail = steps[begin : gap.first], steps[gap.last : end]
    arm = sum(part[:, 2:].sum(0) for part in (steps[gap.first : gap.last], share[0] * head))
    arm = arm + (share[1] * tail)[:, 2:].sum(0)
    longer = gap.gear * np.maximum(-taken, 0.0)
    base = np.concatenate([[[longer[0], 0.0]], arcs, [[longer[1], 0.0]]])
    base = base[np.abs(base[:, 0]) > 1e-9]
    part = np.abs(base[:, :1]) / np.abs(base[:, 0]).sum()
    return Proposal(
        before=np.concatenate([steps[:begin], (1 - share[0]) * head]),
        new=np.concatenate([base, part * arm], axis=1),
        after=np.concatenate([(1 - share[1]) * tail, steps[end:]]),
    )


def _way(gap: _Gap, heading: float) -> np.ndarray:
    """Where the base goes (2,) with a heading."""
    return gap.gear * np.array([np.cos(heading), np.sin(heading)])


def _wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi
