"""Where a camera is: transforms whose direction is said by their name."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vrrt_jax.core.fields import check_fields
from vrrt_jax.core.rigid import rigid

FROM_CAMERA, TO_CAMERA = "camera_to_world", "world_to_camera"
POSES = (FROM_CAMERA, TO_CAMERA, "world_to_cam")
QUATERNIONS = {  # a rotation by the name of its field: which of the numbers is w
    "quaternion_wxyz": "wxyz",
    "quaternion_xyzw": "xyzw",
    "rotation": "mapping",  # of geometry_msgs/Transform
    "orientation": "mapping",  # of geometry_msgs/Pose
}
POSITIONS = ("translation", "position")
NOT_UNIT = 0.01  # how far the length of a quaternion may be from one
WHAT_TO_WRITE = (
    f'say where the camera is: give "{FROM_CAMERA}" (or "{TO_CAMERA}") as a 4 x 4 matrix, or as '
    '{"translation": [x, y, z], "quaternion_xyzw": [x, y, z, w]} [m], in the camera\'s file or '
    "with --extrinsics FILE; the world is the robot's base, and the camera looks along its z, with "
    "x right and y down (ROS: the optical frame)"
)
_UNSAID = "say which of its numbers is w: quaternion_wxyz or quaternion_xyzw"
ADVICE = {"quaternion": _UNSAID, "quat": _UNSAID, "q": _UNSAID}


def world_to_camera(fields: Mapping[str, Any]) -> np.ndarray:
    """The rigid transform (4, 4) from the world to the camera, in float64.

    Args:
        fields: one of :data:`POSES`, as a matrix of 4 x 4 or as a quaternion and a translation [m].

    Raises:
        ValueError: none is there, or two are, or the transform is not rigid.
    """
    given = [name for name in POSES if name in fields]
    if not given:
        raise ValueError(f"the camera has no extrinsics; {WHAT_TO_WRITE}")
    if len(given) > 1:
        raise ValueError(f"the camera has {' and '.join(given)}; give one of them")
    (name,) = given
    value = fields[name]
    matrix = rigid(_from_parts(value, name) if isinstance(value, Mapping) else value, name)
    return np.linalg.inv(matrix) if name == FROM_CAMERA else matrix


def _from_parts(fields: Mapping[str, Any], name: str) -> np.ndarray:
    """A transform (4, 4) from a quaternion and a translation."""
    check_fields(fields, (*QUATERNIONS, *POSITIONS), name, ADVICE)
    turns = [key for key in QUATERNIONS if key in fields]
    moves = [key for key in POSITIONS if key in fields]
    if len(turns) != 1 or len(moves) != 1:
        raise ValueError(
            f"{name} has {', '.join([*turns, *moves]) or 'nothing'}; expected one rotation "
            f"({', '.join(QUATERNIONS)}) and one of {', '.join(POSITIONS)}"
        )
    order = QUATERNIONS[turns[0]]
    what = f"{name}'s {turns[0]}"
    if order == "mapping":
        if not isinstance(fields[turns[0]], Mapping):
            raise ValueError(f"{what} is {fields[turns[0]]!r}; expected x, y, z, w as fields")
        xyzw = _numbers(fields[turns[0]], "xyzw", what)
    else:
        numbers = _numbers(fields[turns[0]], order, what)
        xyzw = np.array([numbers[order.index(axis)] for axis in "xyzw"])
    length = np.linalg.norm(xyzw)
    if abs(length - 1) > NOT_UNIT:
        raise ValueError(f"{what} has the length {length:.3g}; expected a unit quaternion")
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(xyzw).as_matrix()
    transform[:3, 3] = _numbers(fields[moves[0]], "xyz", f"{name}'s {moves[0]}")
    return transform


def _numbers(value: Any, axes: str, what: str) -> np.ndarray:
    """Finite numbers, one for each axis, from a list or from fields x, y, ..."""
    if isinstance(value, Mapping):
        check_fields(value, tuple(axes), what)
        value = [value.get(axis) for axis in axes]
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    if numbers.shape != (len(axes),) or not np.all(np.isfinite(numbers)):
        raise ValueError(f"{what} is {value!r}; expected {len(axes)} finite numbers: {axes}")
    return numbers
