"""What becomes of a plan: one status and one result for all planners and goals."""

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from vrrt_jax.core.result_html import result_html
from vrrt_jax.core.search import SearchResult, StopReason
from vrrt_jax.core.types import Rejection, Tree


class Status(enum.Enum):
    """How a plan ended."""

    SOLVED = "a collision-free path to the goal, checked with C MuJoCo"
    NO_MATCH = "no configuration was found that meets the goal"
    NO_PATH = "the goal was met, but no path to it was found"
    MAX_ITERATIONS = "the iterations ran out"
    TREE_FULL = "the tree is full"
    TIME_LIMIT = "the time limit passed"
    INTERRUPTED = "interrupted; the best path so far is returned"
    NOT_VERIFIED = "the path touches something under the exact check"


STATUS_OF = {
    StopReason.CONVERGED: Status.NO_MATCH,
    StopReason.ITERATIONS: Status.MAX_ITERATIONS,
    StopReason.TREE_FULL: Status.TREE_FULL,
    StopReason.TIME_LIMIT: Status.TIME_LIMIT,
    StopReason.INTERRUPTED: Status.INTERRUPTED,
}
EARLY_STOPS = (StopReason.TIME_LIMIT, StopReason.INTERRUPTED)  # what ends a search, ends the plan
ABORTED = tuple(STATUS_OF[stopped] for stopped in EARLY_STOPS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verification:
    """What the exact check with C MuJoCo found."""

    ok: bool  # inside the limits and free all the way
    checked: int  # number of configurations checked
    contact: str | None  # the first violation, such as "link5 touches box_2 at 37 % of the path"
    clearance: float = float("nan")  # smallest distance to obstacles, where it is measured [m]
    geometry: str = "primitives"  # or "meshes", "polytopes", "spheres": of what the robot was


class Drawing(Protocol):
    """What draws a result for notebooks."""

    @property
    def caption(self) -> str:
        """What the picture shows."""
        ...

    def __call__(self, result: "PlanResult") -> np.ndarray:
        """The picture, (H, W, 3) uint8."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class PlanResult:
    """What became of a problem. Letters: ``P`` waypoints, ``D`` joints, ``A`` alternatives."""

    status: Status
    advice: str  # what to try next; "" if there is nothing
    # (P, D) waypoints of the shortened, verified path; of a failure, the best attempt. It starts
    # exactly where it was told, in the same turn of joints without limits. These go on from there,
    # so that waypoints can be interpolated: the path may end whole turns away from a joint goal.
    path: np.ndarray
    trajectory: np.ndarray  # (T, D) the same path in small steps
    raw_path: np.ndarray  # (P', D) as the tree has it
    target: np.ndarray  # (D,) what was planned to: the end of the path, unless there is none
    alternatives: np.ndarray  # (A, D) other configurations that meet the goal as well
    loss: float  # of the target: image loss, or distance to a joint goal [rad]
    match_threshold: float  # at or below which the loss counts as matched
    search_match_threshold: float  # the same in the search, which may use smaller images
    cost: float  # length of ``path`` in the world's metric [rad] or [m]
    verification: Verification | None  # None if there was no path to verify
    refused: int  # paths that the exact check refused, before one passed or the plan gave up
    rejected: Mapping[str, int]  # lanes lost, by reason
    iterations: int
    expansions: int  # lanes tried
    timing: Mapping[str, float]  # compile_s, search_s, shortcut_s, verify_s
    # (chunks + 1, 6): iteration, seconds, best score (of RRT-Connect: the distance between its
    # trees), nodes, length of the best path (inf before the first; not shortened), and
    # configurations checked for collision, those of samplers included
    history: np.ndarray
    tree: Tree
    # Smallest distance of the collision spheres to obstacles on the path [m], where it is measured.
    clearance: float = float("nan")
    # Image loss of the target with colors counted ten times as much; above ``match_threshold`` it
    # says that the light is another one than the self-model's, or that the pose is wrong.
    colored_loss: float = float("nan")
    # (D,) how far each joint of the target may be off while the image still matches, the others
    # following [rad] or [m], at most pi; None where nothing tells.
    joint_uncertainty: np.ndarray | None = None
    # How likely the target is the pose that a goal image shows, 0 to 1; NaN where nothing tells.
    match_probability: float = float("nan")
    # Of the length of ``raw_path``, what ``tree`` and an edge from it led along. RRT-Connect, which
    # goes on from the tree where no such edge is free, found the rest.
    tree_share: float = 1.0
    # For notebooks: the goal image beside the end of the path, or the way through a home. None
    # where nothing is to be seen, as of joint goals.
    draw: Drawing | None = None

    @property
    def ok(self) -> bool:
        """Solved: matched, collision-free and verified."""
        return self.status is Status.SOLVED

    @property
    def q_goal(self) -> np.ndarray:
        """(D,) the end of the path."""
        return self.path[-1]

    def __repr__(self) -> str:
        """One line for people."""
        times = ", ".join(f"{k.removesuffix('_s')} {v:.1f} s" for k, v in self.timing.items())
        others = len(self.alternatives)
        ambiguous = f"; ambiguous: {others} other configurations match as well" if others else ""
        return (
            f"{self.status.name}: loss {self.loss:.2e} (goal {self.match_threshold:.2e}), "
            f"{len(self.path)} waypoints, cost {self.cost:.2f}, {self.expansions} expansions, "
            f"{int(self.tree.size)} nodes; "
            f"{times}{ambiguous}"
        )

    def _repr_html_(self) -> str:
        """The same for notebooks, with a picture."""
        return result_html(self)


def rejected_lanes(found: SearchResult) -> dict[str, int]:
    """Lanes lost in a search, by reason."""
    rejected = np.asarray(found.tree.rejected)
    return {reason.name.lower(): int(rejected[reason]) for reason in Rejection}


def with_time_of(result: PlanResult, *results: PlanResult) -> PlanResult:
    """A result that took the time and the expansions of all, and counts what was refused in all."""
    timing: dict[str, Any] = {name: sum(r.timing[name] for r in results) for name in result.timing}
    counts = {name: sum(getattr(r, name) for r in results) for name in ("expansions", "refused")}
    return dataclasses.replace(result, timing=timing, **counts)
