"""Draw the pictures of ``how_it_works.md`` from two plans: ``python docs/draw_pictures.py``."""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

import nrp_jax
import vrrt_jax
from nrp_jax import samplers
from nrp_jax import viz as homes_viz
from nrp_jax.homes.houses import generate_house
from nrp_jax.learning.difficulty import long_queries
from vrrt_jax import viz
from vrrt_jax.core.tree_file import nodes_of
from vrrt_jax.robots.kinematics import batch_link_poses
from vrrt_jax.splat.camera import project, shrunk, squared

PICTURES = Path(__file__).parent / "pictures"
HOME = 1_000_001  # seed of a home that no network was trained in
GREEN, RED, YELLOW, BLUE = "#2a9d8f", "#d1495b", "#e9c46a", "#4361ee"


def draw_visual_planner(path):
    """One plan to an image, stage by stage."""
    problem = vrrt_jax.load_problem("panda_posts", engine="closed_form")
    robot, world = problem.robot, problem.world
    result = vrrt_jax.plan(robot, world, problem.goal, problem.q_start, key=jax.random.key(0))
    assert result.ok
    camera = shrunk(squared(problem.cameras[0]), 1)
    painter = viz.ScenePainter(robot, world, problem.self_model, camera)
    goal = viz.over_sky(problem.goal_images[0], (camera.width, camera.height))
    at_start, at_end = painter.paint(problem.q_start), painter.paint(result.q_goal)

    def hands(q):
        """Where the hand is in the picture at configurations (n, D): (n, 2) [px]."""
        poses = batch_link_poses(robot.chain, jnp.asarray(q, jnp.float32))
        return np.asarray(project(camera, poses[:, -1, :3, 3])[0])

    nodes = nodes_of(result.tree)
    best = nodes.q[int(np.argmin(nodes.score))]
    true = painter.paint(problem.true_goal)  # the planner knows the image alone
    off = [
        3 * np.abs(painter.paint(q).astype(float) - true).mean(-1) for q in (best, result.q_goal)
    ]
    frames = np.stack([painter.paint(q) for q in viz.along(world, result.path, 3)])

    figure, axes = plt.subplots(1, 5, figsize=(20, 4.4), layout="constrained")
    panels = (
        ("1 given: start, and image of the goal", _halves(at_start, goal)),
        ("2 search", _faded(at_start)),
        ("3 polish: errors before and after", 255 - np.minimum(_halves(*off), 255)),
        ("4 join", _faded(at_end)),
        ("5 verify", frames.mean(0).astype(np.uint8)),
    )
    for panel, (title, picture) in zip(axes, panels, strict=True):
        panel.imshow(picture, cmap="gray", vmin=0, vmax=255)
        panel.set_title(title, fontsize=15, loc="left")
        panel.set_axis_off()
    at, child = hands(nodes.q), nodes.edges(3000)
    rank = np.argsort(np.argsort(-nodes.score))[child]  # bright where the image loss is low
    edges = np.stack([at[nodes.parent[child]], at[child]], axis=1)
    axes[1].add_collection(LineCollection(list(edges), cmap="plasma", array=rank, linewidths=0.4))
    axes[1].scatter(*at[child].T, c=rank, cmap="plasma", s=3, zorder=3)
    for panel, q, color in ((axes[3], result.raw_path, BLUE), (axes[4], result.path, RED)):
        panel.plot(*hands(viz.along(world, q, 200)).T, color=color, lw=2.5)
    figure.savefig(path, dpi=75)
    plt.close(figure)


def _halves(left, right):
    """The middle of two pictures (H, W, ...), side by side: as large as one of them."""
    width = left.shape[1]
    return np.concatenate([p[:, width // 4 : 3 * width // 4] for p in (left, right)], axis=1)


def _faded(picture):
    return (0.45 * picture + 0.55 * 255).astype(np.uint8)


def draw_homes_planner(path):
    """One plan through a home, stage by stage."""
    robot, house = nrp_jax.load_robot("snake"), generate_house(HOME, kind="snake")
    grid = house.plan()
    world = nrp_jax.build_world(robot, grid)
    starts, goals = long_queries(robot, world, grid, 4, HOME)
    start, goal = starts[1], goals[1]
    key = jax.random.key(0)
    result = nrp_jax.plan(robot, grid, start, goal, key=key, planner="nrp-connect", world=world)
    assert result.ok
    ends = (np.repeat(q[None], 32, axis=0) for q in (start, goal))
    sampler = samplers.load_sampler("snake", "cvae")
    proposed = np.asarray(samplers.propose(sampler, world, *ends, key))
    figure, axes = plt.subplots(1, 4, figsize=(20, 5.3), layout="constrained")
    titles = ("1 given", "2 waypoints", "3 search", "4 verify")
    for panel, title in zip(axes, titles, strict=True):
        homes_viz.draw_map(panel, grid)
        panel.set_title(title, fontsize=15, loc="left")
        panel.set_axis_off()
    axes[1].plot(*np.stack([start, goal])[:, :2].T, color="gray", ls="--", lw=1)
    for q in proposed[:8]:
        homes_viz.draw_robot(axes[1], robot, q, YELLOW, alpha=0.6)
    homes_viz.draw_tree(axes[2], world, result)
    axes[2].plot(*result.raw_path[:, :2].T, color=BLUE, lw=1.5)
    axes[3].plot(*result.trajectory[:, :2].T, color=RED, lw=1.5)
    for index in np.linspace(0, len(result.trajectory) - 1, 14).astype(int):
        homes_viz.draw_robot(axes[3], robot, result.trajectory[index], YELLOW, alpha=0.5)
    low, high = result.trajectory[:, :2].min(0) - 1.0, result.trajectory[:, :2].max(0) + 1.0
    for panel in axes:
        panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        homes_viz.draw_robot(panel, robot, start, GREEN)
        homes_viz.draw_robot(panel, robot, goal, RED)
    figure.savefig(path, dpi=75)
    plt.close(figure)


if __name__ == "__main__":
    draw_homes_planner(PICTURES / "homes_planner.png")
    draw_visual_planner(PICTURES / "visual_planner.png")
