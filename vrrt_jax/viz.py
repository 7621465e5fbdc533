"""Figures and animations of plans."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw

from vrrt_jax.core.edges import difference
from vrrt_jax.core.result import PlanResult
from vrrt_jax.problems import Problem
from vrrt_jax.robots import Robot
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.robots.mesh_sources import mesh_spec
from vrrt_jax.scene.obstacles import signed_distances
from vrrt_jax.scene.world import World, obstacle_list
from vrrt_jax.splat.camera import project, shrunk, squared
from vrrt_jax.splat.images import prepare_goal
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.types import Camera, SplatModel

SKY = np.array([0.97, 0.98, 1.0])
MARCHING_STEPS = 60  # along each ray
HIT_M = 5e-3  # [m] a ray that comes so near to a surface hits it
FARTHEST_M = 30.0  # [m] depth up to which obstacles are drawn


class ScenePainter:
    """Pictures of robot and obstacles: MuJoCo's if it can, or splats over ray-marched obstacles."""

    def __init__(self, robot: Robot, world: World, self_model: SelfModel, camera: Camera):
        """Choose how to draw; ``uses_meshes`` says whether the true meshes are drawn."""
        self._camera, self._chain = camera, robot.chain
        self._meshes = _mesh_renderer(robot, world)
        self.uses_meshes = self._meshes is not None
        if not self.uses_meshes:
            splats = self_model.levels[-1].splats
            self._background, self._depth = _draw_obstacles(world, camera)
            self._robot = jax.jit(lambda q: _splat_layers(splats, robot, camera, q))

    def paint(self, q: np.ndarray) -> np.ndarray:
        """The scene at a configuration (D,) [rad] or [m]: (H, W, 3) uint8."""
        if self._meshes is not None:
            return self._meshes.scene(q, self._camera)
        rgb, alpha, depth = (np.asarray(x) for x in self._robot(jnp.asarray(q, jnp.float32)))
        straight = rgb / np.maximum(alpha, 1e-3)[..., None]
        # An obstacle that is nearer than the robot hides it.
        visible = np.where(depth < self._depth, alpha, 0.0)[..., None]
        mixed = (1 - visible) * self._background + visible * straight
        return np.round(255 * np.clip(mixed, 0, 1)).astype(np.uint8)


def _mesh_renderer(robot: Robot, world: World) -> Any:
    """MuJoCo's renderer, or None without meshes or OpenGL."""
    from vrrt_jax.splat.mujoco_images import MeshRenderer

    try:
        spec = mesh_spec(robot)
        if spec is None:
            return None
        renderer = MeshRenderer(spec, obstacle_list(world), world.attached)
        renderer.check()
        return renderer
    except (RuntimeError, OSError, ValueError):
        return None


def _splat_layers(splats: SplatModel, robot: Robot, camera: Camera, q: jax.Array):
    """Color over black (H, W, 3), alpha (H, W) and depth (H, W) [m] of the robot."""
    poses = link_poses(robot.chain, q)
    rgb, alpha = render(splats, poses, camera)
    pose = poses[splats.link]
    points = jnp.einsum("gij,gj->gi", pose[:, :3, :3], splats.mean) + pose[:, :3, 3]
    _, depth = project(camera, points)
    # The depth is rendered like a color.
    depth_as_rgb = dataclasses.replace(
        splats,
        rgb=jnp.repeat(depth[:, None], 3, axis=1),
        view_color_gradient=jnp.zeros_like(splats.view_color_gradient),
    )
    weighted, _ = render(depth_as_rgb, poses, camera)
    return rgb, alpha, weighted[..., 0] / jnp.maximum(alpha, 1e-3)


def _draw_obstacles(world: World, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Draw the obstacles by ray marching their signed distances.

    Returns:
        Color (H, W, 3), and depth (H, W) [m], +inf where no obstacle is hit.
    """
    eye, rays = _pixel_rays(camera)
    stretch = jnp.sqrt(jnp.sum(rays**2, axis=0))  # [m] along the ray per meter of depth

    @jax.jit
    def trace(rays, stretch):
        def distances(depth):
            return signed_distances(world.obstacles, eye[:, None] + depth * rays)

        # The nearest surface is at least its distance away, so a step of that length is safe.
        depth = jax.lax.fori_loop(
            0,
            MARCHING_STEPS,
            lambda _, d: d + jnp.min(distances(d), axis=0) / stretch,
            jnp.zeros_like(stretch),
        )
        point, distance = eye[:, None] + depth * rays, distances(depth)
        hit = (jnp.min(distance, axis=0) < HIT_M) & (depth < FARTHEST_M)
        # The gradient of the distance is the surface's normal.
        normal = jax.grad(lambda p: jnp.sum(jnp.min(signed_distances(world.obstacles, p), axis=0)))(
            point
        )
        facing = jnp.abs(jnp.sum(normal * rays, axis=0)) / stretch
        return depth, hit, jnp.argmin(distance, axis=0), facing

    depth, hit, nearest, facing = (np.asarray(a) for a in trace(rays, stretch))
    # A lamp on the camera: surfaces that face it are brighter.
    palette = np.array([list(c[:3]) if c else [0.5, 0.5, 0.5] for c in world.colors])
    color = palette[nearest] * (0.45 + 0.55 * facing[:, None])
    color = np.where(hit[:, None], color, SKY)
    shape = (camera.height, camera.width)
    return color.reshape(*shape, 3), np.where(hit, depth, np.inf).reshape(shape)


def _pixel_rays(camera: Camera) -> tuple[jax.Array, jax.Array]:
    """The camera's center (3,), and rays (3, H * W) in the world with a depth of 1 [m]."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    center, focal = np.asarray(camera.principal_point), float(camera.focal)
    in_cam = np.stack([(x - center[0]) / focal, (y - center[1]) / focal, np.ones_like(x)], -1)
    rotation = np.asarray(camera.world_to_cam[:3, :3])
    eye = jnp.asarray(-rotation.T @ np.asarray(camera.world_to_cam[:3, 3]))
    return eye, jnp.asarray((in_cam.reshape(-1, 3) @ rotation).T, jnp.float32)


def along(world: World, path: np.ndarray, num: int) -> np.ndarray:
    """``num`` configurations at equal distances along a path (P, D)."""
    path = np.asarray(path, np.float32)
    # Length of the path up to each point; continuous joints take the shorter direction.
    step = np.asarray(difference(world, jnp.asarray(path[:-1]), jnp.asarray(path[1:])))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(step, axis=1))])
    at = np.linspace(0.0, length[-1], num)
    # The segment that holds each length, and how far along the segment it is.
    index = np.clip(np.searchsorted(length, at, side="right") - 1, 0, max(len(step) - 1, 0))
    if len(step) == 0 or length[-1] == 0:
        return np.repeat(path[:1], num, axis=0)
    share = (at - length[index]) / np.maximum(length[index + 1] - length[index], 1e-9)
    return path[index] + share[:, None] * step[index]


def save_animation(
    problem: Problem, result: PlanResult, path: str | Path, *, height: int = 300, frames: int = 40
) -> bool:
    """Write a GIF: the motion in the scene, with the goal image beside it.

    Args:
        problem: the problem.
        result: its plan.
        path: of the ``.gif``.
        height: of the picture [px].
        frames: number of pictures.

    Returns:
        Whether the robot is drawn with its true meshes.
    """
    camera = squared(problem.cameras[0])
    camera = shrunk(camera, max(1, round(camera.height / height)))
    painter = ScenePainter(problem.robot, problem.world, problem.self_model, camera)
    goal = over_sky(problem.goal_images[0], (camera.width, camera.height))
    separator = np.full((camera.height, 4, 3), 255, np.uint8)
    goal = _captioned(goal, "goal image")
    pictures = [
        Image.fromarray(
            np.concatenate([_captioned(painter.paint(q), "path"), separator, goal], axis=1)
        )
        for q in along(problem.world, result.path, frames)
    ]
    # The first and the last picture stay longer [ms].
    durations = [600, *[60] * (len(pictures) - 2), 1500]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=True
    )
    return painter.uses_meshes


def _captioned(picture: np.ndarray, words: str) -> np.ndarray:
    """A picture (H, W, 3) uint8 with words in its upper left corner."""
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text(
        (8, 6), words, fill="black", font_size=18, stroke_fill="white", stroke_width=2
    )
    return np.asarray(image)


def over_sky(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A goal image over the sky's color, resized: (H, W, 3) uint8."""
    image = np.asarray(image, np.float32)
    if image.shape[2] == 4:
        image = image[..., :3] * image[..., 3:] + SKY * (1 - image[..., 3:])
    pixels = np.round(255 * np.clip(image[..., :3], 0, 1)).astype(np.uint8)
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))


def save_figure(problem: Problem, result: PlanResult, path: str | Path) -> None:
    """Write a figure of a plan.

    It shows the start, the goal image, the rendered end and their difference; the loss over the
    iterations; and tree and path in two planes of joints.

    Args:
        problem: the problem.
        result: its plan.
        path: of the picture.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(13, 7.2), constrained_layout=True)
    grid = figure.add_gridspec(2, 4, height_ratios=(1, 1.05))
    _draw_images(figure, grid, problem, result)
    _draw_loss(figure.add_subplot(grid[1, :2]), result)
    # The planes of the four joints that move most; fewer joints repeat.
    names = problem.robot.joint_names
    spread = np.ptp(result.path, axis=0)
    order = np.argsort(-spread, kind="stable")
    a, b, c, d = np.resize(order, 4)
    planes = [(a, b), (c, d)]
    for column, (a, b) in enumerate(planes):
        _draw_tree(figure.add_subplot(grid[1, 2 + column]), result, (int(a), int(b)), names)
    verdict = result.status.name
    if result.verification is not None and result.ok:
        verdict += f", verified with {result.verification.geometry}"
    figure.suptitle(
        f"{problem.name}: {verdict}; {result.cost:.2f} rad in {len(result.path)} waypoints, "
        f"search {result.timing['search_s']:.1f} s"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_images(figure, grid, problem: Problem, result: PlanResult) -> None:
    """The upper row: start, goal image, rendered end, and difference."""
    camera = squared(problem.cameras[0])
    camera = shrunk(camera, max(1, round(camera.height / 240)))
    goal, _ = prepare_goal([problem.goal_images[0]], [problem.cameras[0]], camera.height)
    painter = ScenePainter(problem.robot, problem.world, problem.self_model, camera)
    splats = problem.self_model.level_for(camera.height).splats
    end = link_poses(problem.robot.chain, jnp.asarray(result.q_goal, jnp.float32))
    rgb, alpha = (np.asarray(a) for a in jax.jit(render)(splats, end, camera))
    goal_rgb, goal_alpha = np.asarray(goal.rgb[0]), np.asarray(goal.alpha[0])
    apart = np.abs(rgb - goal_rgb).mean(-1) + np.abs(alpha - goal_alpha)
    panels = (
        ("start", painter.paint(result.path[0])),
        ("goal image", goal_rgb + SKY * (1 - goal_alpha[..., None])),
        ("end, drawn by the self-model", rgb + SKY * (1 - alpha[..., None])),
        ("difference", apart),
    )
    for column, (title, picture) in enumerate(panels):
        axes = figure.add_subplot(grid[0, column])
        if picture.ndim == 2:
            axes.imshow(picture, cmap="magma", vmin=0, vmax=1)
        else:
            axes.imshow(np.clip(picture, 0, 1) if picture.dtype != np.uint8 else picture)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()


def _draw_loss(axes, result: PlanResult) -> None:
    """The best loss over the iterations, and the threshold of a match."""
    history = result.history
    axes.semilogy(history[:, 0], history[:, 2], color="tab:blue", label="best loss in the tree")
    axes.axhline(
        result.search_match_threshold, color="tab:green", ls="--", lw=1, label="counts as matched"
    )
    axes.set_xlabel("iteration of the search")
    axes.set_ylabel("image loss")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _draw_tree(axes, result: PlanResult, joints: tuple[int, int], names: Sequence[str]) -> None:
    """Tree and path in the plane of two joints."""
    from matplotlib.collections import LineCollection

    # Edges from parents to children, colored by the child's loss.
    size = int(result.tree.size)
    q = np.asarray(result.tree.q)[:size][:, joints]
    parent = np.asarray(result.tree.parent)[:size]
    score = np.log10(np.asarray(result.tree.score)[:size] + 1e-9)
    child = np.flatnonzero(parent >= 0)
    edges = np.stack([q[parent[child]], q[child]], axis=1)
    lines = LineCollection(list(edges), cmap="viridis_r", linewidths=0.6, alpha=0.7)
    lines.set_array(score[child])
    axes.add_collection(lines)
    path = result.path[:, joints]
    axes.plot(path[:, 0], path[:, 1], "-", color="tab:red", lw=1.8)
    axes.plot(*path[0], "o", color="tab:red", ms=5)
    axes.plot(*path[-1], "*", color="tab:red", ms=11)
    axes.set_xlabel(f"{names[joints[0]]} [rad]")
    axes.set_ylabel(f"{names[joints[1]]} [rad]")
    axes.set_title("trees (bright: low loss) and path", fontsize=10)
    axes.autoscale()
    axes.grid(alpha=0.3)
