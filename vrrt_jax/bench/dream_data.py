"""Photographs in the format of the DREAM data sets: images, keypoints and joints of an arm.

The format is that of NVIDIA's Dataset Synthesizer, as Lee et al. use it in "Camera-to-Robot Pose
Estimation from a Single Image" (ICRA 2020, arXiv 1911.09231): in one folder ``NNNNNN.rgb.jpg`` and
``NNNNNN.json`` of each frame, and ``_camera_settings.json``.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vrrt_jax.checks import check_limits
from vrrt_jax.core.data_file import read_json
from vrrt_jax.core.opencv import load_opencv
from vrrt_jax.core.results_file import fingerprint
from vrrt_jax.robots.bodies import body_places
from vrrt_jax.robots.robot import Robot
from vrrt_jax.splat.camera import camera_from_matrix
from vrrt_jax.splat.types import Camera

SETTINGS = "_camera_settings.json"
IMAGES = (".rgb.jpg", ".rgb.png")
MASK = ".mask.png"  # beside a frame, white on the robot; no part of the published data
MIN_KEYPOINTS = 4
MAX_REPROJECTION_PX = 4.0  # mean distance of keypoints from where the pose puts them


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """One photograph; the joints are for the camera's pose and for scoring alone."""

    name: str  # such as "000123"
    image: Path
    mask: Path | None
    q: np.ndarray  # (D,) joints [rad]
    keypoints: Mapping[str, np.ndarray]  # by body: (2,) [px], from the middle of the first pixel
    fingerprint: str


def frame_names(folder: str | Path) -> list[str]:
    """Names of the frames of a folder, in order.

    Raises:
        FileNotFoundError: there is no such folder, or no frame in it.
    """
    names = sorted(file.stem for file in Path(folder).glob("[0-9]*.json"))
    if not names:
        raise FileNotFoundError(
            f"no frames in '{folder}'; expected NNNNNN.json and NNNNNN.rgb.jpg, and {SETTINGS}"
        )
    return names


def load_frame(folder: str | Path, name: str, robot: Robot) -> Frame:
    """Read a frame.

    Joints and keypoints may bear the robot's name first, as in ``panda_joint1``. What the robot
    does not plan, such as fingers, is left out.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or lacks a joint or keypoints, or is of another robot.
    """
    file = Path(folder) / f"{name}.json"
    fields = read_json(file)
    try:
        joints = {_own(j["name"], robot): j["position"] for j in fields["sim_state"]["joints"]}
        marked = fields["objects"][0]["keypoints"]
        keypoints = {_own(p["name"], robot): np.array(p["projected_location"]) for p in marked}
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"'{file}' lacks {error}; expected sim_state.joints with name and position, and "
            "objects[0].keypoints with name and projected_location"
        ) from None
    if missing := [joint for joint in robot.joint_names if joint not in joints]:
        raise ValueError(
            f"'{file}' lacks the joints {', '.join(missing)} of '{robot.name}'; it has "
            f"{', '.join(joints) or 'none'}"
        )
    places = [p for p in keypoints.values() if p.shape == (2,) and p.dtype.kind in "fi"]
    if len(places) < len(keypoints) or not np.isfinite(places).all():
        raise ValueError(f"'{file}' has keypoints whose projected_location is not two numbers")
    image, mask = _pictures(folder, name)
    return Frame(
        name=name,
        image=image,
        mask=mask,
        q=check_limits(robot, [joints[joint] for joint in robot.joint_names], f"pose in '{file}'"),
        keypoints=keypoints,
        fingerprint=frame_fingerprint(folder, name),
    )


def frame_fingerprint(folder: str | Path, name: str) -> str:
    """Of what is in a frame's files.

    Raises:
        OSError: one is missing.
    """
    image, mask = _pictures(folder, name)
    files = [Path(folder) / f"{name}.json", image, *([mask] if mask else [])]
    return "-".join(fingerprint(file) for file in files)


def _pictures(folder: str | Path, name: str) -> tuple[Path, Path | None]:
    """The files of a frame's image and mask; None for a mask that is not there."""
    found = [Path(folder) / (name + suffix) for suffix in IMAGES]
    image = next((path for path in found if path.is_file()), None)
    if image is None:
        raise FileNotFoundError(f"no image of frame {name}; expected '{found[0]}'")
    mask = Path(folder) / (name + MASK)
    return image, mask if mask.is_file() else None


def load_intrinsics(folder: str | Path) -> tuple[np.ndarray, tuple[int, int]]:
    """The camera matrix (3, 3) in OpenCV's convention, and the image size (H, W) [px].

    Raises:
        FileNotFoundError: there is no ``_camera_settings.json`` in the folder.
        ValueError: it is damaged, or says that there is skew or distortion.
    """
    file = Path(folder) / SETTINGS
    fields = read_json(file)
    try:
        camera = fields["camera_settings"][0]
        inner = camera["intrinsic_settings"]
        fx, fy, cx, cy = (float(inner[name]) for name in ("fx", "fy", "cx", "cy"))
        size = camera.get("captured_image_size") or inner["resolution"]
        height, width = int(size["height"]), int(size["width"])
    except (KeyError, TypeError, IndexError, ValueError, OverflowError) as error:
        raise ValueError(
            f"'{file}' lacks {error}; expected camera_settings[0] with intrinsic_settings (fx, fy, "
            "cx, cy) and captured_image_size (width, height)"
        ) from None
    if inner.get("s"):
        raise ValueError(f"'{file}' has the skew {inner['s']!r}; expected 0")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (height, width)


def pinhole(matrix: np.ndarray, size: tuple[int, int], world_to_camera: np.ndarray) -> Camera:
    """A camera from OpenCV's matrix (3, 3), the image size (H, W) [px] and a pose (4, 4)."""
    return camera_from_matrix(
        world_to_camera,
        focal=(matrix[0, 0], matrix[1, 1]),
        principal_point=(matrix[0, 2] + 0.5, matrix[1, 2] + 0.5),
        height=size[0],
        width=size[1],
    )


def solve_pose(
    frame: Frame, robot: Robot, matrix: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, float]:
    """Where the camera is, by PnP from keypoints and the places of their bodies.

    Args:
        frame: from :func:`load_frame`.
        robot: of the frame.
        matrix: (3, 3) camera matrix.
        size: height and width of the image [px]; keypoints outside are left out.

    Returns:
        world_to_camera (4, 4), and the mean distance of keypoints from where it puts them [px].

    Raises:
        ModuleNotFoundError: OpenCV is not installed.
        ValueError: there are too few keypoints, or they do not fit the joints.
    """
    cv2 = load_opencv("a camera's pose from keypoints")
    places = body_places(robot, frame.q)
    seen = [
        name
        for name, (x, y) in frame.keypoints.items()
        if name in places and -0.5 <= x < size[1] - 0.5 and -0.5 <= y < size[0] - 0.5
    ]
    points = np.array([places[name] for name in seen]).reshape(-1, 3)
    if len(np.unique(points.round(4), axis=0)) < MIN_KEYPOINTS:
        raise ValueError(
            f"frame {frame.name} shows {len(seen)} keypoints of the robot in the image "
            f"({', '.join(seen) or 'none'}); expected at least {MIN_KEYPOINTS} different places: "
            "give the camera's pose with --extrinsics"
        )
    pixels = np.array([frame.keypoints[name] for name in seen], np.float64)
    ok, turn, move = cv2.solvePnP(points, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    if ok:
        turn, move = cv2.solvePnPRefineLM(points, pixels, matrix, None, turn, move)
        again = cv2.projectPoints(points, turn, move, matrix, None)[0].reshape(-1, 2)
        error = float(np.linalg.norm(again - pixels, axis=1).mean())
    if not ok or not error <= MAX_REPROJECTION_PX:
        raise ValueError(
            f"frame {frame.name}: no camera pose puts the keypoints where they are in the image"
            f"{f', the best is {error:.1f} px off' if ok else ''}; check camera settings and joints"
        )
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = cv2.Rodrigues(turn)[0], move.ravel()
    return transform, error


def _own(name: Any, robot: Robot) -> str:
    """A joint's or keypoint's name as the robot has it."""
    return str(name).rsplit("/", 1)[-1].removeprefix(f"{robot.name}_")
