"""Figures of plans: a home from above, the search tree in it, and the robot along its path."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from nrp_jax.homes.grid import Grid
from nrp_jax.planner import PlanResult
from nrp_jax.scene.nearest import shifted, working_world
from nrp_jax.scene.robots import MobileRobot
from nrp_jax.scene.world import GridWorld
from vrrt_jax.core.tree_file import Nodes, nodes_of

_EDGE_POINTS = 9  # drawn along an edge
_MAX_EDGES = 4000  # drawn of a tree
_MAX_PIXELS = 4000  # along the longer side of a map
_COLORS = {"map": "#3b4252", "above": "#c3c9d4", "tree": "#7aa6c2", "path": "#d1495b"}


def outlines(robot: MobileRobot, q: np.ndarray) -> list[np.ndarray]:
    """The robot from above: a convex polygon (n, 2) for each of its geoms [m].

    Args:
        robot: from :func:`nrp_jax.load_robot`.
        q: (D,) configuration.
    """
    model = mujoco.MjModel.from_xml_string(robot.xml)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    polygons = []
    for geom in range(model.ngeom):
        points = _outer_points(mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom])
        points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        flat = points[:, :2]
        polygons.append(flat[ConvexHull(flat, qhull_options="QJ").vertices])
    return polygons


def draw_map(axes, grid: Grid) -> None:
    """Draw a map from above; cells that are solid only above 0.4 m are lighter.

    Args:
        axes: of matplotlib.
        grid: the map; for a planar robot the part that it meets, ``grid.flatten()``.
    """
    low = grid.flatten(z_high=0.4).occupied[:, :, 0]
    seen = grid.occupied.any(axis=2)
    # A picture has few pixels: one stands for several cells of a large map.
    block = -(-max(seen.shape) // _MAX_PIXELS)
    low, seen = (_shrunk(np.asarray(cells), block) for cells in (low & seen, seen))
    image = np.ones((*seen.shape, 3))
    image[seen] = _rgb(_COLORS["above"])
    image[low] = _rgb(_COLORS["map"])
    left, bottom = grid.origin[:2]
    right, top = np.array(grid.origin[:2]) + grid.size[:2]
    axes.imshow(
        np.swapaxes(image, 0, 1),
        origin="lower",
        extent=(left, right, bottom, top),
        interpolation="nearest",
    )
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def draw_robot(axes, robot: MobileRobot, q: np.ndarray, color: str, alpha: float = 0.8) -> None:
    """Draw the robot at ``q`` (D,) from above."""
    from matplotlib.patches import Polygon

    for polygon in outlines(robot, q):
        axes.add_patch(
            Polygon(
                polygon, facecolor=color, edgecolor="black", linewidth=0.3, alpha=alpha, zorder=3
            )
        )


def draw_tree(axes, world: GridWorld, result: PlanResult) -> None:
    """Draw the path of the base along the edges of the search tree."""
    from matplotlib.collections import LineCollection

    nodes = nodes_of(result.tree)
    child = nodes.edges(_MAX_EDGES)
    if not len(child):
        return
    lines = list(base_lines(world, nodes, child))
    axes.add_collection(LineCollection(lines, colors=_COLORS["tree"], linewidths=0.5))


def base_lines(world: GridWorld, nodes: Nodes, child: np.ndarray) -> np.ndarray:
    """The way of the base (E, P, 2) [m] along the edges that lead to some nodes (E,)."""
    world, corner = working_world(world)
    q = shifted(nodes.q, -corner).astype(np.float32)
    fraction = jnp.linspace(0, 1, _EDGE_POINTS)[None]
    lines = jax.jit(lambda w, a, b: w.interpolate(a[:, None], b[:, None], fraction))(
        world, q[nodes.parent[child]], q[child]
    )
    return shifted(np.asarray(lines), corner)[..., :2]


def save_plan(
    path: str | Path,
    robot: MobileRobot,
    grid: Grid,
    world: GridWorld,
    result: PlanResult,
    q_goal: np.ndarray,
    *,
    robots: int = 12,
) -> None:
    """Write a figure of a plan: map, tree, path and the robot along it.

    Args:
        path: a .png, .pdf or .svg file.
        robot: from :func:`nrp_jax.load_robot`.
        grid: the home.
        world: the robot in it.
        result: from :func:`nrp_jax.plan`.
        q_goal: (D,) goal.
        robots: how many are drawn along the path.
    """
    import matplotlib

    matplotlib.use("Agg", force=False)
    import matplotlib.pyplot as plt

    # The longer side is 8 inches; the shorter one leaves room for axes on the narrowest map.
    width, height = np.maximum(8 * grid.size[:2] / grid.size[:2].max(), 1.5)
    figure, axes = plt.subplots(figsize=(width, height + 0.6), layout="constrained")
    draw_map(axes, grid.flatten() if robot.planar else grid)
    draw_tree(axes, world, result)
    trajectory = result.trajectory
    axes.plot(*trajectory[:, :2].T, color=_COLORS["path"], linewidth=1.5)
    for index in np.linspace(0, len(trajectory) - 1, min(robots, len(trajectory))).astype(int):
        draw_robot(axes, robot, trajectory[index], "#e9c46a", alpha=0.5)
    draw_robot(axes, robot, trajectory[0], "#2a9d8f")
    draw_robot(axes, robot, q_goal, _COLORS["path"])
    axes.set_title(
        f"{result.status.name.lower()}: {result.cost:.1f} m, {result.expansions} expansions, "
        f"{result.timing['search_s']:.2f} s search"
    )
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _outer_points(kind: mujoco.mjtGeom, size: np.ndarray) -> np.ndarray:
    """Points (n, 3) whose convex hull is nearly the geom, in its frame [m]."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.array(np.meshgrid(*[(-h, h) for h in size])).reshape(3, -1).T
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    tilt = np.linspace(-np.pi / 2, np.pi / 2, 7)
    ball = np.stack(
        [
            np.outer(np.cos(tilt), np.cos(angle)).ravel(),
            np.outer(np.cos(tilt), np.sin(angle)).ravel(),
            np.repeat(np.sin(tilt), len(angle)),
        ],
        axis=1,
    )
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return size[0] * ball
    half = np.array([0.0, 0.0, size[1]])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.concatenate([size[0] * ball + half, size[0] * ball - half])
    ring = size[0] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return np.concatenate([ring + half, ring - half])


def _shrunk(cells: np.ndarray, block: int) -> np.ndarray:
    """Cells (X, Y) bool in blocks, True where any of a block is."""
    padded = np.pad(cells, [(0, -side % block) for side in cells.shape])
    x, y = (side // block for side in padded.shape)
    return np.asarray(padded.reshape(x, block, y, block).any(axis=(1, 3)))


def _rgb(color: str) -> tuple[float, ...]:
    """Red, green and blue in [0, 1] of a color such as "#3b4252"."""
    return tuple(int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
