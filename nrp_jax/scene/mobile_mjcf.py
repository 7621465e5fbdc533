"""The MJCF text of a mobile robot: its base and primitives, and the arm of a packaged robot.

Joint frames, axes and limits of an arm stand once, in the file of the packaged robot. The file of
the mobile robot names it, and lists the primitives of each of the arm's bodies::

    <custom><text name="arm" data="fetch"/></custom>
    ...
    <body name="base">
      <body name="elbow_flex"> <geom .../> </body>

A listed body takes its place in the tree, its frame and its joint from the arm's body of that name.
A frame or a joint's attribute that the mobile robot's file states itself wins.
"""

from collections.abc import Iterator
from xml.etree import ElementTree

from vrrt_jax.robots.mjcf_writer import FROZEN
from vrrt_jax.robots.packaged import robot_path, scenes_dir

_FRAME = ("pos", "quat")


def mobile_mjcf(name: str) -> str:
    """The complete MJCF of a mobile robot, which compiles by itself.

    Args:
        name: of a file in ``scenes/mobile_robots``.

    Raises:
        ValueError: the bodies of the file are not those of the arm that it names.
    """
    text = (scenes_dir() / "mobile_robots" / f"{name}.xml").read_text()
    root = ElementTree.fromstring(text)
    arm_name = root.find("custom/text[@name='arm']")
    if arm_name is None:
        return text
    arm = ElementTree.parse(robot_path(arm_name.get("data", ""))).getroot()
    _drop_fixed_joints(arm)
    _attach(root, next(arm.iter("worldbody")))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _drop_fixed_joints(arm: ElementTree.Element) -> None:
    """Delete the joints of an arm's file that are not planned, in place."""
    fixed = {number.get("name", "").removeprefix(FROZEN) for number in arm.iter("numeric")}
    for body in arm.iter("body"):
        for joint in body.findall("joint"):
            if joint.get("name") in fixed:
                body.remove(joint)


def _attach(root: ElementTree.Element, arm: ElementTree.Element) -> None:
    """Give the bodies listed in ``root`` the tree, frames and joints of the arm, in place."""
    parents = {child: parent for parent in root.iter() for child in parent}
    listed = {body.get("name"): body for body in root.iter("body")}
    for arm_body, parent_name in _moving_bodies(arm):
        name = _plain(arm_body)
        if name not in listed:
            raise ValueError(
                f"the mobile robot '{root.get('model')}' lists no body '{name}', which its arm "
                f"has; have: {', '.join(map(str, listed))}"
            )
        body = listed[name]
        # The arm's first body stays on the base; each further one moves onto the one before.
        if parent_name is not None:
            parents[body].remove(body)
            listed[parent_name].append(body)
        for key in _FRAME:
            if key in arm_body.attrib and key not in body.attrib:
                body.set(key, arm_body.attrib[key])
        _take_joint(body, arm_body)


def _take_joint(body: ElementTree.Element, arm_body: ElementTree.Element) -> None:
    arm_joint = arm_body.find("joint")
    assert arm_joint is not None  # as _moving_bodies has found it
    own = body.find("joint")
    if own is None:
        own = ElementTree.Element("joint")
        body.insert(0, own)
    own.attrib = {**arm_joint.attrib, "name": _plain(arm_joint), **own.attrib}


def _moving_bodies(
    element: ElementTree.Element, parent: str | None = None, *, displaced: bool = False
) -> Iterator[tuple[ElementTree.Element, str | None]]:
    """Bodies with a joint, parents first, and the name of the one that carries each of them."""
    for body in element.findall("body"):
        if body.find("joint") is not None:
            if displaced:
                raise ValueError(
                    f"the arm's body '{body.get('name')}' hangs on a body that has a frame but no "
                    "joint; expected moving bodies that hang on each other directly"
                )
            yield body, parent
            yield from _moving_bodies(body, _plain(body))
        else:
            has_frame = any(key in body.attrib for key in _FRAME)
            yield from _moving_bodies(body, parent, displaced=displaced or has_frame)


def _plain(element: ElementTree.Element) -> str:
    """The name without what a file adds to it: "robot0:elbow_flex_link" is "elbow_flex"."""
    name = element.get("name", "").rpartition(":")[2]
    return name.removesuffix("_link").removesuffix("_joint")
