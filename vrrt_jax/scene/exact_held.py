"""Held objects in a MuJoCo model: a body for each, welded to the one that holds it."""

from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np

from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.names import free_name
from vrrt_jax.scene.exact_pairs import box_mesh
from vrrt_jax.scene.exact_slots import ALL_BITS
from vrrt_jax.scene.held import HeldObject
from vrrt_jax.scene.obstacle_kinds import KINDS

# contype and conaffinity of held objects. Meshes and polytopes see everything. Among spheres they
# see obstacles and self-collision spheres, as the robot's links do. A bit of their own is for
# collision spheres of links that have no others.
_THIN, _OWN = int(mjcf_writer.SELF_COLLISION_GEOM["contype"]), 4
HELD_BITS = {
    "meshes": (ALL_BITS, ALL_BITS),
    "polytopes": (ALL_BITS, ALL_BITS),
    "spheres": (_THIN | _OWN, _THIN | 1),
}


def add_held(
    spec: mujoco.MjSpec, held: Sequence[tuple[str, str]], bits: tuple[int, int]
) -> list[str]:
    """Add a body with one geom for each held object; MuJoCo skips what is welded to it.

    Args:
        spec: of the robot, without obstacles.
        held: the body that holds, and the kind of what it holds.
        bits: contype and conaffinity.

    Returns:
        The names of the new bodies.

    Raises:
        ValueError: there is no such body.
    """
    names, have = [], [body.name for body in spec.bodies]
    for k, (holder, kind) in enumerate(held):
        if holder not in have:
            raise ValueError(
                f"the robot's meshes have no body '{holder}' to hold something; have: "
                f"{', '.join(have[1:])}"
            )
        body = spec.body(holder).add_body(
            name=f"held: {k}", explicitinertial=True, mass=1.0, inertia=[0.01] * 3
        )
        size = KINDS[kind].geom_size((1.0, 1.0, 1.0))
        shape = {"type": KINDS[kind].geom, "size": size}
        if kind == "box":
            shape = {
                "type": mujoco.mjtGeom.mjGEOM_MESH,
                "meshname": box_mesh(spec, body.name, np.asarray(size)),
            }
        contype, conaffinity = bits
        body.add_geom(name=body.name, contype=contype, conaffinity=conaffinity, **shape)
        names.append(body.name)
    for geom in _alone(spec) if held else ():
        geom.conaffinity |= _OWN
    # MuJoCo skips neighbors along the chain, which may touch at their joint. A held object has no
    # joint with the link before: pairs of geoms bring that check back.
    for name in names:
        for geom in _geoms_before(spec, spec.body(name)):
            if (bits[0] & geom.conaffinity) | (geom.contype & bits[1]):
                spec.add_pair(geomname1=name, geomname2=geom.name)
    return names


def _alone(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    """Collision spheres on links without self-collision spheres."""
    of_kind = [
        [geom for geom in spec.geoms if geom.group == int(kind["group"])]
        for kind in (mjcf_writer.COLLISION_GEOM, mjcf_writer.SELF_COLLISION_GEOM)
    ]
    links = {_moved(spec, geom.parent).name for geom in of_kind[1]}
    return [geom for geom in of_kind[0] if _moved(spec, geom.parent).name not in links]


def _geoms_before(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> Iterator[mujoco.MjsGeom]:
    """The geoms of the link that carries the link of a body; none if that is the base."""
    before = _moved(spec, body).parent
    if before is None or _moved(spec, before) == spec.worldbody:
        return
    root, names = _moved(spec, before), {geom.name for geom in spec.geoms}
    for k, geom in enumerate(spec.geoms):
        if _moved(spec, geom.parent) == root:
            geom.name = geom.name or free_name(f"geom: {k}", names)
            yield geom


def _moved(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> mujoco.MjsBody:
    """The nearest body towards the world, itself included, that has a joint; the world if none."""
    while body != spec.worldbody and not body.joints:
        body = body.parent
    return body


def allowed_depths(
    num_bodies: int,
    attached: Sequence[HeldObject],
    held_bodies: Sequence[int],
    obstacle_bodies: Mapping[str, int],
) -> np.ndarray:
    """How deep held objects may be in their supports, (nbody, nbody) [m], zero for other pairs.

    Args:
        num_bodies: nbody of the model.
        attached: the objects.
        held_bodies: the body of each.
        obstacle_bodies: the body of each obstacle, by name.
    """
    allowed = np.zeros((num_bodies, num_bodies) if attached else (0, 0))
    for held, body in zip(attached, held_bodies, strict=True):
        for name, depth in (held.grip.supports if held.grip else {}).items():
            if name in obstacle_bodies:
                other = obstacle_bodies[name]
                allowed[body, other] = allowed[other, body] = depth
    return allowed
