"""A robot and what stands around it in plain C MuJoCo, looked at everywhere: slow, and simple.

Nothing of the package's exact check is used: no slots, no distances that vouch for steps, no merged
boxes. Models are compiled anew, with what stands around fixed to the world.
"""

import itertools

import mujoco
import numpy as np

from nrp_jax.homes.grid import Grid
from nrp_jax.scene.robots import MobileRobot
from vrrt_jax.robots.mesh_sources import mesh_spec
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.obstacles import Obstacle

NEAR = 2e-3  # [m] nearer than this is looked at ten times as finely again
FINER = 10
_TYPES = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}
_SIZES = {"plane": (1.0, 1.0, 1.0)}


class PlainScene:
    """Smallest distances of all pairs that may not touch."""

    def __init__(self, spec: mujoco.MjSpec, corner=(0.0, 0.0)):
        """Compile it; ``corner`` (2,) is subtracted from the first two joints."""
        for k, geom in enumerate(spec.geoms):
            geom.margin = NEAR / 2
            # Of two boxes MuJoCo knows no distance; of a box and a mesh of its corners it does.
            if geom.type == mujoco.mjtGeom.mjGEOM_BOX and geom.parent != spec.worldbody:
                half = np.array(geom.size) * np.array(list(itertools.product((-1, 1), repeat=3)))
                spec.add_mesh(name=f"corners {k}", uservert=half.ravel())
                geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, f"corners {k}"
        spec.memory = 1 << 23
        self.model = spec.compile()
        # The contacts that MuJoCo adds to the right one are off by millimeters.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
        self.data = mujoco.MjData(self.model)
        self.corner = np.asarray(corner, float)

    def distances(self, configurations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of each configuration (n, D), to the world (n,) and of the robot to itself (n,) [m].

        ``NEAR`` where nothing is nearer; negative where bodies are in each other.
        """
        found = np.full((len(configurations), 2), NEAR)
        model, data = self.model, self.data
        moved = np.array(configurations, np.float64)
        if self.corner.any():
            moved[:, :2] -= self.corner
        for row, q in zip(found, moved, strict=True):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                contact = data.contact
                own = (model.geom_bodyid[contact.geom] != 0).all(axis=1)
                row[0] = min(NEAR, contact.dist[~own].min(initial=NEAR))
                row[1] = min(NEAR, contact.dist[own].min(initial=NEAR))
        return found[:, 0], found[:, 1]

    def depth(self, path: np.ndarray, step: float) -> float:
        """How deep something is in something else on a path (P, D) of straight pieces [m].

        Negative is the smallest distance, ``-NEAR`` at most. Configurations are ``step`` apart, and
        a tenth of it where anything is nearer than ``NEAR``.
        """
        smallest = min(d.min() for d in self.distances(path[:1]))
        for q, turn in zip(path[:-1], np.diff(path, axis=0), strict=True):
            count = max(1, int(np.ceil(np.linalg.norm(turn) / step)))
            coarse = np.arange(count + 1) / count
            nearest = np.minimum(*self.distances(q + coarse[:, None] * turn))
            finer = np.arange(-FINER // 2, FINER // 2 + 1) / (FINER * count)
            near = np.clip(coarse[nearest < NEAR][:, None] + finer, 0, 1).ravel()
            near = q + np.unique(near)[:, None] * turn
            smallest = min(smallest, *(d.min(initial=NEAR) for d in self.distances(near)))
        return -smallest


def plain_arm(robot: Robot, obstacles: list[Obstacle]) -> PlainScene:
    """An arm with its true meshes, which have to be installed, among obstacles."""
    spec = mesh_spec(robot, visuals=False)
    assert spec is not None, f"the meshes of {robot.name} are not installed"
    for pair in robot.ignored_pairs:
        if all(spec.body(name) is not None for name in pair):
            spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
    for obstacle in obstacles:
        spec.worldbody.add_geom(
            type=_TYPES[obstacle.kind],
            size=_SIZES.get(obstacle.kind, obstacle.size),
            pos=obstacle.position,
            quat=obstacle.quaternion,
            contype=0x7FFFFFFF,
            conaffinity=0x7FFFFFFF,
        )
    return PlainScene(spec)


def plain_home(robot: MobileRobot, grid: Grid) -> PlainScene:
    """A mobile robot in a home: boxes of runs of solid cells, and a wide ring of walls."""
    spec = mujoco.MjSpec.from_string(robot.xml)
    solid, cell = np.asarray(grid.occupied, bool), grid.resolution
    bottom = grid.origin[2]
    if robot.planar:
        # The snake sees what stands below one meter.
        low = np.arange(solid.shape[2]) * cell + bottom
        layers = (low < 1.0 - 1e-6) & (low + cell > 1e-6)
        solid = solid[:, :, layers].any(axis=2, keepdims=True)
    padded = np.pad(solid, [(0, 1), (1, 1), (0, 0)]).astype(np.int8)
    change = np.diff(padded, axis=1)
    for z in range(solid.shape[2]):
        begun: dict[tuple[int, int], int] = {}  # where runs along y, alike in x, have begun
        for x in range(solid.shape[0] + 1):
            column = change[x, :, z]
            ends = np.flatnonzero(column == 1), np.flatnonzero(column == -1)
            runs = set(zip(*(end.tolist() for end in ends), strict=True))
            for first, last in begun.keys() - runs:
                low = np.array([begun[first, last] * cell, first * cell, bottom + z * cell])
                high = np.array([x * cell, last * cell, bottom + (z + 1) * cell])
                if robot.planar:
                    low[2], high[2] = -1.0, 1.0
                _add_box(spec, low, high)
            begun = {run: begun.get(run, x) for run in runs}
    wide, deep = solid.shape[0] * cell, solid.shape[1] * cell
    for low, high in (
        ((-2, -2), (0, deep + 2)),
        ((wide, -2), (wide + 2, deep + 2)),
        ((-2, -2), (wide + 2, 0)),
        ((-2, deep), (wide + 2, deep + 2)),
    ):
        _add_box(spec, np.array([*low, -2.0]), np.array([*high, 6.0]))
    if not robot.planar:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], contype=8, conaffinity=0
        )
    return PlainScene(spec, corner=grid.origin[:2])


def _add_box(spec: mujoco.MjSpec, low: np.ndarray, high: np.ndarray) -> None:
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(low + high) / 2,
        size=(high - low) / 2,
        contype=4,
        conaffinity=0,
    )
