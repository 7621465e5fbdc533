"""Checks at the border: what, got, expected, and what to do next."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrrt_jax.core.check_protocols import overrides_is_free
from vrrt_jax.core.fields import check_loaded
from vrrt_jax.robots.kinematics import Chain, link_poses
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.attached import touching_spheres
from vrrt_jax.scene.verify import contacts
from vrrt_jax.scene.world import World, batch_is_free
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.model import SelfModel
from vrrt_jax.splat.types import Camera, SplatModel

MOST_TURNS = 100  # beyond so many turns float32 is too coarse for angles


def check_limits(robot: Robot, q: Any, what: str) -> np.ndarray:
    """Check a configuration's shape and limits; returns it as float32 (D,), as it is.

    Only what rounding has put beyond a limit is put onto it. Joints without limits stay in their
    turn.

    Raises:
        ValueError: names the joint, its value and its bounds.
    """
    check_loaded(robot, "the robot", "vrrt_jax.load_robot")
    q, names = _array(q, what), robot.joint_names
    if q.shape != (len(names),):
        raise ValueError(
            f"the {what} has shape {q.shape}; expected ({len(names)},) for the joints "
            f"{', '.join(names)}"
        )
    for name, value, low, high, is_continuous in zip(
        names, q, robot.lower, robot.upper, robot.is_continuous, strict=True
    ):
        if not np.isfinite(value) or (not is_continuous and not low - 1e-5 <= value <= high + 1e-5):
            raise ValueError(
                f"the {what} is outside the limits: joint '{name}' is at {value:.4f}, its bounds "
                f"are [{low:.4f}, {high:.4f}]"
            )
        if is_continuous and abs(value) > 2 * np.pi * MOST_TURNS:
            raise ValueError(
                f"the {what} has joint '{name}' at {value:.4g} rad, more than {MOST_TURNS} turns "
                "from zero; expected less: take whole turns of 2 pi off"
            )
    return np.where(robot.is_continuous, q, np.clip(q, robot.lower, robot.upper))


def _array(q: Any, what: str) -> np.ndarray:
    """Numbers as float32.

    Raises:
        ValueError: they are none.
    """
    try:
        with np.errstate(over="ignore"):  # what is too large becomes infinite
            return np.asarray(q, np.float32)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"the {what} is {q!r}; expected numbers, one for each joint") from None


def check_start(robot: Robot, world: World, q: Any, what: str = "start") -> np.ndarray:
    """Check a configuration against shape, limits and collision; returns it as float32 (D,).

    Raises:
        ValueError: names the joint, its value and its bounds, or the bodies that touch.
    """
    check_loaded(robot, "the robot", "vrrt_jax.load_robot")
    check_loaded(world, "the world", "vrrt_jax.build_world or vrrt_jax.load_world")
    if tuple(world.joint_names) != robot.joint_names:
        raise ValueError(
            f"the world is of a robot with joints {', '.join(world.joint_names)}; this one, "
            f"'{robot.name}', has {', '.join(robot.joint_names)}: build the world for it"
        )
    built_for = world.robot.value
    if built_for is not None and built_for.frozen != robot.frozen:
        raise ValueError(
            f"the world is of a robot whose joints are fixed at {dict(built_for.frozen)}; those of "
            f"this one, '{robot.name}', are at {dict(robot.frozen)}: build the world for it"
        )
    q = check_limits(robot, q, what)
    # Spheres alone say it sooner: what they leave free needs no narrow phase, nor its compilation.
    if not any(bool(batch_is_free(w, q[None])) for w in (world.by_spheres_alone(), world)):
        touching = (
            contacts(robot, world, q)
            or contacts(robot, world, q, geometry="polytopes")
            or contacts(robot, world, q, geometry="spheres")
            or touching_spheres(world, q)
        )
        if not touching and overrides_is_free(world):
            raise ValueError(
                f"the {what} is refused by {type(world).__name__}.is_free, though nothing touches; "
                "move the robot or change that rule"
            )
        raise ValueError(
            f"the {what} is in collision: {'; '.join(touching[:4]) or 'within the margin'}; move "
            "the robot or the obstacle"
        )
    return q


def check_self_model(robot: Robot, self_model: SelfModel) -> None:
    """Raise a ValueError if the self-model was trained for another robot."""
    if self_model.robot != robot.name or self_model.joint_names != robot.joint_names:
        raise ValueError(
            f"the self-model is of '{self_model.robot}' with joints "
            f"{', '.join(self_model.joint_names)}; this robot is '{robot.name}' with joints "
            f"{', '.join(robot.joint_names)}: give its own self-model, or train one with: vrrt fit"
        )


def check_cameras(robot: Robot, splats: SplatModel, cameras: Camera, q: np.ndarray) -> None:
    """Raise a ValueError for a camera that has no part of the robot in its picture."""
    for view in range(len(cameras.focal)):
        camera = jax.tree.map(lambda leaf: leaf[view], cameras)  # noqa: B023 - used at once
        if not bool(_sees(robot.chain, splats, camera, jnp.asarray(q))):
            pose = np.asarray(camera.world_to_cam)
            eye = np.round(-pose[:3, :3].T @ pose[:3, 3], 2).tolist()
            raise ValueError(
                f"camera {view} at {eye} does not see the robot; check world_to_cam (x right, "
                "y down, z forward) and the focal length"
            )


@jax.jit
def _sees(chain: Chain, splats: SplatModel, camera: Camera, q: jax.Array) -> jax.Array:
    pose = link_poses(chain, q)[splats.link]
    points = jnp.einsum("gij,gj->gi", pose[:, :3, :3], splats.mean) + pose[:, :3, 3]
    pixel, depth = project(camera, points)
    size = jnp.array([camera.width, camera.height])
    return jnp.any(jnp.all((pixel > 0) & (pixel < size), axis=-1) & (depth > 0.05))
