"""The default engine: MJX does kinematics and collision.

MJX's pairs of geoms are fixed when a model is compiled. So a model has room for some obstacles of
each type; those not in use are parked far away, and a type that a scene lacks costs nothing.
Only signs of MJX's distances are used: for boxes it gives no more than that. What its spheres touch
is looked at again, see :mod:`vrrt_jax.scene.narrow_phase`.

What comes first, a broad phase, is what makes it fast: an obstacle is first touched by the sphere
that is nearest to it, so that MJX judges one pair for each obstacle, not one for each sphere. MJX's
own broad phase (``max_geom_pairs``) compares spheres around both, which says little of a wide box.
"""

import contextlib
import dataclasses
import functools
import io
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import TraceIgnoredNames, pytree, static
from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.kinematics import link_poses, place
from vrrt_jax.scene.batch_last import Value, evaluate
from vrrt_jax.scene.flat_program import FlatProgram, flat_program
from vrrt_jax.scene.held import HeldObject
from vrrt_jax.scene.obstacle_kinds import KINDS
from vrrt_jax.scene.obstacles import PARKED, Obstacle, Obstacles, signed_distances, to_slots
from vrrt_jax.scene.rows import least, over_rows
from vrrt_jax.scene.spheres import WorldSpheres, world_spheres
from vrrt_jax.scene.world import World

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, which is not used, is absent
    from mujoco import mjx

_GEOM = mujoco.mjtGeom
# Obstacles that MJX checks against spheres. Its routine for cylinders is an iterative search, and
# its routine for convex meshes misses contacts near their rims: cylinders are measured instead, by
# the closed formula of their slot at the positions that MJX gives the spheres.
_PAIRED = (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_BOX)
# Room comes in multiples of this, so that scenes share their compiled functions. Boxes cost most.
_ROOM_STEPS = (4, 4, 4, 2, 4)
_BLOCK = 128  # configurations at a time: more do not fit into a CPU's cache


@pytree
class MjxObstacles:
    """Obstacles as MJX has them; G geoms, in the order of their types, parked ones included."""

    position: jax.Array  # (G, 3) [m]
    quaternion: jax.Array  # (G, 4) wxyz
    size: jax.Array  # (G, 3) as MuJoCo's geom size [m]
    slots: Obstacles  # of these, and of those that MJX has no pair for


@pytree
class MjxWorld(World):
    """A world whose questions are answered by MJX.

    What the robot holds is measured instead: how near to which obstacle it may be is no property of
    a geom, and another grip would be another model.
    """

    engine: ClassVar[str] = "mjx"

    scene: "MjxScene" = static()
    geoms: MjxObstacles
    spheres: WorldSpheres

    @single_precision
    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.is_free`."""
        return self._span(q, jnp.zeros_like(q)) >= 0

    def free_span(self, q: jax.Array, edge: jax.Array) -> jax.Array:
        """See :class:`vrrt_jax.core.edges.Space`.

        MJX says whether ``q`` is free. How much that says about the edge follows from distances,
        which MJX does not have for boxes: they are measured where MJX puts the spheres.
        """
        if overrides_is_free(self):
            return super().free_span(q, edge)
        return self._span(q, edge)

    def _span(self, q: jax.Array, edge: jax.Array) -> jax.Array:
        """See :meth:`free_span`, where MJX alone is asked."""
        is_free, clearance, poses = self._answer(q)
        # Behind a barrier the centers are computed once, and not again for every pair.
        inner = jax.lax.optimization_barrier(place(self.spheres.self_collision, poses))
        if self.spheres.num_held[0]:
            held = self.spheres.held_clearances(self.obstacles, self.margin, poses)
            is_free &= jnp.all(held > 0) & self.spheres.held_are_apart(inner)
            clearance = jnp.append(clearance, held)
        gaps = self.spheres.gaps(inner)
        span = self.spheres.free_span(clearance, gaps, edge)
        if self.spheres.narrow_phase is None:  # which also looks at what nearly touches
            span = jnp.maximum(span, 0.0)
        span = jnp.where(is_free, span, -1.0)
        return self.spheres.look_again(
            self.obstacles, self.margin, poses, edge, clearance, gaps, span
        )[0]

    @single_precision
    def obstacle_clearance(self, q: jax.Array) -> jax.Array:
        """See :func:`vrrt_jax.scene.world.obstacle_clearance`; in closed form, as MJX has none."""
        return self.spheres.smallest_clearance(self.obstacles, link_poses(self.chain, q))

    def _answer(self, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Whether ``q`` (D,) is free, () bool, and what tells how far.

        Returns:
            () bool; distances (n,) of the robot's collision spheres to obstacles, less the margin
            [m]; poses (L, 3, 4) of links.
        """
        inputs = jax.lax.stop_gradient((self.geoms, self.margin, self.spheres.self_margin, q))
        *common, q = inputs
        return jax.tree.map(lambda part: part[0], self.scene.answers(tuple(common), q[None]))

    def holding(self, attached: Sequence[HeldObject]) -> Self:
        """See :meth:`vrrt_jax.scene.world.World.holding`."""
        spheres = world_spheres(self.robot.value, self.obstacle_names, attached)
        return dataclasses.replace(
            self,
            attached=TraceIgnoredNames(attached),
            spheres=spheres.farther_apart(float(self.spheres.self_margin)),
        )

    def by_spheres_alone(self) -> Self:
        """See :meth:`vrrt_jax.scene.world.World.by_spheres_alone`."""
        return dataclasses.replace(self, spheres=self.spheres.with_narrow_phase(None))

    def with_margin(self, margin: float | jax.Array) -> Self:
        """See :func:`vrrt_jax.scene.world.with_margin`."""
        return dataclasses.replace(
            self,
            margin=self.margin + margin,
            spheres=self.spheres.farther_apart(margin),
        )

    def fields_of(self, obstacles: Sequence[Obstacle]) -> dict[str, Any]:
        """See :meth:`vrrt_jax.scene.world.World.fields_of`; makes room where it is missing."""
        needed = _room_for(obstacles)
        room = tuple(max(old, new) for old, new in zip(self.scene.room, needed, strict=True))
        fields = {"scene": mjx_scene(self.scene.xml, room), "geoms": _fill(obstacles, room)}
        if self.attached:
            fields["spheres"] = self.spheres.among(self.attached, [o.name for o in obstacles])
        return fields


def mjx_world(robot: Any, fields: dict[str, Any], obstacles: Sequence[Obstacle]) -> MjxWorld:
    """A world with room for obstacles, and without any yet.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        fields: of :class:`vrrt_jax.scene.world.World`.
        obstacles: to make room for.
    """
    room = _room_for(obstacles)
    return MjxWorld(
        scene=mjx_scene(robot.xml, room),
        geoms=_fill([], room),
        spheres=world_spheres(robot, fields["obstacle_names"]),
        **fields,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class MjxScene:
    """A model with room for obstacles, and its compiled questions; from :func:`mjx_scene`.

    Letters: ``g`` geoms of the model, of which the last are obstacles.
    """

    xml: str  # the robot
    room: tuple[int, ...]  # for obstacles of each type of ``_PAIRED``, and for all others
    model: mjx.Model  # its last geoms are G probes, and the G obstacles that each is paired with
    data: mjx.Data
    is_collision_sphere: np.ndarray  # (g,) bool
    is_self_collision_sphere: np.ndarray  # (g,) bool
    link_bodies: np.ndarray  # (L - 1,) int body of each moving link

    def answer(
        self, geoms: MjxObstacles, margin: jax.Array, self_margin: jax.Array, q: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Whether one configuration (D,) is free, how near obstacles are, and where links are.

        Returns:
            () bool; distances (n,) of collision spheres to obstacles, less the margin [m]; poses
            (L, 4, 4) of links.
        """
        # Pairs touch where they come nearer than the margin: spheres are inflated by it, and those
        # that meet each other by half of it each.
        radii = self.model.geom_size[:, 0]
        radii += margin * self.is_collision_sphere + self_margin / 2 * self.is_self_collision_sphere
        paired = len(geoms.size)
        first = len(radii) - paired
        model = self.model.replace(
            geom_size=self.model.geom_size.at[:, 0].set(radii).at[first:].set(geoms.size),
            geom_pos=self.model.geom_pos.at[first:].set(geoms.position),
            geom_quat=self.model.geom_quat.at[first:].set(geoms.quaternion),
        )
        data = mjx.kinematics(model, self.data.replace(qpos=q))
        spheres = np.flatnonzero(self.is_collision_sphere)
        centers = data.geom_xpos[spheres].T
        distances = signed_distances(geoms.slots, centers) - radii[spheres]
        free = jnp.all(distances[paired:] > 0)
        if self.model.npair:
            # Each probe stands in for the sphere that is nearest to its obstacle.
            nearest = jnp.argmin(distances[:paired], axis=1)
            probes = slice(first - paired, first)
            model = model.replace(
                geom_size=model.geom_size.at[probes, 0].set(radii[spheres][nearest])
            )
            data = data.replace(geom_xpos=data.geom_xpos.at[probes].set(centers[:, nearest].T))
        free &= jnp.all(mjx.collision(model, data)._impl.contact.dist > 0)  # type: ignore
        poses = jnp.concatenate(
            [data.xmat[self.link_bodies], data.xpos[self.link_bodies, :, None]], axis=2
        )
        poses = jnp.concatenate([jnp.eye(4)[None, :3], poses])
        return free, least(distances), poses

    @functools.cached_property
    def program(self) -> FlatProgram:
        """:meth:`answer` as equations."""
        shape = jax.ShapeDtypeStruct
        inputs = (_fill([], self.room), shape((), np.float32), shape((), np.float32))
        return flat_program(self.answer, *inputs, shape((self.model.nq,), np.float32))

    @functools.cached_property
    def answers(self) -> Any:
        """:meth:`answer` of configurations (n, D), as ``(inputs before q, q)``."""
        return over_rows(functools.partial(_answers, self))


@functools.partial(jax.jit, static_argnums=0)
def _answers(scene: MjxScene, others: Any, q: jax.Array) -> tuple[jax.Array, ...]:
    """:meth:`MjxScene.answer` of configurations (n, D); what is not used costs nothing."""
    constants = [Value(leaf, False) for leaf in jax.tree.leaves(others)]

    def block(q: jax.Array) -> tuple[jax.Array, ...]:
        inputs = [*constants, Value(q.T, True)]
        found = evaluate(scene.program, inputs, len(q), seed=q[0, 0])
        shapes = [variable.aval.shape for variable in scene.program.outputs]
        return tuple(
            jnp.moveaxis(
                jnp.broadcast_to(
                    part.array if part.is_batched else jnp.asarray(part.array)[..., None],
                    (*shape, len(q)),
                ),
                -1,
                0,
            )
            for part, shape in zip(found, shapes, strict=True)
        )

    # Blocks of equal size; the last is filled up with zeros.
    num_blocks = max(-(-len(q) // _BLOCK), 1) if jax.default_backend() == "cpu" else 1
    if num_blocks == 1:
        size = max(len(q), 1)
        return tuple(part[: len(q)] for part in block(jnp.pad(q, ((0, size - len(q)), (0, 0)))))
    size = -(-len(q) // num_blocks)
    padded = jnp.pad(q, ((0, num_blocks * size - len(q)), (0, 0)))
    parts = jax.lax.map(block, padded.reshape(num_blocks, size, -1))
    total = num_blocks * size  # robots without self-collision spheres have no place for "-1"
    return tuple(part.reshape(total, *part.shape[2:])[: len(q)] for part in parts)


@functools.lru_cache(maxsize=64)
def mjx_scene(xml: str, room: tuple[int, ...]) -> MjxScene:
    """The scene of a robot with room for obstacles; worlds of as much room share it.

    Args:
        xml: the robot, see :func:`vrrt_jax.robots.mjcf_writer.collision_mjcf`.
        room: for obstacles of each type of ``_PAIRED``, and for all others.
    """
    spec = mujoco.MjSpec.from_string(xml)
    mjcf_writer.keep_geoms(spec, polytopes=False)
    types = [geom for geom, count in zip(_PAIRED, room, strict=False) for _ in range(count)]
    has_spheres = any(g.group == int(mjcf_writer.COLLISION_GEOM["group"]) for g in spec.geoms)
    # Bodies of their own: what the robot's file excludes from contact with the world's body, its
    # base, says nothing of obstacles. Nothing but the pairs is checked between these geoms.
    probes, obstacles = spec.worldbody.add_body(), spec.worldbody.add_body()
    for k, geom in enumerate(types):
        probes.add_geom(name=f"probe_{k}", size=(1.0, 0.0, 0.0), contype=0, conaffinity=0)
        obstacles.add_geom(
            name=f"obstacle_{k}", type=geom, size=(1.0, 1.0, 1.0), contype=0, conaffinity=0
        )
        if has_spheres:
            spec.add_pair(geomname1=f"probe_{k}", geomname2=f"obstacle_{k}")
    model = spec.compile()
    of_robot = np.arange(model.ngeom) < model.ngeom - 2 * len(types)
    is_collision_sphere, is_self_collision_sphere = (
        of_robot & (model.geom_group == int(kind["group"]))
        for kind in (mjcf_writer.COLLISION_GEOM, mjcf_writer.SELF_COLLISION_GEOM)
    )
    with jax.ensure_compile_time_eval():  # it may be asked for inside a user's jit
        on_device = mjx.put_model(model)
        return MjxScene(
            xml=xml,
            room=room,
            model=on_device,
            data=mjx.make_data(on_device),
            is_collision_sphere=is_collision_sphere,
            is_self_collision_sphere=is_self_collision_sphere,
            link_bodies=np.array(model.jnt_bodyid),
        )


def _by_type(obstacles: Sequence[Obstacle]) -> list[list[Obstacle]]:
    """The obstacles of each type of ``_PAIRED``, and all others."""
    groups = {geom: [] for geom in _PAIRED}
    others: list[Obstacle] = []
    for obstacle in obstacles:
        groups.get(KINDS[obstacle.kind].geom, others).append(obstacle)
    return [*groups.values(), others]


def _room_for(obstacles: Sequence[Obstacle]) -> tuple[int, ...]:
    groups = zip(_by_type(obstacles), _ROOM_STEPS, strict=True)
    return tuple(step * -(-len(group) // step) for group, step in groups)


def _fill(obstacles: Sequence[Obstacle], room: tuple[int, ...]) -> MjxObstacles:
    """Obstacles in their places, and the rest parked."""
    rows = []
    for geom, group, count in zip(_PAIRED, _by_type(obstacles), room, strict=False):
        for obstacle in group:
            size = KINDS[obstacle.kind].geom_size(obstacle.size)
            rows.append((*obstacle.position, *obstacle.quaternion, *size))
        # A plane that is parked is far below.
        away = -PARKED if geom == _GEOM.mjGEOM_PLANE else PARKED
        rows += [(away, away, away, 1, 0, 0, 0, 0.01, 0.01, 0.01)] * (count - len(group))
    table = np.array(rows, np.float64).reshape(-1, 10)
    table[:, 3:7] /= np.linalg.norm(table[:, 3:7], axis=1, keepdims=True)
    position, quaternion, size = (
        jnp.asarray(part, jnp.float32) for part in np.split(table, (3, 7), axis=1)
    )
    slots = [to_slots(group, count) for group, count in zip(_by_type(obstacles), room, strict=True)]
    return MjxObstacles(
        position=position,
        quaternion=quaternion,
        size=size,
        slots=jax.tree.map(lambda *parts: jnp.concatenate(parts), *slots),
    )
