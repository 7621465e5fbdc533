"""From a raw path to a verified one: shorten, verify, fall back; and the result of a plan."""

import dataclasses
import time
from collections.abc import Callable

import jax
import numpy as np

from vrrt_jax.core.edges import Space, StraightLineEdges
from vrrt_jax.core.result import PlanResult, Status, Verification, rejected_lanes
from vrrt_jax.core.search import SearchResult
from vrrt_jax.core.shortcut import path_length, shortcut, without_repeats


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckedPath:
    """A path and what the exact check says of it."""

    path: np.ndarray  # (P, D) waypoints
    trajectory: np.ndarray  # (T, D) the configurations that were checked
    verification: Verification | None  # None if it was not checked


@dataclasses.dataclass(frozen=True, kw_only=True)
class Postprocessed:
    """A raw path, what was made of it, and the seconds that this took."""

    raw_path: np.ndarray  # (P', D)
    checked: CheckedPath
    compile_s: float = 0.0
    shortcut_s: float = 0.0
    verify_s: float = 0.0
    refused: int = 0  # paths that the exact check refused

    @property
    def is_verified(self) -> bool:
        """Whether the exact check found the path free."""
        return self.checked.verification is not None and self.checked.verification.ok


def unchecked(path: np.ndarray, trajectory: np.ndarray | None = None) -> Postprocessed:
    """A path that is left as it is, such as the start alone."""
    trajectory = path if trajectory is None else trajectory
    checked = CheckedPath(path=path, trajectory=trajectory, verification=None)
    return Postprocessed(raw_path=path, checked=checked)


def postprocess(
    world: StraightLineEdges,
    raw_path: np.ndarray,
    check: Callable[[np.ndarray], CheckedPath],
    *,
    key: jax.Array,
    rounds: int = 150,
    shorten: Callable[..., np.ndarray] = shortcut,
) -> Postprocessed:
    """Shorten a path and verify it; if the short path is refused, the raw one may still be right.

    No waypoint of what comes out repeats the one before.

    Args:
        world: robot and obstacles.
        raw_path: (P, D) waypoints as the tree has them.
        check: the exact check of a path (P, D).
        key: random key.
        rounds: of shortcutting.
        shorten: what shortens the path, as :func:`vrrt_jax.core.shortcut.shortcut` does.
    """
    raw_path = without_repeats(world, raw_path)
    begun_s = time.perf_counter()
    shorten(world, raw_path, key=key, rounds=0)  # compiles, if anything has to
    compiled_s = time.perf_counter()
    short_path = without_repeats(world, shorten(world, raw_path, key=key, rounds=rounds))
    shortened_s = time.perf_counter()
    verdicts = [check(short_path)]
    if _is_refused(verdicts[0]) and not np.array_equal(short_path, raw_path):
        verdicts.append(check(raw_path))
    checked = next((verdict for verdict in verdicts if not _is_refused(verdict)), verdicts[0])
    verified_s = time.perf_counter()
    return Postprocessed(
        raw_path=raw_path,
        checked=checked,
        compile_s=compiled_s - begun_s,
        shortcut_s=shortened_s - compiled_s,
        verify_s=verified_s - shortened_s,
        refused=sum(map(_is_refused, verdicts)),
    )


def _is_refused(checked: CheckedPath) -> bool:
    return checked.verification is not None and not checked.verification.ok


def plan_result(
    world: Space,
    found: SearchResult,
    done: Postprocessed,
    *,
    status: Status,
    advice: str,
    target: np.ndarray,
    loss: float,
    match_threshold: float,
) -> PlanResult:
    """The result of a search and of what was made of its path.

    Args:
        world: whose metric measures the path.
        found: the search.
        done: its path.
        status: how the plan ended.
        advice: what to try next.
        target: (D,) what was planned to.
        loss: of the target.
        match_threshold: at or below which the loss counts as matched.
    """
    path, iterations = done.checked.path, int(found.tree.iteration)
    return PlanResult(
        status=status,
        advice=advice,
        path=path,
        trajectory=done.checked.trajectory,
        raw_path=done.raw_path,
        target=target,
        alternatives=target[None][:0],
        loss=loss,
        match_threshold=match_threshold,
        search_match_threshold=match_threshold,
        cost=path_length(world, path) if len(path) > 1 else 0.0,
        verification=done.checked.verification,
        rejected=rejected_lanes(found),
        iterations=iterations,
        expansions=iterations * found.lanes,
        timing={
            "compile_s": found.compile_s + done.compile_s,
            "search_s": found.search_s,
            "shortcut_s": done.shortcut_s,
            "verify_s": done.verify_s,
        },
        history=found.history,
        tree=found.tree,
        refused=done.refused,
    )
