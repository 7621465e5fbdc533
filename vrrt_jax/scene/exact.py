"""A robot among obstacles in C MuJoCo, with its true meshes where this machine has them."""

import dataclasses
import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.mesh_sources import install_hint, mesh_spec
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.obstacle_kinds import KINDS
from vrrt_jax.scene.obstacles import Obstacle

_GEOMETRIES = ("auto", "meshes", "spheres")
_ALL_BITS = 0x7FFFFFFF  # contact bits of obstacles that everything sees
_FRAME_TOLERANCE = 1e-3  # [m] between the body frames of meshes and of spheres at home
_INSTALL_ADVICE = "install the version of the meshes that the README names"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ExactScene:
    """A robot and obstacles in C MuJoCo."""

    model: mujoco.MjModel
    data: mujoco.MjData
    geometry: str  # "meshes" or "spheres"
    num_bodies: int  # bodies from this index on are obstacles, one each
    robot_geoms: np.ndarray  # (r,) int, geoms of moving bodies that are checked against obstacles
    obstacle_geoms: np.ndarray  # (K,) int

    def touching(self, q: np.ndarray) -> list[tuple[int, int]]:
        """Pairs of bodies, smaller index first, that penetrate each other at ``q`` (D,)."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        contact = self.data.contact
        bodies = np.sort(self.model.geom_bodyid[contact.geom[contact.dist < 0]], axis=1)
        return sorted({(int(first), int(second)) for first, second in bodies})

    def clearance(self, best: float) -> float:
        """Distance [m] of moving geoms to obstacles, at the latest argument of :meth:`touching`.

        Args:
            best: larger distances are not computed [m]; the smaller it is, the faster.
        """
        model, data = self.model, self.data
        # Lower bounds from bounding spheres, so that few pairs need their exact distance.
        apart = data.geom_xpos[self.robot_geoms][:, None] - data.geom_xpos[self.obstacle_geoms]
        bound = np.linalg.norm(apart, axis=-1) - model.geom_rbound[self.obstacle_geoms]
        is_plane = model.geom_type[self.obstacle_geoms] == mujoco.mjtGeom.mjGEOM_PLANE
        normal = data.geom_xmat[self.obstacle_geoms].reshape(-1, 3, 3)[:, :, 2]
        height = np.einsum("rkd,kd->rk", apart, normal)
        bound = np.where(is_plane, height, bound) - model.geom_rbound[self.robot_geoms, None]
        # Nearest bounds first: once a bound is beyond the best distance, so are all after it.
        for index in np.argsort(bound, axis=None):
            if bound.flat[index] >= best:
                break
            row, column = divmod(int(index), len(self.obstacle_geoms))
            pair = int(self.robot_geoms[row]), int(self.obstacle_geoms[column])
            best = min(best, mujoco.mj_geomDistance(model, data, *pair, best, None))
        return best

    def describe(self, pair: tuple[int, int]) -> str:
        """Words for a pair of bodies: "link5 touches box_2"."""
        first, second = (self.model.body(body).name for body in pair)
        return f"{first} touches {second.removeprefix('obstacle: ')}"


def exact_scene(
    robot: Robot, obstacles: Sequence[Obstacle], *, geometry: str = "auto"
) -> ExactScene:
    """A compiled model of robot and obstacles; the latest ones are kept.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        obstacles: K primitives.
        geometry: as in :func:`verify_path`.

    Raises:
        ValueError: as :func:`verify_path`.
    """
    if geometry not in _GEOMETRIES:
        raise ValueError(f"geometry is '{geometry}'; expected one of: {', '.join(_GEOMETRIES)}")
    names = [obstacle.name for obstacle in obstacles]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"obstacle names used more than once: {', '.join(twice)}; expected distinct names"
        )
    return _build(robot, tuple(_hashable(obstacle) for obstacle in obstacles), geometry)


def _hashable(obstacle: Obstacle) -> Obstacle:
    """The obstacle with tuples of floats, whatever it was made of, and the default color."""
    x, y, z = (float(value) for value in obstacle.position)
    qw, qx, qy, qz = (float(value) for value in obstacle.quaternion)
    a, b, c = (float(value) for value in obstacle.size)
    return Obstacle(
        name=obstacle.name,
        kind=obstacle.kind,
        position=(x, y, z),
        quaternion=(qw, qx, qy, qz),
        size=(a, b, c),
    )


@functools.lru_cache(maxsize=8)
def _build(robot: Robot, obstacles: tuple[Obstacle, ...], geometry: str) -> ExactScene:
    spec = None if geometry == "spheres" else mesh_spec(robot, visuals=False)
    if spec is None and geometry == "meshes":
        raise ValueError(
            f"the meshes of robot '{robot.name}' are not on this machine: pip install "
            f"{install_hint(robot.mesh_source)}, or use geometry='spheres'"
        )
    # True meshes where they are to be had, else the covering spheres.
    has_meshes = spec is not None
    spheres = mujoco.MjSpec.from_string(robot.xml)
    spec = spec or spheres
    if has_meshes:
        _check_same_robot(robot, spec.copy().compile(), spheres.compile())
        _exclude(spec, robot.ignored_pairs)
    num_bodies = len(spec.bodies)
    for obstacle in obstacles:
        # Collision spheres see bit 0 only, and self-collision spheres see no obstacle.
        _add_obstacle(spec, obstacle, _ALL_BITS if has_meshes else 1)
    spec.memory = 1 << 23  # room for the contacts of a robot deep inside an obstacle
    try:
        model = spec.compile()
    except ValueError as error:
        reason = "; ".join(str(error).split("\n"))
        raise ValueError(
            f"the obstacles do not compile: {reason}; expected sizes as in MJCF, positive"
        ) from None
    # Which geoms are measured against each other for the clearance.
    is_obstacle = model.geom_bodyid >= num_bodies
    sees_obstacles = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    if not has_meshes:
        sees_obstacles = model.geom_group == int(mjcf_writer.COLLISION_GEOM["group"])
    is_moving = model.body_weldid[model.geom_bodyid] != 0
    return ExactScene(
        model=model,
        data=mujoco.MjData(model),
        geometry="meshes" if has_meshes else "spheres",
        num_bodies=num_bodies,
        robot_geoms=np.flatnonzero(sees_obstacles & is_moving),
        obstacle_geoms=np.flatnonzero(is_obstacle),
    )


def _check_same_robot(robot: Robot, meshes: mujoco.MjModel, spheres: mujoco.MjModel) -> None:
    """Refuse meshes whose joints or body frames are not those of the spheres."""
    if meshes.nq != robot.num_joints:
        raise ValueError(
            f"the meshes of robot '{robot.name}' have {meshes.nq} joints; expected "
            f"{robot.num_joints}: {_INSTALL_ADVICE}"
        )
    # Positions of all bodies at home, by name.
    frames = []
    for model in (meshes, spheres):
        data = mujoco.MjData(model)
        data.qpos[:] = robot.home
        mujoco.mj_kinematics(model, data)
        frames.append({model.body(k).name: data.xpos[k] for k in range(1, model.nbody)})
    missing = {*robot.collision_sphere_bodies, *robot.self_collision_sphere_bodies} - {
        "world",
        *frames[0],
    }
    if missing:
        raise ValueError(
            f"the meshes of robot '{robot.name}' have no body {', '.join(sorted(missing))}; have: "
            f"{', '.join(frames[0])}: {_INSTALL_ADVICE}"
        )
    error = max(
        np.max(np.abs(position - frames[1][name]))
        for name, position in frames[0].items()
        if name in frames[1]
    )
    if error > _FRAME_TOLERANCE:
        raise ValueError(
            f"the meshes of robot '{robot.name}' are placed {error:.4f} m away from its collision "
            f"spheres; expected the same kinematics: {_INSTALL_ADVICE}"
        )


def _exclude(spec: mujoco.MjSpec, ignored_pairs: Sequence[tuple[str, str]]) -> None:
    names = {body.name for body in spec.bodies}
    for first, second in ignored_pairs:
        if first in names and second in names:
            spec.add_exclude(bodyname1=first, bodyname2=second)


def _add_obstacle(spec: mujoco.MjSpec, obstacle: Obstacle, bits: int) -> None:
    """Add an obstacle as a body of its own, so that contacts can name it."""
    if obstacle.kind not in KINDS:
        raise ValueError(
            f"obstacle '{obstacle.name}' is a '{obstacle.kind}'; expected one of: "
            f"{', '.join(KINDS)}"
        )
    kind = KINDS[obstacle.kind]
    body = spec.worldbody.add_body(
        name=f"obstacle: {obstacle.name}", pos=obstacle.position, quat=obstacle.quaternion
    )
    size = kind.geom_size(obstacle.size)
    body.add_geom(type=kind.geom, size=size, contype=bits, conaffinity=bits)
