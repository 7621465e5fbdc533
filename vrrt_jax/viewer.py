"""A plan in the browser: the robot along its path, the tree it grew, the goal beside the end."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax import planner
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.edges import difference
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.result import PlanResult
from vrrt_jax.core.tree_file import Nodes, load_nodes, nodes_of
from vrrt_jax.problems import load_problem, read_json
from vrrt_jax.report import outcome
from vrrt_jax.robots import Robot, mjcf_writer
from vrrt_jax.robots.kinematics import batch_link_poses
from vrrt_jax.robots.mesh_sources import mesh_spec
from vrrt_jax.scene.movable import MovableObstacles
from vrrt_jax.scene.page import Page, colors_of
from vrrt_jax.scene.world import World, obstacle_list, with_obstacles
from vrrt_jax.splat.camera import shrunk, squared
from vrrt_jax.splat.mujoco_images import OBSTACLE_GROUP, VISUAL_GROUPS, MeshRenderer
from vrrt_jax.splat.types import Camera
from vrrt_jax.visual.goal import ImageGoal
from vrrt_jax.viz import ScenePainter, along, over_sky

PICTURES = 151  # along a path: five seconds of play
PICTURE_PX = 240  # height of the goal image and of the end beside it
MOST_EDGES = 2_000  # drawn of a tree: all of a large one would hide the robot
EDGE_POINTS = 5  # along an edge, which is a curve in space
_WAY, _PATH = (255, 150, 40), (214, 40, 57)
# What the page tells of a result, in this order.
_TOLD = (
    *("status", "advice", "verified", "verified_with", "contact", "loss", "goal_loss"),
    *("match_probability", "cost", "raw_cost", "clearance_m", "tree_share", "error_rad"),
    *("timing", "counts", "seed"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Plan:
    """What is shown of a plan."""

    path: np.ndarray  # (P, D)
    raw_path: np.ndarray  # (P', D) as the tree has it
    nodes: Nodes
    numbers: Mapping[str, Any]


@single_precision
def view(
    result: PlanResult,
    world: World,
    goal: Any = None,
    *,
    config: PlannerConfig | None = None,
    port: int | None = None,
) -> Page:
    """Show a plan on a page in the browser, which only this machine can reach.

    The last expression of a notebook's cell shows itself. A script calls ``view(...).serve()``,
    which waits until Ctrl-C. With a goal, obstacles can be dragged, and a button plans again among
    them, from the same start.

    Args:
        result: from :func:`vrrt_jax.plan` or :func:`vrrt_jax.plan_to_configuration`.
        world: that it was planned in.
        goal: that it was planned to; of an :class:`ImageGoal` the first image is shown beside the
            end of the path.
        config: settings of plans that the page asks for, the default ones if None.
        port: of 127.0.0.1; a free one if None.

    Raises:
        ModuleNotFoundError: viser is not installed.
        OSError: the port is taken.
    """
    page = Page(f"{world.robot.value.name}: {result.status.name}", port)
    return _filled(page, _plan_of(world, result), world, goal, config)


@single_precision
def view_folder(folder: Path, *, port: int | None = None) -> Page:
    """Show what ``vrrt plan --out FOLDER`` wrote, see :func:`view`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged.
    """
    if not (folder / "result.json").is_file():
        raise FileNotFoundError(
            f"no plan at '{folder}': it has no result.json; write one with: vrrt plan --out FOLDER"
        )
    # The engine that loads fastest, and plans fastest if the page asks for that.
    problem = load_problem(folder / "problem", engine="closed_form")
    plan = _Plan(
        **_paths(folder / "path.npz", problem.robot.num_joints),
        nodes=load_nodes(folder / "tree.npz", problem.robot.num_joints),
        numbers=read_json(folder / "result.json"),
    )
    if not isinstance(plan.numbers, dict) or "status" not in plan.numbers:
        raise ValueError(f"'{folder / 'result.json'}' has no status; plan again")
    page = Page(f"{problem.robot.name}: {plan.numbers['status']}", port)
    return _filled(page, plan, problem.world, problem.goal, None)


def _paths(file: Path, num_joints: int) -> dict[str, np.ndarray]:
    """The paths (P, D) of a file, by name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or of another robot.
    """
    arrays = read_arrays(file, "path", "raw_path")
    paths = {name: arrays[name] for name in ("path", "raw_path")}
    for name, path in paths.items():
        is_path = path.dtype.kind == "f" and path.ndim == 2 and path.shape[1] == num_joints
        if not (is_path and len(path) and np.isfinite(path).all()):
            raise ValueError(
                f"'{file}': {name} of shape {path.shape} is no path of the problem's robot; "
                f"expected finite numbers (P, {num_joints}): plan again"
            )
    return paths


def _plan_of(world: World, result: PlanResult) -> _Plan:
    return _Plan(
        path=result.path,
        raw_path=result.raw_path,
        nodes=nodes_of(result.tree),
        numbers=outcome(world, result),
    )


def _filled(page: Page, plan: _Plan, world: World, goal: Any, config: PlannerConfig | None) -> Page:
    """The page with all that it shows; closed if that fails."""
    try:
        page.add_robot(*_model(world))
        page.obstacles = MovableObstacles(page, obstacle_list(world), movable=goal is not None)
        if goal is not None:
            _offer_plans(page, world, goal, plan.path[0], config)
        _show(page, plan, world, goal)
        _look(page, world, goal, plan.path[-1])
    except BaseException:
        page.close()
        raise
    return page


def _show(page: Page, plan: _Plan, world: World, goal: Any) -> None:
    """All that depends on the plan, in place of what was shown before."""
    trajectory = along(world, plan.path, PICTURES)
    page.show_trajectory(trajectory)
    _show_lines(page, plan, world, trajectory)
    if isinstance(goal, ImageGoal):
        _show_pictures(page, goal, world, plan.path[-1])
    told = {name: plan.numbers[name] for name in _TOLD if plan.numbers.get(name) is not None}
    page.show_numbers({name: value for name, value in told.items() if value != ""})


def _offer_plans(
    page: Page, world: World, goal: Any, q_start: np.ndarray, config: PlannerConfig | None
) -> None:
    """A button that plans again, among the obstacles where they stand then."""
    asked = itertools.count(1)

    def plan_again(say: Callable[[str], None]) -> None:
        say("planning")
        moved = with_obstacles(world, page.obstacles.obstacles)
        run: dict[str, Any] = {"key": jax.random.key(next(asked)), "config": config}
        run["on_progress"] = lambda _, seconds: say(f"planning: {seconds:.1f} s")
        try:
            result = planner.plan(world.robot.value, moved, goal, q_start, **run)
        except ValueError as error:  # an obstacle where the robot stands, for example
            page.show_numbers({"status": "not planned", "advice": str(error)})
        else:
            _show(page, _plan_of(moved, result), moved, goal)

    page.add_button("plan again", plan_again)


def _model(world: World) -> tuple[mujoco.MjModel, tuple[int, ...]]:
    """Robot and held objects, and the groups to draw: true meshes, or what stands for them."""
    robot: Robot = world.robot.value
    spec, groups = mesh_spec(robot), VISUAL_GROUPS
    if spec is None:
        kind = mjcf_writer.POLYTOPE_GEOM if robot.polytopes else mjcf_writer.SELF_COLLISION_GEOM
        spec, groups = mujoco.MjSpec.from_string(robot.xml), (int(kind["group"]),)
    model = MeshRenderer(spec, [], world.attached).model
    return model, (*groups, OBSTACLE_GROUP)


def _show_lines(page: Page, plan: _Plan, world: World, trajectory: np.ndarray) -> None:
    """The tree by loss, its way to the goal, and the path, as places of the hand."""
    robot, nodes = world.robot.value, plan.nodes
    child = nodes.best_edges(MOST_EDGES)
    # On a scale of powers of ten, as in the figures.
    colors = colors_of(np.log10(nodes.score[child] + 1e-9))
    start, end = nodes.q[nodes.parent[child]], nodes.q[child]
    page.show_lines("best of the tree (strong: low loss)", _curves(world, start, end), colors, 1.0)
    raw = plan.raw_path
    page.show_lines("way in the tree", _curves(world, raw[:-1], raw[1:]), np.array(_WAY), 3.0)
    page.show_lines("path", _tips(robot, trajectory)[None], np.array(_PATH), 5.0)


def _curves(world: World, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Places (E, EDGE_POINTS, 3) of the hand along edges between configurations (E, D)."""
    step = np.asarray(difference(world, jnp.asarray(start), jnp.asarray(end)))
    q = start[:, None] + np.linspace(0, 1, EDGE_POINTS)[:, None] * step[:, None]
    return _tips(world.robot.value, q.reshape(-1, q.shape[-1])).reshape(*q.shape[:2], 3)


def _tips(robot: Robot, q: np.ndarray) -> np.ndarray:
    """The middle (n, 3) of the last link's spheres [m], at configurations (n, D)."""
    spheres = robot.self_collision_spheres
    centers = np.asarray(spheres.center)[np.asarray(spheres.link) == robot.chain.num_links - 1]
    tip = centers.mean(axis=0) if len(centers) else np.zeros(3)
    pose = np.asarray(batch_link_poses(robot.chain, jnp.asarray(q, jnp.float32)))[:, -1]
    return pose[:, :3, :3] @ tip + pose[:, :3, 3]


def _show_pictures(page: Page, goal: ImageGoal, world: World, q_end: np.ndarray) -> None:
    """The first goal image, and the end of the path as its camera sees it."""
    camera = _small_camera(goal)
    painter = ScenePainter(world.robot.value, world, goal.self_model, camera)
    wanted = over_sky(goal.views[1][0], (camera.width, camera.height))
    both = np.concatenate([wanted, painter.paint(q_end)], axis=1)
    page.show_picture("goal image | end of the path", both)


def _small_camera(goal: ImageGoal) -> Camera:
    camera = squared(goal.views[0][0])
    return shrunk(camera, max(1, round(camera.height / PICTURE_PX)))


def _look(page: Page, world: World, goal: Any, q_end: np.ndarray) -> None:
    """Look from the goal's camera at what lies as deep as the hand; else at the hand."""
    tip = _tips(world.robot.value, q_end[None])[0]
    if not isinstance(goal, ImageGoal):
        page.look_from(tip + np.array([1.2, 1.2, 0.8]), tip)
        return
    camera = _small_camera(goal)
    pose = np.linalg.inv(np.asarray(camera.world_to_cam, float))
    fovy = camera.height / float(camera.focal)
    depth = max((tip - pose[:3, 3]) @ pose[:3, 2], 0.1)
    page.look_from(pose[:3, 3], pose[:3, 3] + depth * pose[:3, 2], 2 * np.arctan(fovy / 2))
