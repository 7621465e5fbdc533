"""Neural randomized planning in JAX: learned samplers for long-horizon motion in homes."""

import vrrt_jax.core as _kernel  # noqa: F401 - first: it says what Ctrl-C does meanwhile
from nrp_jax.batch import plan_batch
from nrp_jax.config import PlannerConfig
from nrp_jax.homes.grid import Grid, load_map
from nrp_jax.planner import plan
from nrp_jax.samplers import load_sampler
from nrp_jax.scene.nearest import nearest_free
from nrp_jax.scene.quicken import QuickPath, quicken
from nrp_jax.scene.robots import MobileRobot, link_features, load_robot
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world, is_free, with_grid
from nrp_jax.viewer import view
from vrrt_jax.core.goal import ConfigurationGoal
from vrrt_jax.core.result import PlanResult, Status, Verification

__all__ = [
    "ConfigurationGoal",
    "Grid",
    "GridWorld",
    "MobileRobot",
    "PlanResult",
    "PlannerConfig",
    "QuickPath",
    "Status",
    "Verification",
    "batch_is_free",
    "build_world",
    "is_free",
    "link_features",
    "load_map",
    "load_robot",
    "load_sampler",
    "nearest_free",
    "plan",
    "plan_batch",
    "quicken",
    "view",
    "with_grid",
]
