"""The kinds of obstacles, in one table: a new kind is a new entry of :data:`KINDS`.

An obstacle in a slot is one formula, a box with optional rounding and an optional round section. A
sphere is a rounded point, a capsule a rounded segment, a cylinder a box of round section, and a
plane the top of a very large box. A kind says how its size becomes such a box and back.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import mujoco

HALF_SPACE = 50.0  # [m] half the edge of the box that stands for a plane

Size = Sequence[float]  # (3,) as MuJoCo's geom size [m]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlotShape:
    """The shape of one slot, see :class:`vrrt_jax.scene.obstacles.Obstacles`."""

    half: Size = (0.0, 0.0, 0.0)  # half extents before rounding [m]
    rounding: float = 0.0  # radius added all around [m]
    is_round: bool = False  # round section about the local z axis


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObstacleKind:
    """What the scene needs to know about a kind of obstacle."""

    geom: mujoco.mjtGeom  # its type in MuJoCo
    num_sizes: int  # how many numbers of its size are used; they must be positive
    encode: Callable[[Size], SlotShape]  # size -> shape of the slot
    decode: Callable[[SlotShape], Size]  # shape of the slot -> size
    shift: float = 0.0  # from its position to the center of its slot, along its z axis [m]
    geom_size: Callable[[Size], Size] = tuple  # size -> the size that MuJoCo compiles


KINDS: Mapping[str, ObstacleKind] = {
    "sphere": ObstacleKind(  # size: radius
        geom=mujoco.mjtGeom.mjGEOM_SPHERE,
        num_sizes=1,
        encode=lambda size: SlotShape(rounding=size[0]),
        decode=lambda shape: (shape.rounding, 0.0, 0.0),
    ),
    "box": ObstacleKind(  # size: half edges
        geom=mujoco.mjtGeom.mjGEOM_BOX,
        num_sizes=3,
        encode=lambda size: SlotShape(half=size),
        decode=lambda shape: shape.half,
    ),
    "capsule": ObstacleKind(  # size: radius, half length
        geom=mujoco.mjtGeom.mjGEOM_CAPSULE,
        num_sizes=2,
        encode=lambda size: SlotShape(half=(0.0, 0.0, size[1]), rounding=size[0]),
        decode=lambda shape: (shape.rounding, shape.half[2], 0.0),
    ),
    "cylinder": ObstacleKind(  # size: radius, half length
        geom=mujoco.mjtGeom.mjGEOM_CYLINDER,
        num_sizes=2,
        encode=lambda size: SlotShape(half=(size[0], size[0], size[1]), is_round=True),
        decode=lambda shape: (shape.half[0], shape.half[2], 0.0),
    ),
    "plane": ObstacleKind(  # its size is of no interest: it has no end
        geom=mujoco.mjtGeom.mjGEOM_PLANE,
        num_sizes=0,
        encode=lambda size: SlotShape(half=(HALF_SPACE, HALF_SPACE, HALF_SPACE)),
        decode=lambda shape: (0.0, 0.0, 1.0),
        shift=-HALF_SPACE,
        # The last number is the spacing of the grid that is drawn; zero does not compile.
        geom_size=lambda size: (size[0], size[1], 1.0),
    ),
}
