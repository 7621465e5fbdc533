"""The settings of a plan in a home."""

import dataclasses

from vrrt_jax.core.settings import setting

EDGE_STEPS = 64  # collision checks along an edge of a single tree (static)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Settings of a plan. Lanes and capacity re-compile, the others are only new numbers."""

    goal_bias: float = setting(0.3, 0.0, 1.0)  # share of expansions that aim at the goal
    straight_rate: float = setting(0.2, 0.0, 1.0)  # share that goes straight, with a sampler
    uniform_share: float = setting(0.5, 0.0, 1.0)  # of the samples of cvae-rrt and cvae-irrt-star
    lanes: int = setting(32, 1, 4096)  # expansions at a time; rrt-connect takes two at least
    capacity: int = setting(8192, 3, 1 << 24)  # nodes of the tree that there is room for at first
    max_capacity: int = setting(1 << 20, 3, 1 << 24)  # a full tree gets more room, up to this
    max_expansions: int = setting(32_000, 1)  # budget; one iteration of all lanes is the least
    time_limit_s: float = setting(60.0, 0.0, endless=True)  # wall time of the search [s]
