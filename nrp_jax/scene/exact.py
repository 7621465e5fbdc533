"""The last word on a path: C MuJoCo, the robot's own primitives, every solid cell as a box.

Nothing here shares code with the distances and spheres that the planners compute, so that an error
there cannot hide itself.
"""

import mujoco
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene.robots import MobileRobot
from vrrt_jax.core.result import Verification

STEP = 0.02  # [m] and [rad], how fine a trajectory must be
_WALL = 1.0  # [m] thickness of what stands around the map
_SLACK = 1e-6  # [m] deeper contacts count


class ExactScene:
    """A robot among boxes in C MuJoCo."""

    def __init__(self, robot: MobileRobot, grid: Grid):
        """Compile the scene; the snake sees the planar map."""
        spec = mujoco.MjSpec.from_string(robot.xml)
        if robot.planar:
            grid = grid.flatten()
        self.robot = robot
        for low, high in _solid_boxes(grid, robot.planar):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=(low + high) / 2,
                size=(high - low) / 2,
                contype=4,
                conaffinity=0,
            )
        if not robot.planar:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], contype=8, conaffinity=0
            )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def touching(self, q: np.ndarray) -> str | None:
        """What touches what at ``q`` (D,), if anything does."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        contacts = self.data.contact
        deep = np.flatnonzero(contacts.dist < -_SLACK)
        if not len(deep):
            return None
        bodies = [int(self.model.geom_bodyid[g]) for g in contacts.geom[deep[0]]]
        names = [self.model.body(b).name if b else "the map" for b in sorted(bodies)]
        return f"{names[1]} touches {names[0]}"


def verify(
    scene: ExactScene,
    trajectory: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
) -> Verification:
    """Check a fine trajectory: limits, steps, how the base may roll, and contacts.

    Args:
        scene: where it happens.
        trajectory: (T, D) configurations, no farther apart than 0.02 m or rad.
        lower: (D,) limits; those of joints that turn for ever are not looked at.
        upper: (D,) limits.
    """
    trajectory = np.asarray(trajectory, np.float64)
    problem = _motion_problem(scene.robot, trajectory, lower, upper)
    for index, q in enumerate(trajectory):
        if contact := problem or scene.touching(q):
            share = 100 * index / max(len(trajectory) - 1, 1)
            where = "" if problem else f" at {share:.0f} % of the path"
            return Verification(ok=False, checked=index + 1, contact=contact + where)
    return Verification(ok=True, checked=len(trajectory), contact=None)


def _motion_problem(
    robot: MobileRobot,
    trajectory: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> str | None:
    """What is wrong with a trajectory (T, D) before anything is touched."""
    if not np.isfinite(trajectory).all():
        return "the path is not finite"
    is_continuous = np.asarray(robot.is_continuous)
    outside = ((trajectory < lower - 1e-4) | (trajectory > upper + 1e-4)) & ~is_continuous
    if outside.any():
        joint = int(np.argwhere(outside)[0, 1])
        return f"{robot.joint_names[joint]} leaves its limits"
    step = np.diff(trajectory, axis=0)
    step[:, is_continuous] = (step[:, is_continuous] + np.pi) % (2 * np.pi) - np.pi
    if (np.abs(step) > STEP * 1.01 + 1e-4).any():
        return f"the path has a gap of {np.abs(step).max():.3f}"
    if robot.base_dim == 2:  # it slides; one that turns drives like a car
        return None
    middle = trajectory[:-1, 2] + step[:, 2] / 2
    sideways = np.abs(step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle))
    if (sideways > 3e-3).any():
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
    alike = (boxes[1:, others] == boxes[:-1, others]).all(axis=1)
    follows = alike & (boxes[1:, column] == boxes[:-1, column + 1])
    begins = np.flatnonzero(np.concatenate([[True], ~follows]))
    ends = np.concatenate([begins[1:], [len(boxes)]]) - 1
    joined = boxes[begins].copy()
    joined[:, column + 1] = boxes[ends, column + 1]
    return joined
