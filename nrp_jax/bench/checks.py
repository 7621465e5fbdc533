"""The ``nrp bench checks`` command: speed and errors of collision checks.

Three methods check the same random configurations: the batched check of the planners; a loop in
numpy over the same shapes; and C MuJoCo, with the robot's geoms and
the cells as boxes. The latter two are exact. A collision that one of them finds and the batched
check does not is a missed collision.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from nrp_jax.homes.grid import Grid, load_map
from nrp_jax.scene.exact import ExactScene
from nrp_jax.scene.robots import MobileRobot, load_robot
from nrp_jax.scene.world import batch_is_free, build_world
from vrrt_jax.core import command
from vrrt_jax.core.files import write_text
from vrrt_jax.core.planners.rrt import sample_configurations
from vrrt_jax.core.timing import best_ms, machine
from vrrt_jax.robots.kinematics import batch_link_poses

BATCH = 1024  # configurations of a batched check


class SphereLoop:
    """The exact check in numpy, a configuration at a time: spheres against the cells near them."""

    def __init__(self, robot: MobileRobot, grid: Grid):
        """Copy the map, with a solid rim around it, and the robot's spheres."""
        self.robot = robot
        self.grid = grid.flatten() if robot.planar else grid
        rim = 5
        self.solid = np.pad(
            self.grid.occupied, [(rim, rim), (rim, rim), (0, 0)], constant_values=True
        )
        self.corner = np.array(self.grid.origin) - rim * self.grid.resolution * np.array([1, 1, 0])
        self.link = np.asarray(robot.collision_spheres.link)
        self.center = np.asarray(robot.collision_spheres.center, float)
        self.radius = np.asarray(robot.collision_spheres.radius, float)
        self.chain = [
            np.asarray(getattr(robot.chain, name), float)
            for name in ("constant", "cosine", "sine", "slide")
        ]
        # Spheres of the arm, which must not touch the floor, and those of its boxes, nor the base.
        self.is_arm = ~np.isin(self.link, np.arange(robot.base_dim + 2)) & (not robot.planar)
        self.is_boxed = np.isin(self.link, robot.shapes.box_link if robot.shapes else ())

    def is_free(self, q: np.ndarray) -> bool:
        """Whether ``q`` (D,) is free."""
        # The robot against itself, and the spheres' centers.
        pose = self.poses(q)
        turned = pose[self.link]
        center = np.einsum("nij,nj->ni", turned[:, :3, :3], self.center) + turned[:, :3, 3]
        if planar_boxes_overlap(self.robot, pose) or shapes_overlap(self.robot, pose):
            return False
        # The arm against the floor, all spheres against the cells, and the base.
        if (center[self.is_arm, 2] <= self.radius[self.is_arm]).any():
            return False
        if any(self._hits(c, r) for c, r in zip(center, self.radius, strict=True)):
            return False
        base = self.robot.footprint
        return base is None or self._base_is_free(pose[base.link, :3, 3], center)

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Link poses (L, 4, 4)."""
        constant, cosine, sine, slide = self.chain
        poses = [np.eye(4)]
        for j, parent in enumerate(self.robot.chain.parents):
            local = (
                constant[j] + np.cos(q[j]) * cosine[j] + np.sin(q[j]) * sine[j] + q[j] * slide[j]
            )
            poses.append(poses[parent] @ local)
        return np.array(poses)

    def _hits(self, center: np.ndarray, radius: float, top: float | None = None) -> bool:
        """Whether a sphere, or an upright cylinder from the floor to ``top``, touches a cell."""
        flat = self.robot.planar or top is not None
        size, reach = self.grid.resolution, np.full(3, radius)
        place = (center - self.corner) / size
        # The range of cells that can be near enough.
        low = np.floor(place - reach / size).astype(int)
        high = np.floor(place + reach / size).astype(int) + 1
        if top is not None:
            floor = -self.corner[2]  # above the lowest layer
            low[2] = int(np.floor(floor / size + 1e-6))
            high[2] = int(np.ceil((floor + top) / size - 1e-6))
        elif flat:
            low[2], high[2] = 0, 1
        low, high = np.maximum(low, 0), np.minimum(high, self.solid.shape)
        # The distance to each solid cell in it, along x and y alone where heights do not count.
        cells = np.argwhere(self.solid[tuple(map(slice, low, high))]) + low
        gap = np.maximum(np.maximum(cells - place, place - cells - 1), 0) * size
        return bool(((gap[:, : 2 if flat else 3] ** 2).sum(1) < radius**2).any())

    def _base_is_free(self, position: np.ndarray, center: np.ndarray) -> bool:
        """Whether the round base at a position (3,) touches no cell, and no box's sphere (n, 3)."""
        base = self.robot.footprint
        assert base is not None
        radius, height = float(base.radius), float(base.height)
        beside = np.linalg.norm(center[:, :2] - position[:2], axis=1) - radius
        gap = np.hypot(np.maximum(beside, 0), np.maximum(center[:, 2] - height, 0))
        if (gap[self.is_boxed] < self.radius[self.is_boxed]).any():
            return False
        return not self._hits(position, radius, top=height)


def planar_boxes_overlap(robot: MobileRobot, poses: np.ndarray) -> bool:
    """Whether checked boxes overlap: no side of either has all corners of the other beyond it."""
    if robot.planar_boxes is None:
        return False
    corners = []
    for link, center, half in zip(
        robot.planar_boxes.link,
        *(np.asarray(a) for a in (robot.planar_boxes.center, robot.planar_boxes.half)),
        strict=True,
    ):
        local = center + half * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
        corners.append(local @ poses[link, :2, :2].T + poses[link, :2, 3])
    for i, j in robot.planar_boxes.pairs:
        both = (corners[i], corners[j])
        normals = [turned for c in both for turned in np.diff(c[:3], axis=0)]
        if all(
            (both[0] @ n).max() >= (both[1] @ n).min()
            and (both[1] @ n).max() >= (both[0] @ n).min()
            for n in normals
        ):
            return True
    return False


def shapes_overlap(robot: MobileRobot, poses: np.ndarray) -> bool:
    """Whether checked shapes overlap, the base with them: nearest points by trisection."""
    shapes = robot.shapes
    if shapes is None:
        return False
    num, radius = len(shapes.link), np.asarray(shapes.radius)
    rows = np.moveaxis(poses[:, :3], 1, 0).reshape(3, -1)
    ends = (rows @ np.asarray(shapes.ends, float)).T
    start, axis = ends[:num], ends[num:] - ends[:num]

    def to_segment(point: np.ndarray, capsule: np.ndarray) -> np.ndarray:
        beside, along = point - start[capsule], axis[capsule]
        share = (beside * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
        return np.linalg.norm(beside - np.clip(share, 0, 1)[:, None] * along, axis=1)

    def to_box(point: np.ndarray, box: np.ndarray) -> np.ndarray:
        pose = poses[np.array(shapes.box_link)[box]]
        turned = pose[:, :3, :3] @ np.asarray(shapes.box_rotation, float)[box]
        middle = np.einsum("nij,nj->ni", pose[:, :3, :3], np.asarray(shapes.box_center)[box])
        local = np.einsum("nji,nj->ni", turned, point - middle - pose[:, :3, 3])
        half = np.asarray(shapes.box_half, float)[box]
        return np.linalg.norm(local - np.clip(local, -half, half), axis=1)

    def to_base(point: np.ndarray) -> np.ndarray:
        base = robot.footprint
        if base is None:
            return np.full(len(point), np.inf)
        beside = np.linalg.norm(point[:, :2] - poses[base.link, :2, 3], axis=1) - base.radius
        return np.hypot(np.maximum(beside, 0), np.maximum(point[:, 2] - base.height, 0))

    first, second = np.array(shapes.pairs).T
    capsule, box = np.array(shapes.box_pairs).T
    apart = _trisect(lambda t: to_segment(start[first] + t[:, None] * axis[first], second), first)
    boxed = _trisect(lambda t: to_box(start[capsule] + t[:, None] * axis[capsule], box), capsule)
    arm = np.flatnonzero(np.array(shapes.link) > robot.base_dim + 1)
    above = _trisect(lambda t: to_base(start[arm] + t[:, None] * axis[arm]), arm)
    return bool(
        (apart < radius[first] + radius[second]).any()
        or (boxed < radius[capsule]).any()
        or (above < radius[arm]).any()
    )


def _trisect(distance: Callable[[np.ndarray], np.ndarray], pairs: np.ndarray) -> np.ndarray:
    """Least values (P,) of convex functions of a number in [0, 1]."""
    low, high = np.zeros(len(pairs)), np.ones(len(pairs))
    for _ in range(40):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        rises = distance(left) < distance(right)
        low, high = np.where(rises, low, left), np.where(rises, right, high)
    return distance((low + high) / 2)


def run(robot: MobileRobot, grid: Grid, num: int = 10_000, timed: int = 500) -> dict:
    """Compare the three methods on random configurations of a map.

    Args:
        robot: the robot.
        grid: the map.
        num: configurations to compare.
        timed: configurations to time the slow methods with.

    Returns:
        For each method ``checks_per_s`` [1/s] and ``free_share``; of the batched check the
        ``missed`` collisions and the ``false_alarm_share_of_free``, for either exact method; and
        ``links_us``, the microseconds that kinematics take for a configuration.

    Raises:
        ValueError: there is nothing to compare.
    """
    if num < 1:
        raise ValueError(f"num is {num}; expected at least 1 configuration")
    world = build_world(robot, grid)
    q = np.asarray(sample_configurations(world, jax.random.key(0), num))
    batched = np.concatenate([np.asarray(batch_is_free(world, b)) for b in _batches(q)])
    loop, scene = SphereLoop(robot, grid), ExactScene(robot, grid)
    by_loop = np.array([loop.is_free(row) for row in q])
    by_mujoco = np.array([not scene.touching(row) for row in q])
    batch, rows = q[:BATCH], q[:timed]
    rates = {
        "batched": _rate(len(batch), lambda: batch_is_free(world, batch), 20),
        "sphere_loop": _rate(len(rows), lambda: [loop.is_free(row) for row in rows], 3),
        "mujoco": _rate(len(rows), lambda: [scene.touching(row) for row in rows], 3),
    }
    return {
        "robot": robot.name,
        "configurations": num,
        "free_share": {
            "batched": float(batched.mean()),
            "sphere_loop": float(by_loop.mean()),
            "mujoco": float(by_mujoco.mean()),
        },
        "missed": {
            "sphere_loop": int((batched & ~by_loop).sum()),
            "mujoco": int((batched & ~by_mujoco).sum()),
        },
        "false_alarm_share_of_free": {
            "sphere_loop": float((~batched & by_loop).sum() / max(by_loop.sum(), 1)),
            "mujoco": float((~batched & by_mujoco).sum() / max(by_mujoco.sum(), 1)),
        },
        "checks_per_s": {k: round(v) for k, v in rates.items()},
        "batched_over_loop": round(rates["batched"] / rates["sphere_loop"], 1),
        "batched_over_mujoco": round(rates["batched"] / rates["mujoco"], 1),
        "links_us": _links_us(robot, batch),
    }


def add_arguments(subparsers) -> None:
    """Add ``checks`` to the bench command."""
    parser = subparsers.add_parser("checks", help="configuration checks: rate and errors")
    parser.set_defaults(run=_run_command)
    parser.add_argument("--map", help="a map; a random home by default")
    parser.add_argument(
        "--num", type=command.whole(1, 10_000_000), default=10_000, help="configurations compared"
    )
    parser.add_argument("--json", help="write the figures here")


def _run_command(arguments: argparse.Namespace) -> int:
    from nrp_jax.homes.houses import generate_house

    results = {}
    for name in ("snake", "fetch"):
        robot = load_robot(name)
        grid = load_map(arguments.map) if arguments.map else generate_house(0, name).grid
        if grid.planar and not robot.planar:
            continue
        results[name] = run(robot, grid, arguments.num)
        print(json.dumps(results[name], indent=1))
    results["machine"] = machine()
    if arguments.json:
        write_text(Path(arguments.json), json.dumps(results, indent=1) + "\n")
    return 0


def _batches(q: np.ndarray) -> list[np.ndarray]:
    return [q[i : i + BATCH] for i in range(0, len(q), BATCH)]


def _rate(num: int, function: Callable, repeats: int) -> float:
    """Configurations a second of a function that checks ``num`` of them."""
    best, _ = best_ms(function, repeats=repeats)
    return 1e3 * num / best


def _links_us(robot: MobileRobot, q: np.ndarray) -> float:
    """Microseconds a configuration that the kinematics alone take."""
    return round(1e6 / _rate(len(q), lambda: batch_link_poses(robot.chain, q), 20), 2)
