"""The independent check of a path in a home: C MuJoCo, the robot's own primitives, boxes of cells.

Nothing here shares code with the distances and spheres that the planners compute, so that an error
there cannot hide itself.
"""

import dataclasses
import threading

import mujoco
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene.robots import MobileRobot
from vrrt_jax.core.result import Verification
from vrrt_jax.scene.advance import NEAR, Near, first_touch, near_pairs
from vrrt_jax.scene.exact import COMPILING
from vrrt_jax.scene.exact_pairs import boxes_to_meshes, measure_rightly
from vrrt_jax.scene.exact_slots import lever_arms

STEP = 0.02  # [m] and [rad], largest distance between configurations of a trajectory, by joint
_WALL = 1.0  # [m] thickness of what stands around the map
_PENETRATION_TOLERANCE = 1e-6  # [m] deeper contacts count
_LIMIT_TOLERANCE = 1e-4  # [rad] or [m], trajectories come in float32
_STEP_TOLERANCE = 1e-4  # [rad] or [m]
_SLIDE_TOLERANCE = 3e-3  # [m] a base that drives like a car may slide sideways in a step
# Contact bits: of the home's cells and of its floor; the robot's file says what sees which.
_CELL_BIT, _FLOOR_BIT = 4, 8


class ExactScene:
    """A robot and a home in C MuJoCo; every thread that asks works on data of its own."""

    def __init__(self, robot: MobileRobot, grid: Grid):
        """Compile the scene; the snake sees the planar map."""
        spec = mujoco.MjSpec.from_string(robot.xml)
        with COMPILING:
            boxes_to_meshes(spec)
        if robot.planar:
            grid = grid.flatten()
        self.robot = robot
        # All is measured from the corner of the map, wherever it lies.
        self.corner = np.array(grid.origin[:2])
        grid = dataclasses.replace(grid, origin=(0.0, 0.0, grid.origin[2]))
        for low, high in _solid_boxes(grid, robot.planar):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=(low + high) / 2,
                size=(high - low) / 2,
                contype=_CELL_BIT,
                conaffinity=0,
            )
        if not robot.planar:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], contype=_FLOOR_BIT, conaffinity=0
            )
        for geom in spec.geoms:
            geom.margin = NEAR / 2  # contacts are reported from afar; those of a pair add up
        with COMPILING:
            self.model = spec.compile()
        measure_rightly(self.model)
        self.lever_arms = lever_arms(self.model)  # (D, nbody, nbody)
        self._own = threading.local()

    def near(self, q: np.ndarray) -> Near:
        """Distances (c,) [m] and pairs of bodies (c, 2) that are near at ``q`` (D,)."""
        local = np.array(q, np.float64)
        local[:2] -= self.corner
        return near_pairs(self.model, self._data(), local)

    def _data(self) -> mujoco.MjData:
        """What this thread computes in."""
        own = vars(self._own)
        if "data" not in own:
            own["data"] = mujoco.MjData(self.model)
        return own["data"]

    def touching(self, q: np.ndarray) -> list[tuple[int, int]]:
        """Pairs of bodies, smaller index first, that penetrate each other at ``q`` (D,).

        The home is body 0. Pairs come in the order of MuJoCo's contacts.
        """
        distance, bodies = self.near(q)
        bodies = np.sort(bodies[distance < -_PENETRATION_TOLERANCE], axis=1)
        return list(dict.fromkeys((int(first), int(second)) for first, second in bodies))

    def nearest_contact(self, q: np.ndarray) -> str:
        """Words for the pair that is nearest at ``q`` (D,), where it lies and how far apart.

        Pairs farther apart than 0.05 m are not seen; "" if there is none.
        """
        distance, bodies = self.near(q)
        if not len(distance):
            return ""
        nearest = int(np.argmin(distance))
        pair = np.sort(bodies[nearest])
        words = self.describe((int(pair[0]), int(pair[1])))
        # The home is body 0: its place tells which cell it is.
        if not pair[0]:
            at = self._data().contact.pos[nearest] + np.append(self.corner, 0.0)
            words += f" at ({', '.join(f'{v:.2f}' for v in at[: 2 if self.robot.planar else 3])})"
        if distance[nearest] < -_PENETRATION_TOLERANCE:
            return words
        apart = 1e3 * max(float(distance[nearest]), 0.0)
        return f"{words.replace(' touches ', ' is too near to ')}, {apart:.1f} mm apart"

    def describe(self, pair: tuple[int, int]) -> str:
        """Words for a pair of bodies: "link3 touches the map"."""
        first, second = (self.model.body(body).name if body else "the map" for body in pair)
        return f"{second} touches {first}"


def verify(
    scene: ExactScene,
    trajectory: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
) -> Verification:
    """Check a fine trajectory: limits, steps, how the base may roll, and contacts.

    Between two of its configurations the robot goes straight. Two bodies approach each other
    between two checks by no more than their distance, or by 0.5 mm if they are nearer. So no
    contact deeper than 0.25 mm is missed, however far the arm reaches, however thin the wall.

    Args:
        scene: robot and home.
        trajectory: (T, D) configurations, no farther apart than 0.02 m or rad in any joint.
        lower: (D,) limits [rad] or [m]; those of joints that turn for ever are ignored.
        upper: (D,) limits [rad] or [m].
    """
    trajectory = np.asarray(trajectory, np.float64)
    if violation := _motion_violation(scene.robot, trajectory, lower, upper):
        return Verification(ok=False, checked=min(len(trajectory), 1), contact=violation)
    turns, checked = np.zeros_like(trajectory), 0
    turns[:-1] = _short_steps(scene.robot, trajectory)
    tolerance = _PENETRATION_TOLERANCE
    for index, (q, turn) in enumerate(zip(trajectory, turns, strict=True)):
        at, looked = first_touch(
            scene.near, scene.lever_arms, q, turn, step=1.0, tolerance=tolerance
        )
        checked += looked
        if at is not None:
            share = 100 * (index + at) / max(len(trajectory) - 1, 1)
            pair = scene.touching(q + at * turn)[0]
            contact = f"{scene.describe(pair)} at {share:.0f} % of the path"
            return Verification(ok=False, checked=checked, contact=contact)
    return Verification(ok=True, checked=checked, contact=None)


def _short_steps(robot: MobileRobot, trajectory: np.ndarray) -> np.ndarray:
    """Steps (T - 1, D) between configurations, of joints that wrap the short way round."""
    step, is_continuous = np.diff(trajectory, axis=0), np.asarray(robot.is_continuous)
    step[:, is_continuous] = (step[:, is_continuous] + np.pi) % (2 * np.pi) - np.pi
    return step


def _motion_violation(
    robot: MobileRobot,
    trajectory: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> str | None:
    """What is wrong with a trajectory (T, D) before contacts are asked for."""
    if not np.isfinite(trajectory).all():
        return "the path is not finite"
    is_continuous = np.asarray(robot.is_continuous)
    outside = (
        (trajectory < lower - _LIMIT_TOLERANCE) | (trajectory > upper + _LIMIT_TOLERANCE)
    ) & (~is_continuous)
    if outside.any():
        joint = int(np.argwhere(outside)[0, 1])
        return f"{robot.joint_names[joint]} leaves its limits"
    step = _short_steps(robot, trajectory)
    if (np.abs(step) > STEP * 1.01 + _STEP_TOLERANCE).any():
        return f"the path has a gap of {np.abs(step).max():.3f}"
    # A base that slides goes anywhere. One that turns rolls along its heading in mid-step.
    if robot.base_dim == 2:
        return None
    middle = trajectory[:-1, 2] + step[:, 2] / 2
    sideways = np.abs(step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle))
    if (sideways > _SLIDE_TOLERANCE).any():
        return f"the base slides sideways by {sideways.max():.4f} m in a step"
    return None


def _solid_boxes(grid: Grid, planar: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    """Boxes (corner, corner) that are the solid cells, and four around the map.

    Those of a planar map are around z = 0, where a planar robot is.
    """
    origin = np.array(grid.origin)
    if planar:
        origin[2] = 0.0
    tall = np.array([0.0, 0.0, 1.0]) if planar else np.zeros(3)
    boxes = [
        (origin + low * grid.resolution - tall, origin + high * grid.resolution + tall)
        for low, high in merge_cells(grid.occupied)
    ]
    # Four walls around the map, higher and deeper than it.
    first, last = origin.copy(), origin + grid.size
    first[2], last[2] = first[2] - _WALL, last[2] + 3 * _WALL
    for axis in (0, 1):
        for side in (0, 1):
            low, high = first.copy(), last.copy()
            other = 1 - axis
            low[other], high[other] = low[other] - _WALL, high[other] + _WALL
            low[axis], high[axis] = (
                (last[axis], last[axis] + _WALL) if side else (first[axis] - _WALL, first[axis])
            )
            boxes.append((low, high))
    return boxes


def merge_cells(occupied: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Disjoint boxes of cells, as first and last index + 1, that make up the solid ones.

    Runs along x, joined along y and then along z where they are alike.
    """
    # Where a run of solid cells along x begins (1) and where it has ended (-1).
    padded = np.pad(occupied, [(1, 1), (0, 0), (0, 0)]).astype(np.int8)
    change = np.moveaxis(np.diff(padded, axis=0), 0, 2)  # (Y, Z, X + 1)
    first, last = np.argwhere(change == 1), np.argwhere(change == -1)
    one = np.ones(len(first), int)
    y, z, x = first.T
    boxes = np.stack([x, last[:, 2], y, y + one, z, z + one], axis=1)
    boxes = _joined(_joined(boxes, 2), 4)
    return [(box[::2], box[1::2]) for box in boxes]


def _joined(boxes: np.ndarray, column: int) -> np.ndarray:
    """Join boxes (n, 6) that differ in one extent only, where one ends and the next begins."""
    if not len(boxes):
        return boxes
    others = [c for c in range(6) if c not in (column, column + 1)]
    boxes = boxes[np.lexsort([boxes[:, column], *boxes[:, others].T])]
    # A box continues the one before if all other extents agree and it begins where that one ends.
    alike = (boxes[1:, others] == boxes[:-1, others]).all(axis=1)
    follows = alike & (boxes[1:, column] == boxes[:-1, column + 1])
    begins = np.flatnonzero(np.concatenate([[True], ~follows]))
    ends = np.concatenate([begins[1:], [len(boxes)]]) - 1
    joined = boxes[begins].copy()
    joined[:, column + 1] = boxes[ends, column + 1]
    return joined
