"""Write the collision model of a robot as MJCF: bodies, joints, spheres and polytopes."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from vrrt_jax.core.data_file import read_text
from vrrt_jax.robots.kinematics import BodySpheres
from vrrt_jax.robots.names import free_name
from vrrt_jax.robots.xml_file import check_mjcf

# Robot spheres of two kinds and obstacles (contype=1 conaffinity=0) share a model. MuJoCo checks
# a pair where one's contype meets the other's conaffinity: collision spheres against obstacles,
# self-collision spheres against each other, and nothing else.
COLLISION_GEOM = {"group": "3", "contype": "0", "conaffinity": "1"}
SELF_COLLISION_GEOM = {"group": "4", "contype": "2", "conaffinity": "2"}
# Polytopes touch nothing in this model: they are for a second look at what spheres touch.
POLYTOPE_GEOM = {"group": "5", "contype": "8", "conaffinity": "0"}
# The names of the kinds in the text: packaged files carry them.
_CLASSES = (("cover", COLLISION_GEOM), ("thin", SELF_COLLISION_GEOM))
_POLYTOPE = "polytope"
_SOURCE = "mesh_source"
FROZEN = "frozen: "  # before the names of joints, in custom numbers: where each is fixed


def collision_mjcf(
    model: mujoco.MjModel,
    *,
    name: str,
    collision: BodySpheres,
    self_collision: BodySpheres,
    polytopes: Mapping[int, Sequence[np.ndarray]],
    ignored_pairs: Sequence[tuple[str, str]],
    home: np.ndarray,
    mesh_source: str | None,
    frozen: Mapping[str, float],
    comment: str = "",
) -> str:
    """The text of a model that C MuJoCo compiles by itself.

    Args:
        model: bodies and joints to write; its geoms are left out.
        name: of the robot.
        collision: spheres checked against obstacles.
        self_collision: spheres checked against each other.
        polytopes: by body the vertices (V, 3) of what contains it [m]; see
            :func:`vrrt_jax.robots.polytopes.outer_polytopes`.
        ignored_pairs: pairs of bodies that are not checked against each other.
        home: (D,) joint positions of the keyframe [rad] or [m].
        mesh_source: where the true geometry is found, kept for :func:`source_of`.
        frozen: joints of the true geometry that are fixed [rad] or [m], kept likewise.
        comment: written at the top.
    """
    root = ET.Element("mujoco", model=name)
    if comment:
        root.append(ET.Comment(comment))
    # Masses are of no interest, but bodies without spheres must compile too.
    ET.SubElement(
        root, "compiler", angle="radian", autolimits="true", boundmass="1", boundinertia="0.01"
    )
    default = ET.SubElement(root, "default")
    polytope_class = [(_POLYTOPE, POLYTOPE_GEOM | {"type": "mesh"})] if polytopes else []
    for label, fields in (*_CLASSES, *polytope_class):
        ET.SubElement(ET.SubElement(default, "default", {"class": label}), "geom", fields)
    asset = ET.SubElement(root, "asset")
    # Bodies come parents first, so that the parent's element always stands already.
    elements = {0: ET.SubElement(root, "worldbody")}
    for body in range(model.nbody):
        if body:
            parent = elements[int(model.body_parentid[body])]
            elements[body] = _add_body(parent, model, body)
        for (label, _), spheres in zip(_CLASSES, (collision, self_collision), strict=True):
            for k in np.flatnonzero(spheres.body == body):
                where = {"pos": _numbers(spheres.center[k]), "size": _numbers(spheres.radius[k])}
                ET.SubElement(elements[body], "geom", {"class": label} | where)
        for k, vertices in enumerate(polytopes.get(body, ())):
            mesh = f"{model.body(body).name}_{k}"
            ET.SubElement(asset, "mesh", name=mesh, vertex=_numbers(vertices.ravel()))
            ET.SubElement(elements[body], "geom", {"class": _POLYTOPE, "mesh": mesh})
    # What MJCF has no element for is kept as custom text and numbers.
    custom = ET.SubElement(root, "custom")
    if mesh_source is not None:
        ET.SubElement(custom, "text", name=_SOURCE, data=mesh_source)
    for joint, position in frozen.items():
        ET.SubElement(custom, "numeric", name=FROZEN + joint, data=_numbers(position))
    contact = ET.SubElement(root, "contact")
    for first, second in ignored_pairs:
        ET.SubElement(contact, "exclude", body1=first, body2=second)
    ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="home", qpos=_numbers(home))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def is_polytope(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms (ngeom,) bool of a written model are polytopes."""
    return (
        (model.geom_group == int(POLYTOPE_GEOM["group"]))
        & (model.geom_contype == int(POLYTOPE_GEOM["contype"]))
        & (model.geom_conaffinity == int(POLYTOPE_GEOM["conaffinity"]))
        & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    )


def keep_geoms(spec: mujoco.MjSpec, *, polytopes: bool) -> bool:
    """Delete the spheres of a written model, or its polytopes, in place.

    Args:
        spec: of a text by :func:`collision_mjcf`.
        polytopes: whether they stay, and the spheres go, if there are any.

    Returns:
        Whether polytopes are what is left.
    """
    group = int(POLYTOPE_GEOM["group"])
    polytopes &= any(geom.group == group for geom in spec.geoms)
    for geom in list(spec.geoms):
        if (geom.group == group) != polytopes:
            spec.delete(geom)
    for mesh in () if polytopes else list(spec.meshes):
        spec.delete(mesh)
    return polytopes


def renamed(text: str, name: str) -> str:
    """A written model under another name of the robot."""
    root = ET.fromstring(text, _with_comments())
    root.set("model", name)
    return ET.tostring(root, encoding="unicode") + "\n"


def check_written(path: str | Path) -> None:
    """Raise a ValueError for a file that :func:`replace_spheres` cannot use.

    Raises:
        FileNotFoundError: there is no such file.
    """
    check_mjcf(path)
    try:
        root = ET.fromstring(read_text(path, "XML"), _with_comments())
    except ET.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from None
    tags = [part.tag for part in root]
    if not {ET.Comment, "contact", "worldbody"} <= {*tags}:
        raise ValueError(
            "it lacks a comment, <contact> or <worldbody>; expected a file that vrrt spheres wrote"
        )


def _with_comments() -> ET.XMLParser:
    return ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))


def replace_spheres(text: str, fitted: str) -> str:
    """A written model with the spheres, polytopes and ignored pairs of another one.

    What was added to the first by hand stays: joints, positions at home, custom numbers.

    Args:
        text: the model, from :func:`collision_mjcf`.
        fitted: the other one, whose bodies have the same names.

    Raises:
        ValueError: the bodies have other names.
    """
    root, other = (ET.fromstring(model, _with_comments()) for model in (text, fitted))
    bodies, others = (
        {body.get("name"): body for body in tree.iter() if body.tag in ("worldbody", "body")}
        for tree in (root, other)
    )
    if bodies.keys() != others.keys():
        names = ", ".join(sorted(str(name) for name in bodies.keys() ^ others.keys()))
        raise ValueError(f"bodies of one model only: {names}; expected the same in both")
    for name, body in bodies.items():
        for geom in body.findall("geom"):
            body.remove(geom)
        # Spheres stand behind the joints, before further bodies.
        place = len(body.findall("joint"))
        for geom in reversed(others[name].findall("geom")):
            body.insert(place, geom)
    # The comment says where the spheres come from.
    for tag in (ET.Comment, "default", "asset", "contact"):
        place = next((k for k, part in enumerate(root) if part.tag == tag), len(root))
        root[place : place + 1] = [part for part in other if part.tag == tag]
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def source_of(spec: mujoco.MjSpec) -> tuple[str | None, dict[str, float]]:
    """The ``mesh_source`` and ``frozen`` that :func:`collision_mjcf` kept, else None and {}."""
    sources = [element.data for element in spec.texts if element.name == _SOURCE]
    frozen = {
        element.name.removeprefix(FROZEN): float(element.data[0])
        for element in spec.numerics
        if element.name.startswith(FROZEN)
    }
    return (sources[0] if sources else None), frozen


def _add_body(parent: ET.Element, model: mujoco.MjModel, body: int) -> ET.Element:
    """A body and its joints; each further joint gets a body of its own inside."""
    name, names = model.body(body).name, {model.body(k).name for k in range(model.nbody)}
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    element = ET.SubElement(parent, "body", name=name)
    if np.any(model.body_pos[body]):
        element.set("pos", _numbers(model.body_pos[body]))
    if not np.allclose(model.body_quat[body], [1, 0, 0, 0], atol=1e-15):
        element.set("quat", _numbers(model.body_quat[body]))
    for count, joint in enumerate(joints):
        if count:
            # the first keeps the plain name only if it is the last: that one carries the geoms
            between = f"{name}__{model.joint(joint - 1).name}"
            element.set("name", free_name(between, names))
            element = ET.SubElement(element, "body", name=name)
        _add_joint(element, model, joint)
    return element


def _add_joint(element: ET.Element, model: mujoco.MjModel, joint: int) -> None:
    kind = mujoco.mjtJoint(model.jnt_type[joint]).name[6:].lower()
    attributes = {
        "name": model.joint(joint).name,
        "type": kind,
        "axis": _numbers(model.jnt_axis[joint]),
    }
    if np.any(model.jnt_pos[joint]):
        attributes["pos"] = _numbers(model.jnt_pos[joint])
    if model.jnt_limited[joint]:
        attributes["range"] = _numbers(model.jnt_range[joint])
    reference = model.qpos0[model.jnt_qposadr[joint]]
    if reference:
        attributes["ref"] = _numbers(reference)
    ET.SubElement(element, "joint", attributes)


def _numbers(values: np.ndarray | float) -> str:
    # `+ 0.0` turns -0 into 0
    return " ".join(f"{value + 0.0:.10g}" for value in np.atleast_1d(values))
