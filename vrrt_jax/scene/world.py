"""A robot among obstacles, and the question every planner asks: is this configuration free?

Here is the interface, :class:`World`. An engine is a subclass that answers it:
:mod:`vrrt_jax.scene.mjx`, the default, and :mod:`vrrt_jax.scene.closed_form`, the fast one.
Obstacles live in slots, so that moving, adding or removing them does not re-compile.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.edges import StraightLineEdges
from vrrt_jax.core.fields import check_loaded
from vrrt_jax.core.precision import single_precision
from vrrt_jax.core.types import PytreeSubclasses, TraceIgnored, TraceIgnoredNames, pytree, static
from vrrt_jax.robots.kinematics import Chain
from vrrt_jax.scene.held import HeldObject
from vrrt_jax.scene.obstacles import (
    Obstacle,
    Obstacles,
    check_obstacle,
    floats,
    from_slots,
    to_slots,
)

_NO_ENGINE = (
    "World is an interface without an engine: subclass the world of an engine, vrrt_jax.MjxWorld "
    "or vrrt_jax.ClosedFormWorld"
)
ENGINES = ("mjx", "closed_form")
_BLOCK = 64  # configurations that are measured at once


FINER = 4  # times as fine are the checks of edges once the exact check has refused a path
_MARGIN_SHARES = (1.0, 0.5, 0.25, 0.1)  # of the margin that is wanted, the largest that fits


@pytree
class World(PytreeSubclasses, StraightLineEdges):
    """All that planners ask about robot and obstacles.

    To add a constraint of your own, subclass the world of an engine and override :meth:`is_free`:
    planners ask nothing else. Subclasses are pytree dataclasses by themselves, so that new fields
    may be arrays. ``KeepOut(**vars(world), center=...)`` makes one of a world that was built.

    Letters: ``D`` joints, ``K`` obstacle slots.
    """

    engine: ClassVar[str] = ""  # which of ENGINES answers

    chain: Chain
    obstacles: Obstacles
    lower: jax.Array  # (D,) [rad] or [m]
    upper: jax.Array  # (D,) [rad] or [m]
    is_continuous: jax.Array  # (D,) bool, joints that turn for ever
    margin: jax.Array  # () clearance asked of obstacles [m]
    resolution: jax.Array  # () longest sub-step of an edge between two checks [rad]
    joint_names: TraceIgnoredNames = static()
    obstacle_names: TraceIgnoredNames = static()  # (K,) '' in empty slots
    kinds: TraceIgnoredNames = static()  # (K,) '' in empty slots
    colors: TraceIgnoredNames = static()  # (K,) rgba, () in empty slots
    robot: TraceIgnored = static(default=TraceIgnored())  # for the host
    attached: TraceIgnoredNames = static(default=TraceIgnoredNames())  # of ``held.HeldObject``

    def is_free(self, q: jax.Array) -> jax.Array:
        """See :func:`is_free`; for engines to answer."""
        raise NotImplementedError(_NO_ENGINE)

    def obstacle_clearance(self, q: jax.Array) -> jax.Array:
        """See :func:`obstacle_clearance`; for engines to answer."""
        raise NotImplementedError(_NO_ENGINE)

    def holding(self, attached: Sequence[HeldObject]) -> Self:
        """The same world, whose robot holds these objects and no others; for engines to answer.

        See :func:`vrrt_jax.attach`.
        """
        raise NotImplementedError(_NO_ENGINE)

    def by_spheres_alone(self) -> Self:
        """The same world without a narrow phase: faster, and wary of what spheres touch."""
        return self

    def with_margin(self, margin: float | jax.Array) -> Self:
        """See :func:`with_margin`."""
        return dataclasses.replace(self, margin=self.margin + margin)

    def fields_of(self, obstacles: Sequence[Obstacle]) -> dict[str, Any]:
        """Fields of the engine's own that change with the obstacles, on the host."""
        return {}


@single_precision
def is_free(world: World, q: jax.Array) -> jax.Array:
    """Whether ``q`` (D,) touches neither an obstacle nor the robot itself, () bool.

    Limits are not checked. Pure and vmappable; fast inside any ``jit``. This is ``world.is_free``,
    so that a subclass that overrides it is obeyed.

    Raises:
        ValueError: ``q`` has another shape.
    """
    _check_shape(world, q)
    return world.is_free(q)


# Of q (n, D), for the host.
batch_is_free = single_precision(jax.jit(jax.vmap(is_free, (None, 0))))


@single_precision
@jax.jit
def batch_clearance(world: "World", q: jax.Array, num: jax.Array | int) -> jax.Array:
    """The smallest clearance () of the first ``num`` of q (n, D), for the host.

    It is looked for block by block, so that what only fills up to ``n`` costs nothing.
    """
    size = min(_BLOCK, len(q))

    def look(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        first, least = state  # the last block begins early enough to be a whole one
        block = jax.lax.dynamic_slice_in_dim(q, first, size)
        here = jax.vmap(lambda q: world.obstacle_clearance(q))(block)
        return first + size, jnp.minimum(least, jnp.min(here))

    start = jnp.int32(0), jnp.float32(jnp.inf)
    return jax.lax.while_loop(lambda state: state[0] < num, look, start)[1]


@single_precision
def obstacle_clearance(world: World, q: jax.Array) -> jax.Array:
    """Distance () [m] of the collision spheres at ``q`` (D,) to the nearest obstacle.

    Raises:
        ValueError: ``q`` has another shape.
    """
    _check_shape(world, q)
    return world.obstacle_clearance(q)


def _check_shape(world: World, q: Any) -> None:
    if np.shape(q) != (len(world.joint_names),):
        raise ValueError(
            f"the configuration has shape {np.shape(q)}; expected ({len(world.joint_names)},) for "
            f"the joints {', '.join(world.joint_names)}: vmap over many"
        )


@single_precision
def build_world(
    robot: Any,
    obstacles: Sequence[Obstacle] = (),
    *,
    engine: str = "mjx",
    num_slots: int = 16,
    margin: float = 0.0,
    resolution: float = 0.02,
) -> World:
    """Put a robot among obstacles.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        obstacles: what stands around it.
        engine: who answers what is free: "mjx", or "closed_form", which
            compiles sooner and is faster among many boxes.
        num_slots: room for obstacles; raised to the next multiple of 8 that holds them all. Worlds
            of one robot with as many slots share their compiled functions.
        margin: clearance asked of obstacles [m].
        resolution: longest step between two collision checks on an edge [rad].

    Raises:
        ValueError: an engine that does not exist, an obstacle of an unsupported kind, or a number
            out of range.
    """
    if engine not in ENGINES:
        raise ValueError(f"unknown engine '{engine}'; have: {', '.join(ENGINES)}")
    check_loaded(robot, "the robot", "vrrt_jax.load_robot")
    for obstacle in obstacles:
        check_obstacle(obstacle)
    if not (np.isfinite(margin) and margin >= 0 and np.isfinite(resolution) and resolution > 0):
        raise ValueError(
            f"margin={margin} and resolution={resolution}: expected margin >= 0 m and "
            "resolution > 0 rad"
        )
    # Engines build on this module, so that it cannot import them at its top.
    from vrrt_jax.scene.closed_form import closed_form_world
    from vrrt_jax.scene.mjx import mjx_world

    # Slots in multiples of eight: worlds of about the same size share their compiled functions.
    num_slots = 8 * max(-(-num_slots // 8), -(-len(obstacles) // 8), 1)
    fields = {
        "chain": robot.chain,
        "obstacles": to_slots([], num_slots),
        "lower": jnp.asarray(robot.lower, jnp.float32),
        "upper": jnp.asarray(robot.upper, jnp.float32),
        "is_continuous": jnp.asarray(robot.is_continuous, bool),
        "margin": jnp.float32(margin),
        "resolution": jnp.float32(resolution),
        "joint_names": TraceIgnoredNames(robot.joint_names),
        "obstacle_names": TraceIgnoredNames([""] * num_slots),
        "kinds": TraceIgnoredNames([""] * num_slots),
        "colors": TraceIgnoredNames([()] * num_slots),
        "robot": TraceIgnored(robot),
    }
    if engine == "mjx":
        return with_obstacles(mjx_world(robot, fields, obstacles), obstacles)
    return with_obstacles(closed_form_world(robot, fields), obstacles)


@single_precision
def with_obstacles(world: World, obstacles: Sequence[Obstacle]) -> World:
    """The same robot among other obstacles.

    Nothing re-compiles, but where the engine is "mjx" and there are more obstacles of a kind than
    there is room for: room comes in fours, for boxes in twos.

    Raises:
        ValueError: more obstacles than slots, a name used twice, an unsupported kind or a size that
            is not positive.
    """
    num_slots = len(world.obstacles.rounding)
    if len(obstacles) > num_slots:
        raise ValueError(
            f"{len(obstacles)} obstacles do not fit into {num_slots} slots; build the world with "
            f"num_slots={len(obstacles)} or more"
        )
    names = [o.name for o in obstacles]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"obstacle names must differ, but {twice} stand more than once; rename")
    if held := sorted({*names} & {*held_names(world)}):
        raise ValueError(
            f"the robot holds {held} already: detach them first, or give the obstacles other names"
        )
    spare = num_slots - len(obstacles)
    return dataclasses.replace(
        world,
        obstacles=to_slots(obstacles, num_slots),  # checks them
        **world.fields_of(obstacles),
        obstacle_names=TraceIgnoredNames(names + [""] * spare),
        kinds=TraceIgnoredNames([o.kind for o in obstacles] + [""] * spare),
        colors=TraceIgnoredNames([o.rgba for o in obstacles] + [()] * spare),
    )


@single_precision
def with_margin(world: World, margin: float) -> World:
    """The same world, where the robot keeps ``margin`` [m] farther from obstacles and itself."""
    return world.with_margin(margin)


@single_precision
def rooms(world: World, q: np.ndarray, margin: float) -> list[World]:
    """Worlds in which configurations are free, from the wariest to the world itself.

    Args:
        world: robot and obstacles.
        q: (n, D) configurations that are free in it.
        margin: to keep beside the world's own [m].

    Returns:
        If configurations leave as much: the world with the whole margin or the largest part of it
        that fits; the world without a narrow phase, which is for what is nearer than any margin and
        takes time; and the world.
    """
    q = np.asarray(q, np.float32)
    alone = world.by_spheres_alone()
    structure = jax.tree.structure(alone)
    has_narrow_phase = structure != jax.tree.structure(world)
    found = []
    for share in _MARGIN_SHARES if margin > 0 else ():
        leaves, are_free = _wary(alone, np.float32(share * margin), q)
        if are_free:
            # What only the host knows, such as names, is that of this world.
            found.append(jax.tree.unflatten(structure, leaves))
            break
    if has_narrow_phase and (found or np.all(batch_is_free(alone, q))):
        found.append(alone)
    return [*found, world]


def keeping_clearance(world: World, q: np.ndarray, margin: float) -> World:
    """The first of :func:`rooms`: where the robot keeps ``margin`` [m], or what q (n, D) leaves."""
    return rooms(world, q, margin)[0]


@jax.jit
def _wary(world: World, margin: jax.Array, q: jax.Array) -> tuple[list[jax.Array], jax.Array]:
    """The leaves of a world with a margin, and whether all of q (n, D) are free in it, () bool."""
    wary = world.with_margin(margin)
    return jax.tree.leaves(wary), jnp.all(jax.vmap(is_free, (None, 0))(wary, q))


def checked_more_finely(world: World) -> World:
    """The same world, whose edges are checked in finer steps: the exact check refused a path."""
    return dataclasses.replace(world, resolution=world.resolution / FINER)


def obstacle_list(world: World) -> list[Obstacle]:
    """The obstacles in the world's slots, as the host sees them."""
    slots = zip(
        from_slots(world.obstacles, world.kinds), world.obstacle_names, world.colors, strict=True
    )
    return [Obstacle(name=name, rgba=rgba, **fields) for fields, name, rgba in slots if fields]


def held_names(world: World) -> list[str]:
    """What the robot holds, by name."""
    return [held.obstacle.name for held in world.attached]


def no_such_obstacle(world: World, name: str) -> str:
    """Words for an obstacle that does not stand in a world."""
    text = f"no obstacle named '{name}'; the world has {[o.name for o in obstacle_list(world)]}"
    return f"{text}, and the robot holds {held_names(world)}" if world.attached else text


@single_precision
def move_obstacle(
    world: World,
    name: str,
    *,
    position: Sequence[float] | None = None,
    quaternion: Sequence[float] | None = None,
    size: Sequence[float] | None = None,
) -> World:
    """Move, turn or resize one obstacle; nothing re-compiles.

    Args:
        world: robot and obstacles.
        name: of the obstacle.
        position: (3,) of its center in the world [m].
        quaternion: (4,) its turn in the world, w first.
        size: up to (3,) as MuJoCo's geom size: radius and half lengths [m].

    Raises:
        ValueError: no obstacle of that name.
    """
    obstacles = obstacle_list(world)
    if name not in [o.name for o in obstacles]:
        raise ValueError(no_such_obstacle(world, name))
    changes = {"position": position, "quaternion": quaternion, "size": size}
    changes = {k: floats(v) for k, v in changes.items() if v is not None}
    if "size" in changes:
        changes["size"] += (0.0,) * (3 - len(changes["size"]))
    return with_obstacles(
        world, [dataclasses.replace(o, **changes) if o.name == name else o for o in obstacles]
    )


def pose_error(world: World, q: np.ndarray, q_goal: np.ndarray) -> np.ndarray:
    """Distance (D,) of each joint from a goal [rad] or [m]; on the host.

    A whole turn of a joint is no error: the pose is the same, and no image tells it.
    """
    error = np.asarray(q, np.float64) - q_goal
    turns = np.round(error / (2 * np.pi)) * world.chain.is_hinge
    return np.abs(error - 2 * np.pi * turns)
