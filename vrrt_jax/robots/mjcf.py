"""Read any MJCF or URDF robot and reduce it to what planning needs."""

import warnings
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from vrrt_jax.robots import urdf
from vrrt_jax.robots.names import free_name
from vrrt_jax.robots.xml_file import check_mjcf

_TOOL = "tool_"  # two models may use a name twice
_WRAPS_JOINT = mujoco.mjtWrap.mjWRAP_JOINT
_SEEN, _HIDDEN = 1, 3  # groups of geoms: drawn, and not, as are those above


def read_spec(path: Path, *, visuals: bool = False) -> mujoco.MjSpec:
    """Parse an MJCF or URDF file into an editable spec, for kinematics: all masses are the same.

    Args:
        path: an existing file.
        visuals: keep what a URDF has for the eye, and hide what collides where there is some.

    Raises:
        ValueError: the file is not readable as a robot.
    """
    path = Path(path)
    try:
        root = urdf.urdf_root(path)
        if root is None:
            check_mjcf(path)
            spec = _plain(mujoco.MjSpec.from_file(str(path)))
            if visuals and _tells_apart(spec):
                _hide_what_collides(spec)
            return spec
    except ValueError as error:
        raise ValueError(_unreadable(path, error)) from None
    if visuals:
        try:
            return _with_visuals(root, path)
        except ValueError as error:
            warnings.warn(
                f"{_unreadable(path, error)}; its collision shapes are drawn instead of its visual "
                "ones",
                stacklevel=3,
            )
    try:
        return _plain(urdf.urdf_spec(root, path, visuals=False))
    except ValueError as error:
        raise ValueError(_unreadable(path, error)) from None


def read_inertial_spec(path: Path) -> mujoco.MjSpec:
    """Parse an MJCF or URDF file into an editable spec, with the masses that it gives.

    Raises:
        ValueError: the file is not readable as a robot.
    """
    path = Path(path)
    try:
        root = urdf.urdf_root(path)
        if root is None:
            check_mjcf(path)
            return _named(mujoco.MjSpec.from_file(str(path)))
        return _named(urdf.urdf_spec(root, path, visuals=False))
    except ValueError as error:
        raise ValueError(_unreadable(path, error)) from None


def _with_visuals(root: ElementTree.Element, path: Path) -> mujoco.MjSpec:
    """A URDF with the geoms that are for the eye; what collides is hidden where there are some."""
    spec = _plain(urdf.urdf_spec(root, path, visuals=True))
    for geom in spec.geoms:
        if not _collides(geom):
            geom.group = _SEEN
    _hide_what_collides(spec)
    spec.copy().compile()  # the formats of many meshes are not read
    return spec


def _tells_apart(spec: mujoco.MjSpec) -> bool:
    """Whether the groups of a file's geoms tell what is for the eye from what collides."""
    groups = {kind: {g.group for g in spec.geoms if _collides(g) == kind} for kind in (False, True)}
    return bool(groups[False]) and groups[False].isdisjoint(groups[True])


def _hide_what_collides(spec: mujoco.MjSpec) -> None:
    """Hide, in place, the shapes that collide of bodies that have others for the eye."""
    for body in spec.bodies:
        if any(not _collides(geom) and geom.group < _HIDDEN for geom in body.geoms):
            for geom in filter(_collides, body.geoms):
                geom.group = _HIDDEN


def _collides(geom: mujoco.MjsGeom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _named(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """The same with all bodies and joints named."""
    spec.option.disableflags = 0  # a file may switch contacts off
    # A URDF fuses links without a joint of their own into their parents: their names would be lost.
    spec.compiler.fusestatic = False
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints)):
        taken = {element.name for element in elements}
        for index, element in enumerate(elements):
            element.name = element.name or free_name(f"{kind}_{index}", taken)
    return spec


def _plain(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """The same with all bodies and joints named, and fit to compile for kinematics."""
    _named(spec)
    # Only kinematics is used; a URDF link without <inertial> would not compile.
    for body in spec.bodies[1:]:
        body.explicitinertial = True
        body.mocap = False  # nothing moves it here: it stands where the file puts it
        body.mass = 1.0
        body.fullinertia = [np.nan] * 6
        body.inertia = [0.01] * 3
        body.ipos = [0, 0, 0]
        body.iquat = [1, 0, 0, 0]
    return spec


def compile_spec(spec: mujoco.MjSpec, path: Path | str) -> mujoco.MjModel:
    """Compile; a failure becomes one line that names the file.

    Raises:
        ValueError: the model does not compile, for instance because a mesh is missing.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(_unreadable(path, error)) from None


def _unreadable(path: Path | str, error: Exception) -> str:
    reason = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
    return (
        f"cannot read '{path}' as a robot: {reason}; expected a complete MJCF or URDF file whose "
        "meshes are where it says"
    )


def keep_body(spec: mujoco.MjSpec, name: str) -> None:
    """Put one child of the world at its origin and delete everything else, in place."""
    for element in [*spec.worldbody.geoms, *spec.worldbody.bodies]:
        if element.name != name:
            spec.delete(element)
    body = spec.body(name)
    body.pos, body.quat = [0, 0, 0], [1, 0, 0, 0]


def mount(
    spec: mujoco.MjSpec, site: str, tool: mujoco.MjSpec, name: str, *, fold: bool = True
) -> None:
    """Put the body ``name`` of another model on a site, in place, rigid and in its rest position.

    Names get the prefix ``tool_``.

    Args:
        spec: what gets the tool.
        site: of the spec.
        tool: the other model.
        name: of its body.
        fold: all that hangs on the body becomes a part of it, but for masses.

    Raises:
        ValueError: there is no such site or body.
    """
    where, body = spec.site(site), tool.body(name)
    if where is None or body is None:
        raise ValueError(
            f"cannot mount body '{name}' at site '{site}': "
            f"{'the robot has no such site' if where is None else 'the tool has no such body'}"
        )
    if fold:
        _fold(tool, body)
    else:
        _delete_all(tool, "joints")
    mounted = where.attach_body(body, _TOOL, "")
    mounted.pos, mounted.quat = [0, 0, 0.007], [1, 0, 0, -1]  # the thickness of the coupling


def _fold(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """Make a body and everything that hangs on it one body."""
    for child in list(body.bodies):
        _fold(spec, child)
        for geom in child.geoms:
            offset, quaternion = np.zeros(3), np.zeros(4)
            turned = child.quat / np.linalg.norm(child.quat)
            mujoco.mju_mulPose(offset, quaternion, child.pos, turned, geom.pos, geom.quat)
            body.add_geom(
                type=geom.type,
                meshname=geom.meshname,
                size=geom.size,
                material=geom.material,
                rgba=geom.rgba,
                contype=geom.contype,
                conaffinity=geom.conaffinity,
                pos=offset,
                quat=quaternion,
            )
        spec.delete(child)


def drop_shapes(spec: mujoco.MjSpec) -> None:
    """Delete, in place, the geoms of bodies whose masses do not come from them, and meshes."""
    for body in spec.bodies:
        for geom in list(body.geoms) if body.explicitinertial else []:
            spec.delete(geom)
    _delete_unused_meshes(spec)


def keep_torque_ranges(spec: mujoco.MjSpec) -> None:
    """Give joints the torque ranges of their actuators, and delete all that acts, in place."""
    joints = {joint.name: joint for joint in spec.joints}
    for actuator in spec.actuators:
        low, high = actuator.forcerange
        is_of_joint = actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target in joints
        if is_of_joint and low < high:
            ends = actuator.gear[0] * low, actuator.gear[0] * high
            joints[actuator.target].actfrcrange = sorted(ends)
    for name in ("tuples", "sensors", "actuators", "tendons", "pairs", "excludes", "equalities"):
        _delete_all(spec, name)


def collide_visuals(spec: mujoco.MjSpec) -> None:
    """Let the visual meshes collide, each as its convex hull, and delete all other geoms."""
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and not _collides(geom):
            geom.contype = geom.conaffinity = 1
        else:
            spec.delete(geom)


def warn_of_what_is_lost(spec: mujoco.MjSpec) -> None:
    """Tell what ties joints or shapes together in a file, and is not kept.

    Only trees of joints are planned, so that loops of linkages come open. Joints that an equality
    couples are another matter, see :func:`vrrt_jax.robots.frozen.frozen_positions`.
    """
    loops = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    active = [equality for equality in spec.equalities if equality.active]
    ties = [f"{e.name1} and {e.name2}" for e in active if e.type in loops]
    tendons = {tendon.name: tendon for tendon in spec.tendons}
    for equality in active:
        if equality.type == mujoco.mjtEq.mjEQ_TENDON:
            names = [name for name in (equality.name1, equality.name2) if name]
            ties.append(" and ".join(_tendon(tendons[name]) for name in names))
    if ties:
        warnings.warn(
            f"what ties {'; '.join(ties)} together is not kept: fix the joints of such a linkage "
            "with freeze, or they move each by itself",
            stacklevel=3,
        )
    bounded = [tendon for tendon in spec.tendons if _is_limited(tendon)]
    if bounded:
        warnings.warn(
            f"the limits of {'; '.join(map(_tendon, bounded))} are not kept: the joints move "
            "within their own limits",
            stacklevel=3,
        )
    alone = [g.name for g in spec.geoms if not _collides(g) and _is_paired(spec, g.name)]
    if alone:
        warnings.warn(
            f"geoms {', '.join(alone)} collide by contact pairs only, which are not kept: give "
            "them contype and conaffinity, or the robot is planned without them",
            stacklevel=3,
        )


def _tendon(tendon: mujoco.MjsTendon) -> str:
    """Words for a tendon: "tendon 't' (joints a, b)"."""
    joints = [str(wrap.target.name) for wrap in tendon.path if wrap.type == _WRAPS_JOINT]
    return f"tendon '{tendon.name}'" + (f" (joints {', '.join(joints)})" if joints else "")


def _is_limited(tendon: mujoco.MjsTendon) -> bool:
    is_auto = tendon.limited == mujoco.mjtLimited.mjLIMITED_AUTO
    return bool(tendon.limited == mujoco.mjtLimited.mjLIMITED_TRUE) or (
        bool(is_auto) and tendon.range[0] < tendon.range[1]
    )


def _is_paired(spec: mujoco.MjSpec, name: str) -> bool:
    return bool(name) and any(name in (pair.geomname1, pair.geomname2) for pair in spec.pairs)


def strip_spec(spec: mujoco.MjSpec, *, visuals: bool) -> None:
    """Delete, in place, everything but bodies, joints, keys and geoms.

    Args:
        spec: as read from the file; keyframes and equalities of joints stay, see
            :func:`vrrt_jax.robots.frozen.freeze_joints`.
        visuals: keep the geoms that never collide, with their meshes and materials.
    """
    for equality in list(spec.equalities):
        if equality.type != mujoco.mjtEq.mjEQ_JOINT or not equality.active:
            spec.delete(equality)
    for name in ("tuples", "sensors", "actuators", "tendons", "pairs", "flexes", "skins"):
        _delete_all(spec, name)
    for name in ("sites", "cameras", "lights"):
        _delete_all(spec, name)
    for key in spec.keys:  # sized for the actuators that are gone
        key.ctrl, key.act = [], []
    for geom in list(spec.geoms):
        geom.margin = geom.gap = 0.0
        # a floor or a height field is the world's, and neither can be covered with spheres
        is_ground = geom.type in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        if is_ground or (not visuals and not _collides(geom)):
            spec.delete(geom)
    if not visuals:
        for geom in spec.geoms:
            geom.material = ""
        for name in ("materials", "textures", "hfields"):
            _delete_all(spec, name)
    _delete_unused_meshes(spec)


def _delete_unused_meshes(spec: mujoco.MjSpec) -> None:
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in used and Path(mesh.file).stem not in used:
            spec.delete(mesh)


def _delete_all(spec: mujoco.MjSpec, collection: str) -> None:
    for element in list(getattr(spec, collection)):
        spec.delete(element)
