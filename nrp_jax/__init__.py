"""Neural randomized planning in JAX: learned samplers for long-horizon motion in homes."""

from nrp_jax.homes.grid import Grid, load_map
from nrp_jax.planner import PlanResult, Status, plan
from nrp_jax.samplers import load_sampler
from nrp_jax.scene.robots import MobileRobot, link_features, load_robot
from nrp_jax.scene.world import GridWorld, batch_is_free, build_world, is_free, with_grid

__all__ = [
    "Grid",
    "GridWorld",
    "MobileRobot",
    "PlanResult",
    "Status",
    "batch_is_free",
    "build_world",
    "is_free",
    "link_features",
    "load_map",
    "load_robot",
    "load_sampler",
    "plan",
    "with_grid",
]
