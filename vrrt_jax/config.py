"""The settings of a plan, by stage."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from vrrt_jax.core import settings
from vrrt_jax.core.settings import setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class TreeConfig:
    """The tree: its size, and how it is rewired. Changes of the first four re-compile."""

    lanes: int = setting(32, 2, 4096)  # expansions an iteration
    capacity: int = setting(8192, 8, 1 << 24)  # nodes that there is room for at first
    max_capacity: int = setting(1 << 20, 8, 1 << 24)  # a full tree gets more room, up to this
    image_px: int = setting(32, 8, 4096)  # image height that is searched at
    rewiring: bool = True  # RRT*, of the published planner
    rewire_radius: float = setting(0.3, 0.0)  # [rad]


@dataclasses.dataclass(frozen=True, kw_only=True)
class LineageConfig:
    """How the tree grows: scattered edges, lineages that jump, lineages that descend."""

    num: int = setting(64, 0, 1024)  # lineages; 0 = the published planner instead (re-compiles)
    trees: int = setting(2, 1, 64)  # such trees grow at once, one a core, and become one tree
    radius: float = setting(2.8, 0.0)  # how far edges scatter from the start [rad]
    # Of the first attempt; the second does twice as much, and the later ones four times.
    samples: int = setting(128, 1, 1 << 20)  # edges that scatter
    jumps: int = setting(8, 0, 1 << 20)  # random changes of each lineage's best node
    steps: int = setting(8, 1, 100_000)  # Adam steps of a lineage
    young: int = setting(4, 0, 100_000)  # of them that every lineage takes, then the best go on
    alpha: float = setting(0.06, 0.0, 1.0)  # first of these steps, falling to zero [rad]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExpandConfig:
    """How the published planner chooses and expands nodes; the symbols are the paper's."""

    alpha: float = setting(0.04, 0.0, 1.0)  # Adam step [rad]
    epsilon: float = setting(0.04, 0.0, 1.0)  # shortest exploration step [rad]
    rho: float = setting(0.7, 0.0, 10.0)  # exploration radius: its longest step [rad] (re-compiles)
    kappa: float = setting(0.9, 0.0, 1.0, below=True)  # decay of the frontier's geometric law
    eta: float = setting(0.7, 0.0, 1.0)  # share of parents drawn by that law, not uniformly
    exploration: float = setting(0.3, 0.0, 1.0)  # share r of lanes that explore
    beta1: float = setting(0.9, 0.0, 1.0, below=True)  # of lineages too
    beta2: float = setting(0.9, 0.0, 1.0, below=True)  # of lineages too
    inherit: bool = True  # a child goes on with its parent's Adam moments


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolishConfig:
    """Least squares after the search, which tells apart what the small images cannot."""

    hypotheses: int = setting(4, 0, 1024)  # best nodes polished; 0 = none (re-compiles)
    samples: int = setting(256, 1, 65536)  # around them, and as many drawn anew
    lanes: int = setting(32, 1, 1024)  # best samples, which descend
    kept: int = setting(8, 1, 1024)  # distinct ends that go on
    spread: float = setting(0.8, 0.0)  # of a joint [rad]
    steps: int = setting(4, 0, 1024)  # Levenberg-Marquardt
    coarse_px: int = setting(64, 8, 4096)  # image height at first (re-compiles)
    px: int = setting(128, 8, 4096)  # image height at the end (re-compiles)
    close_px: int = setting(480, 0, 4096)  # image height that a close-up is cut from; 0 = none
    # Weight of the prior toward the start: added loss per rad^2, in units of the match threshold.
    start_prior: float = setting(0.005, 0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchConfig:
    """When an image counts as matched, and which of several matches is taken."""

    scale: float = setting(1.0, 1e-9)  # the threshold, in units of the self-model's calibrated one
    # Matches whose cost is within this factor of the best one's look the same: one is taken, by its
    # cost and its distance from the start, and the others are named.
    ambiguity: float = setting(1.1, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """How long each stage goes on."""

    max_iterations: int = setting(400, 1)
    settle_iterations: int = setting(6, 0)  # once matched, iterations without improvement
    # Iterations without improvement after which it gives up; None = no limit.
    patience: int | None = setting(None, 1, optional=True)
    min_improvement: float = setting(0.0, 0.0)  # an improvement is a loss this much smaller ...
    min_ratio: float = setting(0.97, 0.0, 1.0)  # ... and below this share of the one before
    attempts: int = setting(6, 1, 1024)  # the later ones with other keys, without a verified path
    # Of all searches, compilation excluded [s].
    time_limit_s: float = setting(float("inf"), 0.0, endless=True)
    connect_iterations: int = setting(400, 1)  # of RRT-Connect, to a match
    shortcut_rounds: int = setting(150, 0)
    verify_step: float = setting(0.005, 1e-4, 1.0)  # between two configurations checked [rad]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathConfig:
    """What a path keeps away from."""

    # Clearance to obstacles, and to the robot itself [m]: less where an end of the path is nearer,
    # or where no path keeps it. The result says how much there is.
    margin: float = setting(0.01, 0.0, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Settings of a plan, by stage. The defaults measure best; :meth:`paper` is as published.

    A change re-compiles where a comment says so, and nowhere else.
    """

    tree: TreeConfig = TreeConfig()
    lineages: LineageConfig = LineageConfig()
    expand: ExpandConfig = ExpandConfig()
    polish: PolishConfig = PolishConfig()
    match: MatchConfig = MatchConfig()
    path: PathConfig = PathConfig()
    budget: Budget = Budget()

    @classmethod
    def paper(cls) -> "PlannerConfig":
        """The published method (Visual-RRT, CVPR 2026): one tree, constant Adam steps.

        It searches until the norm of the images' difference has not improved by 0.0001 for 100
        iterations, matched or not. The loss is its square, 0.0001 where a pose is right.
        """
        return cls(
            tree=TreeConfig(image_px=64),
            lineages=LineageConfig(num=0),
            polish=PolishConfig(hypotheses=0),
            budget=Budget(
                max_iterations=100_000,
                settle_iterations=100,
                attempts=1,
                patience=100,
                min_improvement=2e-6,  # 2 * 0.01 * 0.0001
                min_ratio=1.0,
            ),
        )

    def changed(self, changes: Mapping[str, Any]) -> "PlannerConfig":
        """The same settings but for some of them, such as ``{"budget.time_limit_s": 5.0}``.

        Raises:
            ValueError: there is no such setting; the message lists those that exist.
        """
        return settings.changed(self, changes)


def check_config(config: PlannerConfig) -> None:
    """Raise a ValueError that names the setting out of range."""
    if not isinstance(config, PlannerConfig):
        raise ValueError(
            f"config is a {type(config).__module__}.{type(config).__name__}; expected a "
            "vrrt_jax.PlannerConfig"
        )
    settings.check_settings(config)
    lanes, roots = config.tree.lanes, 2
    if config.tree.capacity > config.tree.max_capacity:
        raise ValueError(
            f"tree.capacity={config.tree.capacity} is above tree.max_capacity="
            f"{config.tree.max_capacity}; lower the first or raise the second"
        )
    if config.tree.capacity < lanes + roots:
        raise ValueError(
            f"tree.capacity={config.tree.capacity} leaves no room for {roots - 1} roots and one "
            f"iteration of {lanes} lanes; expected at least {lanes + roots}, for example 8192"
        )
