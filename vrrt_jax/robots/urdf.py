"""What MuJoCo does not do with a URDF file: find its meshes, and mind what its limits say."""

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import mujoco
import numpy as np

from vrrt_jax.robots.xml_file import check_number, xml_root

_PACKAGES = ("package://", "model://", "$(find ")  # before the name of a package
_FILE = "file://"
_XACRO = tuple(
    f"{{http://{site}/xacro}}" for site in ("www.ros.org/wiki", "ros.org/wiki", "wiki.ros.org")
)
_READ = (".stl", ".obj", ".msh")  # endings of the meshes that MuJoCo reads
_LIMITED = ("revolute", "prismatic")
_MOVING = (*_LIMITED, "continuous")
_NAMES = {"lower", "upper"}
_MOST_PARENTS = 6  # folders above the file that meshes are looked for in


def urdf_root(path: Path) -> ElementTree.Element | None:
    """The root of a URDF file; None for a file of another kind.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is a xacro file, which only becomes a URDF, or declares entities.
    """
    root = xml_root(path)
    if root is None:
        return None
    for element in root.iter():
        if str(element.tag).startswith(_XACRO):
            raise ValueError(
                f"it has the element xacro:{str(element.tag).partition('}')[2]}, of which a URDF "
                f"is yet to be made: xacro {path.name} > {path.stem.removesuffix('.urdf')}.urdf"
            )
    return root if root.tag == "robot" else None


def urdf_spec(root: ElementTree.Element, path: Path, *, visuals: bool) -> mujoco.MjSpec:
    """Read a URDF whose meshes may have URLs.

    Args:
        root: from :func:`urdf_root`; the names of its meshes become paths.
        path: of the file.
        visuals: keep what is for the eye.

    Raises:
        ValueError: MuJoCo cannot read it, or a mesh that is used is nowhere.
    """
    _check_tree(root)
    compiler = root
    for tag in ("mujoco", "compiler"):
        found = compiler.find(tag)
        compiler = ElementTree.SubElement(compiler, tag) if found is None else found
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None and joint.get("type") in _LIMITED and _NAMES & set(limit.keys()):
            for name in sorted(_NAMES):
                # MuJoCo takes one alone for none at all. NaN is told of later.
                text = limit.get(name, "0")
                limit.set(name, "0" if text.strip().lower() == "nan" else text)
    for part in root.iter():
        for key, text in part.attrib.items():
            check_number(part, key, text)
    _narrow_to_soft_limits(root)
    compiler.set("discardvisual", "false" if visuals else "true")
    folder = path.resolve().parent
    packages = {_package(mesh.get("filename", "")) for _, _, mesh in _meshes(root)} - {""}
    for link, kind, mesh in _meshes(root):
        if kind == "visual" and not visuals:
            continue
        name = mesh.get("filename", "")
        places = list(_places(name, folder, compiler.get("meshdir", "")))
        there = next((place for place in places if os.path.isfile(place)), None)
        if there is None:
            raise ValueError(_not_found(name, link, places))
        if there.suffix.lower() not in _READ:
            raise ValueError(
                f"mesh '{name}' of link '{link}' is a {there.suffix} file; expected one of "
                f"{', '.join(_READ)}: convert it, and write the new name into the URDF"
            )
        package = _package(name)
        if len(packages) > 1 and package and package not in there.parts:
            warnings.warn(
                f"mesh '{name}' of link '{link}' is taken from '{there}', which is in no folder "
                f"'{package}': is it that of another package?",
                stacklevel=6,
            )
        mesh.set("filename", str(there.resolve()))
    compiler.attrib.pop("meshdir", None)
    compiler.set("strippath", "false")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.modelfiledir = str(folder)
    return spec


def _check_tree(root: ElementTree.Element) -> None:
    """Raise a ValueError if names are there twice, or links hang on nothing: MuJoCo takes both."""
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two {kind}s are named {', '.join(twice)}; give each its own name")
    parts = [joint.find("child") for joint in root.findall("joint")]
    children = {part.get("link") for part in parts if part is not None}
    roots = [name for link in root.findall("link") if (name := link.get("name")) not in children]
    if len(roots) > 1:
        raise ValueError(
            f"the links {', '.join(map(str, roots))} are children of no joint; expected one such "
            "link, the base: add the joints that carry the others"
        )


def _narrow_to_soft_limits(root: ElementTree.Element) -> None:
    """Put soft limits, where a controller stops the joint, in place of wider ones, in place."""
    for joint in root.findall("joint"):
        soft, limit = joint.find("safety_controller"), joint.find("limit")
        if soft is None or limit is None or joint.get("type") not in _LIMITED:
            continue
        hard = [_limit(limit, name) for name in ("lower", "upper")]
        ends = [_limit(soft, f"soft_{name}_limit") for name in ("lower", "upper")]
        if not np.isfinite(ends).all():
            raise ValueError(
                f"joint '{joint.get('name', '')}' has the soft limits {ends} in its "
                "safety_controller; expected two numbers, or no safety_controller"
            )
        low, high = max(hard[0], ends[0]), min(hard[1], ends[1])
        if ends == [0.0, 0.0] or [low, high] == hard:  # left out, they are 0
            continue
        name = joint.get("name", "")
        if not low < high:
            raise ValueError(
                f"joint '{name}' has the soft limits {ends} in its safety_controller, of which "
                f"none is inside its limits {hard}; correct them, or remove the safety_controller"
            )
        warnings.warn(
            f"joint '{name}' is planned within [{low:g}, {high:g}], the soft limits of its "
            f"safety_controller, not within its limits {hard}; remove the safety_controller to "
            "plan up to these",
            stacklevel=7,
        )
        limit.set("lower", repr(low))
        limit.set("upper", repr(high))


def _limit(element: ElementTree.Element, name: str) -> float:
    """A limit; 0 where it is left out, and NaN for what is no number, of which others tell."""
    try:
        return float(element.get(name) or 0.0)
    except ValueError:
        return np.nan


def _meshes(root: ElementTree.Element) -> Iterator[tuple[str, str, ElementTree.Element]]:
    """The meshes of a URDF, with the names of their links, and "collision" or "visual"."""
    for link in root.findall("link"):
        for kind in ("collision", "visual"):
            for mesh in link.findall(f"{kind}/geometry/mesh"):
                yield link.get("name", ""), kind, mesh


def _package(name: str) -> str:
    """The package that the URL of a mesh names, or ''."""
    scheme = next((scheme for scheme in _PACKAGES if name.startswith(scheme)), None)
    return "" if scheme is None else name.removeprefix(scheme).partition("/")[0].rstrip(")")


def _places(name: str, folder: Path, meshdir: str) -> Iterator[Path]:
    """Where a mesh may be, the likeliest place first."""
    name = name.strip().replace("\\", "/")
    if "%" in name and "://" in name:
        yield from _places(unquote(name), folder, meshdir)
    if name.startswith(_FILE):
        name = name.removeprefix(_FILE).removeprefix("localhost")
    parents = [folder, *folder.parents[:_MOST_PARENTS]]
    for scheme in _PACKAGES:
        if name.startswith(scheme):
            rest = name.removeprefix(scheme).replace(")", "", 1 if scheme[0] == "$" else 0)
            yield from (parent / rest for parent in parents)
            # The folder of the package may have been renamed, or be the one of the file.
            yield from (parent / rest.partition("/")[2] for parent in parents)
            return
    if meshdir:
        yield folder / meshdir / name
        yield folder / meshdir / Path(name).name
    yield from (parent / name for parent in parents)


def _not_found(name: str, link: str, places: list[Path]) -> str:
    looked = ", ".join(dict.fromkeys(str(place) for place in places[:3]))
    return (
        f"mesh '{name}' of link '{link}' was not found; looked for it at {looked} and in the "
        "folders above: copy it there, or write its path into the URDF, relative to the URDF as in "
        '"../meshes/arm.stl", or absolute as in "file:///home/me/meshes/arm.stl"'
    )


def bad_urdf_joints(root: ElementTree.Element) -> dict[str, str]:
    """What is wrong with joints, most of all with their limits, by name: words that follow it.

    Only a ``continuous`` joint turns for ever. A limit that is left out is 0. A joint that mimics
    what does not move would be planned by itself.
    """
    found = {}
    moving = [j.get("name", "") for j in root.findall("joint") if j.get("type") in _MOVING]
    for joint in root.findall("joint"):
        kind, limit = joint.get("type", ""), joint.find("limit")
        mimic = joint.find("mimic")
        if mimic is not None and mimic.get("joint") not in moving:
            found[joint.get("name", "")] = (
                f"mimics '{mimic.get('joint')}', which is no joint that moves; expected one of "
                f"{', '.join(moving)}: correct the name"
            )
            continue
        if kind not in _LIMITED:
            continue
        given = {} if limit is None else limit.attrib
        texts = given.get("lower"), given.get("upper")
        if texts == (None, None):
            found[joint.get("name", "")] = f"is {kind} and has no limits; {_advice(kind)}"
            continue
        try:
            low, high = (float(text or 0.0) for text in texts)
        except ValueError:
            low = high = np.nan
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            found[joint.get("name", "")] = (
                f"is {kind} and has the limits lower={texts[0] or 0}, upper={texts[1] or 0}; "
                f"{_advice(kind)}"
            )
    return found


def _advice(kind: str) -> str:
    other = ' or type="continuous" for one that turns for ever' if kind == "revolute" else ""
    return (
        'expected <limit lower="..." upper="..."/> with two numbers, lower below upper: correct '
        f'it, or write type="fixed"{other}'
    )
