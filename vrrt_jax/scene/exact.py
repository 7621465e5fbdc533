"""A robot among obstacles in C MuJoCo, with its true meshes where this machine has them."""

import copy
import dataclasses
import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.mesh_sources import install_hint, mesh_spec
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.advance import NEAR, Near, near_pairs
from vrrt_jax.scene.exact_held import HELD_BITS, add_held, allowed_depths
from vrrt_jax.scene.exact_pairs import boxes_to_meshes, measure_rightly
from vrrt_jax.scene.exact_slots import (
    ALL_BITS,
    add_slots,
    lever_arms,
    place,
    place_obstacles,
    room_for,
    slots_of,
)
from vrrt_jax.scene.held import HeldObject
from vrrt_jax.scene.obstacles import Obstacle, check_obstacle, floats
from vrrt_jax.scene.world import World, obstacle_list

_GEOMETRIES = ("auto", "meshes", "polytopes", "spheres")
_FRAME_TOLERANCE = 1e-3  # [m] between the body frames of meshes and of spheres at home
_KEPT = 8  # compiled scenes that a thread keeps, the latest ones
COMPILING = threading.Lock()  # MuJoCo's compiler is for one thread at a time
_OWN = threading.local()  # what a thread keeps goes with it
_INSTALL_ADVICE = "install the version of the meshes that the README names"


@dataclasses.dataclass(kw_only=True, eq=False)
class _Compiled:
    """A compiled robot with room for obstacles; scenes take turns in it."""

    model: mujoco.MjModel
    data: mujoco.MjData
    geometry: str  # one of _GEOMETRIES but "auto"
    num_bodies: int  # bodies from this index on are obstacles, one each
    slots: Mapping[str, np.ndarray]  # of each kind of obstacle, its geoms
    robot_geoms: np.ndarray  # (r,) int, geoms of moving bodies that are checked against obstacles
    lever_arms: np.ndarray  # (D, nbody, nbody) see ``exact_slots.lever_arms``
    held_bodies: tuple[int, ...]  # bodies of the held objects
    holder: "ExactScene | None" = None  # whose obstacles stand in it now


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ExactScene:
    """A robot and obstacles in C MuJoCo; every thread that asks works on a copy of its own."""

    key: "_Key"
    obstacles: tuple[Obstacle, ...]  # (K,)
    obstacle_geoms: np.ndarray  # (K,) int
    attached: tuple[HeldObject, ...]  # what the robot holds
    allowed: np.ndarray  # (nbody, nbody) how deep bodies may be in each other [m]

    @property
    def compiled(self) -> _Compiled:
        """This thread's copy."""
        return _compiled(self.key)

    @property
    def model(self) -> mujoco.MjModel:
        """The model, with this scene's obstacles in place."""
        return self._placed().model

    def _placed(self) -> _Compiled:
        """This thread's copy, with this scene's obstacles in place."""
        own = self.compiled
        if own.holder is not self:
            place_obstacles(own.model, own.slots, self.obstacles)
            for body, held in zip(own.held_bodies, self.attached, strict=True):
                place(own.model, own.model.body_geomadr[body], held.obstacle)
            own.holder = self
        return own

    @property
    def data(self) -> mujoco.MjData:
        """The state at the latest configuration that was asked about."""
        return self.compiled.data

    @property
    def geometry(self) -> str:
        """What the robot is made of: "meshes", "polytopes" or "spheres"."""
        return self.compiled.geometry

    @property
    def num_bodies(self) -> int:
        """Bodies of the robot; those from this index on are obstacles."""
        return self.compiled.num_bodies

    @property
    def robot_geoms(self) -> np.ndarray:
        """(r,) int geoms of moving bodies that are checked against obstacles."""
        return self.compiled.robot_geoms

    @functools.cached_property
    def lever_arms(self) -> np.ndarray:
        """(D, nbody, nbody) see :func:`vrrt_jax.scene.exact_slots.lever_arms`."""
        # What is held has other places and sizes than where it was compiled; obstacles stand still.
        return lever_arms(self.model) if self.attached else self.compiled.lever_arms

    def near(self, q: np.ndarray) -> Near:
        """Distances (c,) [m] and pairs of bodies (c, 2) nearer than ``advance.NEAR``.

        Args:
            q: (D,); negative distances are penetrations. How deep an object may be in its support
                is no penetration.
        """
        return self.near_in_a_row()(q)

    def near_in_a_row(self) -> Callable[[np.ndarray], Near]:
        """:meth:`near` of many configurations, as long as no other scene is asked meanwhile."""
        own = self._placed()
        model, data = own.model, own.data

        def near(q: np.ndarray) -> Near:
            distance, bodies = near_pairs(model, data, q)
            if self.attached:
                distance = distance + self.allowed[bodies[:, 0], bodies[:, 1]]
            return distance, bodies

        return near

    def depths(self, name: str, q: np.ndarray) -> dict[str, float]:
        """How deep a held object is in obstacles at ``q`` (D,), by their names [m].

        Negative where it is beside them; without those that are not near.
        """
        index = [held.obstacle.name for held in self.attached].index(name)
        own, found = self.compiled.held_bodies[index], {}
        for distance, pair in zip(*near_pairs(self.model, self.data, q), strict=True):
            first, second = sorted(int(body) for body in pair)
            if first == own and second >= self.num_bodies:
                other = self._name(second)
                found[other] = max(found.get(other, -np.inf), -float(distance))
        return found

    def touching(self, q: np.ndarray) -> list[tuple[int, int]]:
        """Pairs of bodies, smaller index first, that penetrate each other at ``q`` (D,)."""
        distance, bodies = self.near(q)
        pairs = np.sort(bodies[distance < 0], axis=1)
        return sorted({(int(first), int(second)) for first, second in pairs})

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
        first, second = (self._name(body) for body in pair)
        return f"{first} touches {second}"

    def _name(self, body: int) -> str:
        if body in self.compiled.held_bodies:
            return self.attached[self.compiled.held_bodies.index(body)].obstacle.name
        if body < self.num_bodies:
            return self.compiled.model.body(body).name
        return self.obstacles[self.obstacle_index(body)].name

    def obstacle_index(self, body: int) -> int:
        """Which of the K obstacles a body is."""
        of_body = self.compiled.model.geom_bodyid[self.obstacle_geoms]
        return int(np.flatnonzero(of_body == body)[0])


def exact_scene(
    robot: Robot,
    obstacles: Sequence[Obstacle] | World,
    *,
    geometry: str = "auto",
    attached: Sequence[HeldObject] = (),
) -> ExactScene:
    """A compiled model of robot and obstacles; the latest ones are kept.

    Args:
        robot: from :func:`vrrt_jax.robots.load_robot`.
        obstacles: K primitives, or a world with its obstacles and what the robot holds there.
        geometry: as in :func:`verify_path`.
        attached: what the robot holds, beside what it holds in the world.

    Raises:
        ValueError: as :func:`verify_path`.
    """
    if geometry not in _GEOMETRIES:
        raise ValueError(f"geometry is '{geometry}'; expected one of: {', '.join(_GEOMETRIES)}")
    if isinstance(obstacles, World):
        obstacles, attached = obstacle_list(obstacles), [*obstacles.attached, *attached]
    names = [obstacle.name for obstacle in [*obstacles, *(held.obstacle for held in attached)]]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"obstacle names used more than once: {', '.join(twice)}; expected distinct names"
        )
    obstacles = tuple(_hashable(obstacle) for obstacle in obstacles)
    for obstacle in obstacles:
        check_obstacle(obstacle)
    room = room_for(obstacles)
    key = robot, room, geometry, tuple((held.body, held.obstacle.kind) for held in attached)
    compiled = _compiled(key)
    taken = dict.fromkeys(compiled.slots, 0)
    geoms = []
    for obstacle in obstacles:
        geoms.append(compiled.slots[obstacle.kind][taken[obstacle.kind]])
        taken[obstacle.kind] += 1
    geoms = np.array(geoms, int)
    bodies = compiled.model.geom_bodyid[geoms]
    body_of = {obstacle.name: body for obstacle, body in zip(obstacles, bodies, strict=True)}
    return ExactScene(
        key=key,
        obstacles=obstacles,
        obstacle_geoms=geoms,
        attached=tuple(attached),
        allowed=allowed_depths(compiled.model.nbody, attached, compiled.held_bodies, body_of),
    )


def _hashable(obstacle: Obstacle) -> Obstacle:
    """The obstacle with tuples of floats, whatever it was made of."""
    return dataclasses.replace(
        obstacle,
        position=floats(obstacle.position),
        quaternion=floats(obstacle.quaternion),
        size=floats(obstacle.size),
    )


# A robot, room for obstacles, a geometry, and bodies with the kinds of what each of them holds.
_Key = tuple[Robot, tuple[tuple[str, int], ...], str, tuple[tuple[str, str], ...]]


def forget() -> None:
    """Drop the compiled scenes that this thread keeps, and what new ones are copied from."""
    _build.cache_clear()
    vars(_OWN).clear()


def _compiled(key: _Key) -> _Compiled:
    """This thread's scene: MuJoCo's data is for one thread, and so are obstacles in the model."""
    kept: OrderedDict[_Key, _Compiled] = vars(_OWN).setdefault("kept", OrderedDict())
    if key not in kept:
        with COMPILING:
            shared = _build(*key)
            model = copy.copy(shared.model)
        kept[key] = dataclasses.replace(shared, model=model, data=mujoco.MjData(model))
        if len(kept) > _KEPT:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key]


@functools.lru_cache(maxsize=_KEPT)
def _build(
    robot: Robot,
    room: tuple[tuple[str, int], ...],
    geometry: str,
    held: tuple[tuple[str, str], ...],
) -> _Compiled:
    """The robot with room for obstacles, which threads copy."""
    spec = mesh_spec(robot, visuals=False) if geometry in ("auto", "meshes") else None
    if spec is None and geometry == "meshes":
        raise ValueError(
            f"the meshes of robot '{robot.name}' are not on this machine: "
            f"{install_hint(robot.mesh_source)}, or use geometry='polytopes'"
        )
    # True meshes where they are to be had, else the polytopes or spheres that cover them.
    has_meshes = spec is not None
    covers = mujoco.MjSpec.from_string(robot.xml)
    has_polytopes = mjcf_writer.keep_geoms(covers, polytopes=geometry != "spheres")
    made_of = "meshes" if has_meshes else "polytopes" if has_polytopes else "spheres"
    spec = spec or covers
    if has_meshes:
        _check_same_robot(robot, spec.copy().compile(), covers.compile())
        _exclude(spec, robot.ignored_pairs)
        boxes_to_meshes(spec)
    elif has_polytopes:
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = ALL_BITS
    held_names = add_held(spec, held, HELD_BITS[made_of])
    num_bodies = len(spec.bodies)
    # Collision spheres see bit 0 only, and self-collision spheres see no obstacle.
    add_slots(spec, room, bits=1 if made_of == "spheres" else ALL_BITS)
    spec.memory = 1 << 23  # room for the contacts of a robot deep inside an obstacle
    model = spec.compile()
    # Contacts are reported from afar; MuJoCo adds up the margins of a pair. Trees of boxes inside
    # bodies are of no use to slots.
    model.geom_margin[:] = NEAR / 2
    model.pair_margin[:] = NEAR
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    measure_rightly(model)
    # Which geoms are measured against obstacles for the clearance.
    sees_obstacles = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    if made_of == "spheres":
        sees_obstacles = model.geom_group == int(mjcf_writer.COLLISION_GEOM["group"])
    held_bodies = tuple(model.body(name).id for name in held_names)
    sees_obstacles |= np.isin(model.geom_bodyid, held_bodies)
    sees_obstacles &= model.geom_bodyid < num_bodies
    is_moving = model.body_weldid[model.geom_bodyid] != 0
    return _Compiled(
        model=model,
        data=mujoco.MjData(model),
        geometry=made_of,
        num_bodies=num_bodies,
        slots=slots_of(model, num_bodies),
        robot_geoms=np.flatnonzero(sees_obstacles & is_moving),
        lever_arms=lever_arms(model),
        held_bodies=held_bodies,
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
