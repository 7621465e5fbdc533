"""Read any MJCF or URDF robot and reduce it to what planning needs."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

_TOOL = "tool_"  # two models may use a name twice
_SEEN, _HIDDEN = 1, 3  # groups of geoms: drawn, and not
_UNPLANNED = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
}


def read_spec(path: Path, *, visuals: bool = False) -> mujoco.MjSpec:
    """Parse an MJCF or URDF file into an editable spec.

    Args:
        path: an existing file.
        visuals: keep what a URDF has for the eye, and hide what collides in its stead.

    Raises:
        ValueError: the file is not readable as a robot.
    """
    if visuals:
        try:
            if spec := _urdf_with_visuals(path):
                return spec
        except ValueError as error:
            warnings.warn(
                f"{_unreadable(path, error)}; its collision shapes are drawn instead of its visual "
                "ones",
                stacklevel=3,
            )
    try:
        return _plain(mujoco.MjSpec.from_file(str(path)))
    except ValueError as error:
        raise ValueError(_unreadable(path, error)) from None


def _urdf_with_visuals(path: Path) -> mujoco.MjSpec | None:
    """A URDF with the geoms that MuJoCo leaves out by default; None for another file."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:
        return None
    if root.tag != "robot":
        return None
    compiler = root
    for tag in ("mujoco", "compiler"):
        found = compiler.find(tag)
        compiler = ElementTree.SubElement(compiler, tag) if found is None else found
    compiler.set("discardvisual", "false")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.modelfiledir = str(path.resolve().parent)
    spec = _plain(spec)
    for body in spec.bodies:
        if not all(map(_collides, body.geoms)):
            for geom in body.geoms:
                geom.group = _HIDDEN if _collides(geom) else _SEEN
    spec.copy().compile()  # the formats of many meshes are not read
    return spec


def _collides(geom: mujoco.MjsGeom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _plain(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """The same with all bodies and joints named, and fit to compile for kinematics."""
    spec.option.disableflags = 0  # a file may switch contacts off
    # A URDF fuses links without a joint of their own into their parents: their names would be lost.
    spec.compiler.fusestatic = False
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints)):
        for index, element in enumerate(elements):
            element.name = element.name or f"{kind}_{index}"
    # Only kinematics is used; a URDF link without <inertial> would not compile.
    for body in spec.bodies[1:]:
        body.explicitinertial = True
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


def mount(spec: mujoco.MjSpec, site: str, tool: mujoco.MjSpec, name: str) -> None:
    """Put the body ``name`` of another model on a site, in place, rigid and in its rest position.

    All that hangs on it becomes a part of it; names get the prefix ``tool_``.

    Raises:
        ValueError: there is no such site or body.
    """
    where, body = spec.site(site), tool.body(name)
    if where is None or body is None:
        raise ValueError(
            f"cannot mount body '{name}' at site '{site}': "
            f"{'the robot has no such site' if where is None else 'the tool has no such body'}"
        )
    _fold(tool, body)
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


def collide_visuals(spec: mujoco.MjSpec) -> None:
    """Let the visual meshes collide, each as its convex hull, and delete all other geoms."""
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and not _collides(geom):
            geom.contype = geom.conaffinity = 1
        else:
            spec.delete(geom)


def warn_of_loops(spec: mujoco.MjSpec) -> None:
    """Tell which closed loops of linkages come open, as only trees of joints are planned."""
    loops = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    pairs = [f"{e.name1} and {e.name2}" for e in spec.equalities if e.type in loops]
    if pairs:
        warnings.warn(
            f"what ties {'; '.join(pairs)} together is not kept: fix the joints of such a linkage "
            "with freeze, or they move each by itself",
            stacklevel=3,
        )


def strip_spec(spec: mujoco.MjSpec, *, visuals: bool) -> None:
    """Delete, in place, everything but bodies, joints, keys and geoms.

    Args:
        spec: as read from the file; keyframes and equalities of joints stay, see
            :func:`freeze_joints`.
        visuals: keep the geoms that never collide, with their meshes and materials.
    """
    for equality in list(spec.equalities):
        if equality.type != mujoco.mjtEq.mjEQ_JOINT:
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
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in used and Path(mesh.file).stem not in used:
            spec.delete(mesh)


def _delete_all(spec: mujoco.MjSpec, collection: str) -> None:
    for element in list(getattr(spec, collection)):
        spec.delete(element)


def check_joints(model: mujoco.MjModel) -> None:
    """Refuse joints that cannot be planned.

    Raises:
        ValueError: a joint is free or ball, a slide has no range, or there is no joint at all.
    """
    if model.njnt == 0:
        raise ValueError(
            "the robot has no joint: nothing to plan; expected at least one hinge or slide joint"
        )
    for joint in range(model.njnt):
        name, kind = model.joint(joint).name, int(model.jnt_type[joint])
        if kind in _UNPLANNED:
            body = model.body(model.jnt_bodyid[joint]).name
            raise ValueError(
                f"joint '{name}' of body '{body}' is a {_UNPLANNED[kind]} joint; expected hinge "
                "and slide joints on a fixed base: delete it, or replace it by hinges and slides"
            )
        if kind == mujoco.mjtJoint.mjJNT_SLIDE and not model.jnt_limited[joint]:
            raise ValueError(
                f"slide joint '{name}' has no range; expected range=\"lower upper\" [m]: add it, "
                f"or fix the joint with freeze={{'{name}': 0.0}}"
            )


def joint_ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits (D,) [rad] or [m]; -pi and pi for an unlimited hinge."""
    limited = model.jnt_limited.astype(bool)
    lower = np.where(limited, model.jnt_range[:, 0], -np.pi)
    return lower, np.where(limited, model.jnt_range[:, 1], np.pi)


def home_positions(model: mujoco.MjModel) -> dict[str, float]:
    """Joint positions [rad] or [m] of the keyframe 'home', else of the first, else of the zero.

    All are clipped to the limits.
    """
    names = [model.key(k).name for k in range(model.nkey)]
    qpos = model.qpos0
    if names:
        qpos = model.key_qpos[names.index("home") if "home" in names else 0]
    home = {}
    for j in range(model.njnt):
        position = qpos[model.jnt_qposadr[j]]
        if model.jnt_limited[j]:
            position = np.clip(position, *model.jnt_range[j])
        home[model.joint(j).name] = float(position)
    return home


def frozen_positions(
    model: mujoco.MjModel, home: Mapping[str, float], freeze: Mapping[str, float] | None
) -> dict[str, float]:
    """Which joints to fix, and where.

    Args:
        model: with all joints and equalities of the file.
        home: position of each joint where the caller says nothing.
        freeze: the caller's choice.

    Returns:
        Positions [rad] or [m] by joint: those of ``freeze``, and joints that an equality couples.

    Raises:
        ValueError: a joint of ``freeze`` does not exist, or its value is no finite number or
            outside of its range.
    """
    names = [model.joint(j).name for j in range(model.njnt)]
    frozen = dict(freeze or {})
    for name, value in frozen.items():
        if name not in names:
            raise ValueError(f"freeze: joint '{name}' not in robot; have: {', '.join(names)}")
        if not np.isfinite(value):
            raise ValueError(
                f"freeze: joint '{name}' got {value}; expected a finite position [rad] or [m]"
            )
        joint = model.joint(name)
        low, high = joint.range
        if model.jnt_limited[joint.id] and not low <= value <= high:
            raise ValueError(
                f"freeze: joint '{name}' got {value:g}; expected a position in its range, "
                f"[{low:g}, {high:g}]"
            )
    coupled = {}
    for k in range(model.neq):
        if model.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT:
            for joint in (model.eq_obj1id[k], model.eq_obj2id[k]):
                if joint >= 0 and names[joint] not in frozen:
                    coupled[names[joint]] = home[names[joint]]
    if coupled:
        warnings.warn(
            "joints coupled by an equality cannot be planned one by one and are fixed: "
            + ", ".join(f"{name} = {value:g}" for name, value in coupled.items())
            + "; pass freeze={joint: position} to choose other positions",
            stacklevel=3,
        )
    return frozen | coupled


def freeze_joints(spec: mujoco.MjSpec, positions: Mapping[str, float]) -> None:
    """Delete equalities, keyframes and the given joints in place; their bodies move accordingly."""
    for name in ("equalities", "keys"):  # they refer to joints
        _delete_all(spec, name)
    for joint in [joint for joint in spec.joints if joint.name in positions]:
        position, body = positions[joint.name], joint.parent
        if body.joints[0].name != joint.name:
            raise ValueError(
                f"cannot fix joint '{joint.name}': joint '{body.joints[0].name}' of the same body "
                "comes before it and moves; give each joint a body of its own, or fix both"
            )
        if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
            offset = (position - joint.ref) * joint.axis / np.linalg.norm(joint.axis)
            rotation = np.array([1.0, 0.0, 0.0, 0.0])
        else:
            degree = np.pi / 180 if spec.compiler.degree else 1.0
            rotation = np.zeros(4)
            axis = joint.axis / np.linalg.norm(joint.axis)
            mujoco.mju_axisAngle2Quat(rotation, axis, position - joint.ref * degree)
            turned = np.zeros(3)
            mujoco.mju_rotVecQuat(turned, joint.pos, rotation)
            offset = joint.pos - turned
        _move_body(spec, body, offset, rotation)
        spec.delete(joint)


def _move_body(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, offset: np.ndarray, rotation: np.ndarray
) -> None:
    """Append a motion, given in the body's own frame, to the body's pose."""
    quaternion = np.array(body.quat)
    if body.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        compiler = spec.compiler
        quaternion = np.array(
            spec.resolve_orientation(compiler.degree, compiler.eulerseq, body.alt)
        )
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    shift, product = np.zeros(3), np.zeros(4)
    mujoco.mju_rotVecQuat(shift, offset, quaternion)
    mujoco.mju_mulQuat(product, quaternion, rotation)
    body.pos = body.pos + shift
    body.quat = product
