"""Visual-RRT in JAX: from a picture of the goal to a verified, collision-free path."""

__version__ = "0.2.0"

from vrrt_jax.core.interrupt import end_at_once_while_starting as _end_at_once_while_starting
from vrrt_jax.gl import choose_backend as _choose_backend

_end_at_once_while_starting()  # what follows takes seconds
_choose_backend()  # before anything imports MuJoCo

from vrrt_jax.batch import plan_batch  # noqa: E402
from vrrt_jax.config import (  # noqa: E402
    Budget,
    ExpandConfig,
    LineageConfig,
    MatchConfig,
    PlannerConfig,
    PolishConfig,
    TreeConfig,
)
from vrrt_jax.core.edges import Space, difference, distance  # noqa: E402
from vrrt_jax.core.goal import ConfigurationGoal, LeastSquaresGoal  # noqa: E402
from vrrt_jax.core.planners import PLANNERS, RRT, RRTConnect, RRTStar  # noqa: E402
from vrrt_jax.core.result import PlanResult, Status, Verification  # noqa: E402
from vrrt_jax.core.search import make_termination, search  # noqa: E402
from vrrt_jax.core.types import (  # noqa: E402
    Expansion,
    ExpansionPolicy,
    Goal,
    Proposals,
    Tree,
    pytree,
    static,
)
from vrrt_jax.motion.export import save_trajectory  # noqa: E402
from vrrt_jax.motion.limits import MotionLimits, motion_limits  # noqa: E402
from vrrt_jax.motion.simulate import Tracking, execute_in_sim  # noqa: E402
from vrrt_jax.motion.trajectory import Trajectory, time_parameterize  # noqa: E402
from vrrt_jax.planner import plan, plan_to_configuration, plan_waypoints  # noqa: E402
from vrrt_jax.pose import inverse_kinematics, plan_to_pose  # noqa: E402
from vrrt_jax.problems import Problem, load_problem, load_world, problem_names  # noqa: E402
from vrrt_jax.robots import Robot, load_robot, robot_names  # noqa: E402
from vrrt_jax.robots.kinematics import link_poses  # noqa: E402
from vrrt_jax.scene.attached import attach, detach  # noqa: E402
from vrrt_jax.scene.closed_form import ClosedFormWorld  # noqa: E402
from vrrt_jax.scene.mjx import MjxWorld  # noqa: E402
from vrrt_jax.scene.obstacles import Obstacle  # noqa: E402
from vrrt_jax.scene.verify import verify_path  # noqa: E402
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
from vrrt_jax.splat.foreground import robot_before_background, robot_in_box  # noqa: E402
from vrrt_jax.splat.model import SelfModel, load_self_model, save_self_model  # noqa: E402
from vrrt_jax.splat.photo import Photo, load_photo  # noqa: E402
from vrrt_jax.splat.picture_file import read_image, write_image  # noqa: E402
from vrrt_jax.splat.raster import render  # noqa: E402
from vrrt_jax.splat.types import Camera, GoalImage, SplatModel  # noqa: E402
from vrrt_jax.viewer import view  # noqa: E402
from vrrt_jax.visual.goal import ImageGoal, ImageObjective  # noqa: E402
from vrrt_jax.visual.policy import VisualRRT  # noqa: E402

__all__ = [
    "Budget",
    "Camera",
    "ClosedFormWorld",
    "ConfigurationGoal",
    "ExpandConfig",
    "Expansion",
    "ExpansionPolicy",
    "Goal",
    "GoalImage",
    "ImageGoal",
    "ImageObjective",
    "LeastSquaresGoal",
    "LineageConfig",
    "MatchConfig",
    "MjxWorld",
    "MotionLimits",
    "Obstacle",
    "PLANNERS",
    "Photo",
    "PlanResult",
    "PlannerConfig",
    "PolishConfig",
    "Problem",
    "Proposals",
    "RRT",
    "RRTConnect",
    "RRTStar",
    "Robot",
    "SelfModel",
    "Space",
    "SplatModel",
    "Status",
    "Tracking",
    "Trajectory",
    "Tree",
    "TreeConfig",
    "Verification",
    "VisualRRT",
    "World",
    "attach",
    "build_world",
    "camera_from_matrix",
    "detach",
    "difference",
    "distance",
    "execute_in_sim",
    "inverse_kinematics",
    "is_free",
    "link_poses",
    "load_photo",
    "load_problem",
    "load_robot",
    "load_self_model",
    "load_world",
    "look_at",
    "make_termination",
    "motion_limits",
    "move_obstacle",
    "obstacle_clearance",
    "obstacle_list",
    "orbit",
    "plan",
    "plan_batch",
    "plan_to_configuration",
    "plan_to_pose",
    "plan_waypoints",
    "problem_names",
    "pytree",
    "read_image",
    "render",
    "robot_before_background",
    "robot_in_box",
    "robot_names",
    "save_self_model",
    "save_trajectory",
    "search",
    "static",
    "time_parameterize",
    "verify_path",
    "view",
    "with_obstacles",
    "write_image",
]
