"""The settings of a plan, and what becomes of it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from vrrt_jax.core.types import Status, Tree
from vrrt_jax.scene.verify import Verification


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Settings of Visual-RRT. The defaults are what measures best; :meth:`paper` is as published.

    A change re-compiles where a comment says so, and nowhere else.
    """

    alpha: float = 0.04  # Adam step [rad]
    epsilon: float = 0.04  # exploration step [rad]
    kappa: float = 0.9  # decay of the frontier's geometric law, in [0, 1)
    eta: float = 0.7  # share of parents drawn by that law rather than uniformly, in [0, 1]
    exploration: float = 0.3  # share r of lanes that explore, in [0, 1]
    beta1: float = 0.9
    beta2: float = 0.9
    anneal: float = 10.0  # Adam steps shrink below this many times the match bar; 0 = never
    match_scale: float = 1.0  # the goal loss, in units of the self-model's calibrated bar
    probes: int = 1024  # renders around the start that seed the search (re-compiles)
    probe_radius: float = 2.8  # how far from it [rad]
    probe_rounds: int = 4  # of looking for something better around each one kept
    probe_alpha: float = 0.06  # first of these steps, falling to zero [rad]
    probe_steps: int = 60  # Adam steps that the kept ones take at that resolution
    probes_kept: int = 64  # best of them, which improve and become roots (re-compiles)
    probe_px: int = 32  # image height that they are rendered at (re-compiles)
    hypotheses: int = 4  # distinct best nodes that are polished; 0 = none
    polish_samples: int = 256  # around them, in each round
    polish_lanes: int = 32  # best of these, which descend
    polish_kept: int = 8  # distinct ends that go on
    polish_rounds: int = 2  # of spreading and descending; twice as many while nothing matches
    polish_spread: float = 0.8  # of a joint in the first round, half of that in the next [rad]
    polish_steps: int = 4  # Levenberg-Marquardt, in each round and at the end
    polish_px: int = 128  # image height at the end (re-compiles)
    close_px: int = 480  # image height of which a close-up of the hand is seen last; 0 = none
    start_prior: float = 0.005  # goal losses that a squared radian from the start costs then
    start_preference: float = 0.007  # share of its cost that a match's squared distance adds
    inherit: bool = True  # a child goes on with its parent's Adam moments
    rewiring: bool = True  # RRT* (re-compiles)
    rewire_radius: float = 0.3  # [rad]
    max_iterations: int = 400
    settle: int = 6  # once matched, iterations without improvement until the search ends
    patience: int | None = 25  # iterations without improvement after which it gives up
    min_improvement: float = 0.0  # an improvement is a loss this much smaller ...
    min_ratio: float = 0.97  # ... and below this share of the one before
    attempts: int = 2  # the later ones from other probes, while no path is found and verified
    time_limit_s: float = float("inf")  # of all searches, compilation excluded [s]
    connect_iterations: int = 400  # of RRT-Connect, to a match
    shortcut_rounds: int = 150
    verify_step: float = 0.005  # [rad]
    lanes: int = 32  # expansions an iteration (re-compiles)
    capacity: int = 8192  # nodes (re-compiles)
    image_px: int = 64  # image height that is searched at (re-compiles)

    @classmethod
    def paper(cls, **changes: Any) -> "PlannerConfig":
        """The published method (Visual-RRT, CVPR 2026): one tree, constant Adam steps.

        It searches until the loss has not improved for 100 iterations, matched or not.
        """
        paper = {
            "probes": 0,
            "hypotheses": 0,
            "anneal": 0.0,
            "settle": 100,
            "attempts": 1,
            "patience": 100,
            "min_improvement": 1e-4,
            "min_ratio": 1.0,
        }
        return cls(**{**paper, **changes})


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanResult:
    """What became of a problem."""

    status: Status
    # (P, D) the shortened, verified path; of a failure, the best attempt; joints without limits may
    # leave [-pi, pi), so that waypoints can be interpolated
    path: np.ndarray
    raw_path: np.ndarray  # (P', D) as the tree has it
    target: np.ndarray  # (D,) what was planned to: the end of the path, unless there is none
    alternatives: np.ndarray  # (A, D) other configurations that match the image as well
    loss: float  # of the target: image loss, or distance to a joint goal [rad]
    goal_loss: float  # at or below which it counts as matched
    search_goal_loss: float  # the same in the search, on its smaller images
    cost: float  # length of ``path`` [rad]
    verification: Verification | None  # None if there was nothing to verify
    rejected: Mapping[str, int]  # lanes lost, by reason
    iterations: int
    timing: Mapping[str, float]  # compile_s, search_s, shortcut_s, verify_s
    history: np.ndarray  # (chunks + 1, 4): iteration, seconds, best loss, nodes
    tree: Tree

    @property
    def ok(self) -> bool:
        """Solved: matched, collision-free and verified."""
        return self.status is Status.SOLVED

    @property
    def q_goal(self) -> np.ndarray:
        """(D,) the end of the path."""
        return self.path[-1]

    def __str__(self) -> str:
        """One line for people."""
        times = ", ".join(f"{k.removesuffix('_s')} {v:.1f} s" for k, v in self.timing.items())
        others = len(self.alternatives)
        ambiguous = f"; ambiguous: {others} other configurations look the same" if others else ""
        return (
            f"{self.status.name}: loss {self.loss:.2e} (goal {self.goal_loss:.2e}), "
            f"{len(self.path)} waypoints, {self.cost:.2f} rad, {self.iterations} iterations; "
            f"{times}{ambiguous}"
        )
