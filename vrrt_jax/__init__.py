"""Visual-RRT in JAX: from a picture of the goal to a verified, collision-free path."""

__version__ = "0.1.0"

from vrrt_jax.gl import choose_backend as _choose_backend

_choose_backend()  # before anything imports MuJoCo

from vrrt_jax.config import PlannerConfig, PlanResult  # noqa: E402
from vrrt_jax.core.edges import difference, distance  # noqa: E402
from vrrt_jax.core.types import Status  # noqa: E402
from vrrt_jax.planner import plan, plan_batch, plan_to_configuration  # noqa: E402
from vrrt_jax.problems import Problem, load_problem, load_world, problem_names  # noqa: E402
from vrrt_jax.robots import Robot, load_robot, robot_names  # noqa: E402
from vrrt_jax.robots.kinematics import link_poses  # noqa: E402
from vrrt_jax.scene.obstacles import Obstacle  # noqa: E402
from vrrt_jax.scene.verify import Verification, verify_path  # noqa: E402
from vrrt_jax.scene.world import (  # noqa: E402
    World,
    build_world,
    is_free,
    move_obstacle,
    obstacle_clearance,
    obstacle_list,
    with_obstacles,
)
from vrrt_jax.splat.camera import camera_from_matrix, look_at, orbit  # noqa: E402
from vrrt_jax.splat.images import read_image, write_image  # noqa: E402
from vrrt_jax.splat.model import SelfModel, load_self_model, save_self_model  # noqa: E402
from vrrt_jax.splat.raster import render  # noqa: E402
from vrrt_jax.splat.types import Camera, GoalImage, SplatModel  # noqa: E402

__all__ = [
    "Camera",
    "GoalImage",
    "Obstacle",
    "PlanResult",
    "PlannerConfig",
    "Problem",
    "Robot",
    "SelfModel",
    "SplatModel",
    "Status",
    "Verification",
    "World",
    "build_world",
    "camera_from_matrix",
    "difference",
    "distance",
    "is_free",
    "link_poses",
    "load_problem",
    "load_robot",
    "load_self_model",
    "load_world",
    "look_at",
    "move_obstacle",
    "obstacle_clearance",
    "obstacle_list",
    "orbit",
    "plan",
    "plan_batch",
    "plan_to_configuration",
    "problem_names",
    "read_image",
    "render",
    "robot_names",
    "save_self_model",
    "verify_path",
    "with_obstacles",
    "write_image",
]
