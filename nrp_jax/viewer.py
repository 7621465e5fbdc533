"""A plan in a home in the browser: the map, the tree, and the robot along its path."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from nrp_jax.homes.grid import Grid, load_map
from nrp_jax.planner import PlanResult
from nrp_jax.scene.exact import merge_cells
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import GridWorld, build_world
from nrp_jax.viz import base_lines
from vrrt_jax.core.command import LARGEST
from vrrt_jax.core.data_file import read_json
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.tree_file import Nodes, load_nodes, nodes_of
from vrrt_jax.scene.page import Page, colors_of

PICTURES = 301  # along a path, at most: ten seconds of play
MOST_EDGES = 50_000  # drawn of a tree
_MAP, _PATH = (150, 158, 175), (214, 40, 57)
_WALL_M = 0.3  # height of the walls of a planar map [m]
_LIFT_M = 0.02  # of lines above the floor [m]
# The corners of a box, and two triangles for each face, seen from outside.
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


@single_precision
def view(
    result: PlanResult,
    robot: MobileRobot,
    grid: Grid,
    *,
    world: GridWorld | None = None,
    port: int | None = None,
) -> Page:
    """Show a plan in a home on a page in the browser, which only this machine can reach.

    The last expression of a notebook's cell shows itself. A script calls ``view(...).serve()``,
    which waits until Ctrl-C.

    Args:
        result: from :func:`nrp_jax.plan`.
        robot: from :func:`nrp_jax.load_robot`.
        grid: the home.
        world: the robot in it; built if None.
        port: of 127.0.0.1; a free one if None.

    Raises:
        ModuleNotFoundError: viser is not installed.
        OSError: the port is taken.
    """
    world = build_world(robot, grid) if world is None else world
    numbers = outcome(result)
    return _page(robot, grid, world, result.trajectory, nodes_of(result.tree), numbers, port)


@single_precision
def view_folder(folder: Path, *, port: int | None = None) -> Page:
    """Show what ``nrp plan --out FOLDER`` wrote, see :func:`view`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged.
    """
    file = folder / "path.json"
    if not file.is_file():
        raise FileNotFoundError(
            f"no plan at '{folder}': it has no path.json; write one with: nrp plan --out FOLDER"
        )
    try:
        record = dict(read_json(file))
        robot = load_robot(record.pop("robot"))
        trajectory = np.array(record.pop("trajectory"), float)
        del record["path"]
        record["status"]  # noqa: B018 - it raises where there is none
        if trajectory.ndim != 2 or trajectory.shape[1] != robot.num_joints:
            raise ValueError(f"its trajectory has shape {trajectory.shape}")
        if not (len(trajectory) and np.abs(trajectory).max() < LARGEST):
            raise ValueError("its trajectory is empty, or has numbers that are none or too large")
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"'{file}' is no readable plan ({error}); plan again") from None
    grid = load_map(folder / "map.npz")
    nodes = load_nodes(folder / "tree.npz", robot.num_joints)
    return _page(robot, grid, build_world(robot, grid), trajectory, nodes, record, port)


def outcome(result: PlanResult) -> dict[str, Any]:
    """What the result itself says, ready for JSON."""
    return {
        "status": result.status.name,
        "refused": result.refused,
        "verified": bool(result.verification and result.verification.ok),
        "cost": round(result.cost, 4),
        "expansions": result.expansions,
        "nodes": int(result.tree.size),
        "timing": {k: round(v, 4) for k, v in result.timing.items()},
    }


def _page(
    robot: MobileRobot,
    grid: Grid,
    world: GridWorld,
    trajectory: np.ndarray,
    nodes: Nodes,
    numbers: Mapping[str, Any],
    port: int | None,
) -> Page:
    page = Page(f"{robot.name}: {numbers['status']}", port)
    try:
        page.add_mesh("map", *map_mesh(grid.flatten() if robot.planar else grid), _MAP)
        every = np.linspace(0, len(trajectory) - 1, min(PICTURES, len(trajectory))).astype(int)
        model = mujoco.MjModel.from_xml_string(robot.xml)
        page.add_robot(model, groups=range(mujoco.mjNGROUP))
        page.show_trajectory(trajectory[every])
        child = nodes.edges(MOST_EDGES)
        colors = colors_of(nodes.score[child])
        page.show_lines("tree", _lifted(base_lines(world, nodes, child)), colors, 1.0)
        page.show_lines("path", _lifted(trajectory[None, :, :2]), np.array(_PATH), 4.0)
        page.show_numbers(numbers)
        # From the south, high above the middle of the map.
        middle = np.array([*grid.origin[:2], 0.0]) + grid.size * [0.5, 0.5, 0.0]
        page.look_from(middle + grid.size[:2].max() * np.array([0.0, -0.6, 0.9]), middle)
    except BaseException:
        page.close()
        raise
    return page


def _lifted(lines: np.ndarray) -> np.ndarray:
    """Lines (E, P, 2) a little above the floor, (E, P, 3)."""
    return np.concatenate([lines, np.full((*lines.shape[:2], 1), _LIFT_M)], axis=2)


def map_mesh(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The solid cells as boxes: vertices (n, 3) [m] and triangles (m, 3) int.

    Cells of a planar map are low walls on the floor.
    """
    boxes = np.array(merge_cells(grid.occupied), float).reshape(-1, 2, 3)
    if grid.planar:
        boxes = boxes * [grid.resolution, grid.resolution, _WALL_M] + [*grid.origin[:2], 0.0]
    else:
        boxes = boxes * grid.resolution + grid.origin
    low, high = boxes[:, :1], boxes[:, 1:]
    vertices = low + _CORNERS * (high - low)
    faces = _FACES + 8 * np.arange(len(boxes))[:, None, None]
    return vertices.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.uint32)
