"""Images that self-models are trained and validated with: random poses seen by random cameras.

MuJoCo renders the robot's true meshes. Poses are set kinematically, and cameras are exact.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from tqdm import tqdm

from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.files import replacing
from vrrt_jax.robots.kinematics import body_links, link_poses
from vrrt_jax.robots.robot import workspace
from vrrt_jax.scene.world import batch_is_free, build_world
from vrrt_jax.splat.camera import cut, orbit, project, shrunk, stack_cameras
from vrrt_jax.splat.fit_config import FitConfig
from vrrt_jax.splat.mujoco_images import MeshRenderer
from vrrt_jax.splat.types import Camera

INSIDE = 0.999  # alpha from which a pixel shows the surface alone, without background


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingImages:
    """n images for training or validation."""

    q: np.ndarray  # (n, D)
    cameras: Camera  # leading axis n
    rgb: np.ndarray  # (n, H, W, 3) float16, the robot over black
    alpha: np.ndarray  # (n, H, W) float16


def render_images(
    robot,
    spec: mujoco.MjSpec,
    config: FitConfig,
    num: int,
    seed: int,
    num_surfaces: int = 0,
    tip: tuple[int, np.ndarray] | None = None,
) -> tuple[TrainingImages, np.ndarray]:
    """Render images of random poses from random cameras, and take points from the surface.

    Args:
        robot: the robot.
        spec: the robot with its visual meshes.
        config: sizes and ranges.
        num: number n of images.
        seed: of poses and cameras.
        num_surfaces: number of images, of the n, that surface points are taken from.
        tip: a link and a point (3,) in its frame [m]: the images are close-ups of the point.

    Returns:
        The images; points (m, 7): link, position in the link's frame [m], color.

    Raises:
        RuntimeError: OpenGL is not available.
    """
    renderer = MeshRenderer(spec)
    body_link = body_links(renderer.model)
    rng = np.random.default_rng(seed)
    q = random_configurations(robot, num, rng)
    cameras = random_cameras(robot, config, q, tip, rng)
    rgb = np.zeros((num, cameras[0].height, cameras[0].width, 3), np.float16)
    alpha = np.zeros(rgb.shape[:3], np.float16)
    points = []
    for i in tqdm(range(num), desc="rendering", unit="image", leave=False):
        picture = renderer.picture(q[i], cameras[i])
        rgb[i], alpha[i] = picture.rgb, picture.alpha
        if i < num_surfaces:
            depth, geom = renderer.surface(q[i], cameras[i])
            link = np.where(geom >= 0, body_link[renderer.model.geom_bodyid[geom]], -1)
            inside = (link >= 0) & (picture.alpha > INSIDE)
            points.append(
                _surface_points(robot, q[i], cameras[i], depth, link, inside, picture.rgb)
            )
    images = TrainingImages(q=q, cameras=stack_cameras(cameras), rgb=rgb, alpha=alpha)
    return images, np.concatenate(points) if points else np.zeros((0, 7), np.float32)


def outermost(points: np.ndarray) -> tuple[int, np.ndarray]:
    """The last link of surface points (m, 7), and their middle (3,) in its frame [m]."""
    link = points[:, 0].max()
    return int(link), points[points[:, 0] == link, 1:4].mean(axis=0)


def shrink(images: TrainingImages, size_px: int) -> TrainingImages:
    """The same images with fewer pixels, by area, in float32."""
    factor = images.rgb.shape[1] // size_px

    def block_means(array: np.ndarray) -> np.ndarray:
        n, h, w = array.shape[:3]
        blocks = array.reshape(n, h // factor, factor, w // factor, factor, *array.shape[3:])
        return blocks.astype(np.float32).mean(axis=(2, 4))

    return TrainingImages(
        q=images.q,
        cameras=shrunk(images.cameras, factor),
        rgb=block_means(images.rgb),
        alpha=block_means(images.alpha),
    )


def write_images(file: Path, images: TrainingImages, points: np.ndarray) -> None:
    """Write images and their surface points as an ``.npz``, atomically."""
    with replacing(file) as handle:
        np.savez(
            handle,
            q=images.q,
            rgb=images.rgb,
            coverage=images.alpha,
            points=points,
            world_to_cam=np.asarray(images.cameras.world_to_cam),
            focal=np.asarray(images.cameras.focal),
            principal_point=np.asarray(images.cameras.principal_point),
        )


def read_images(file: Path) -> tuple[TrainingImages, np.ndarray]:
    """Read what :func:`write_images` wrote."""
    own = ("world_to_cam", "focal", "principal_point")
    saved = read_arrays(file, "coverage", "q", "rgb", "points", *own)
    alpha = saved["coverage"]
    fields: dict[str, Any] = {name: jnp.asarray(saved[name]) for name in own}
    cameras = Camera(**fields, height=alpha.shape[1], width=alpha.shape[2])
    images = TrainingImages(q=saved["q"], cameras=cameras, rgb=saved["rgb"], alpha=alpha)
    return images, saved["points"]


def random_configurations(robot, num: int, rng: np.random.Generator) -> np.ndarray:
    """Configurations (num, D) inside the limits that do not touch themselves."""
    world = build_world(robot, engine="closed_form").by_spheres_alone()
    found = np.zeros((0, len(robot.lower)))
    while len(found) < num:
        q = rng.uniform(robot.lower, robot.upper, (256, len(robot.lower)))
        free = np.asarray(batch_is_free(world, jnp.asarray(q, jnp.float32)))
        found = np.concatenate([found, q[free]])
    return found[:num]


def random_cameras(
    robot, config: FitConfig, q: np.ndarray, tip, rng: np.random.Generator
) -> list[Camera]:
    """A camera for each configuration (n, D): of the whole robot, or of the tip."""
    center, radius = workspace(robot)
    px = config.image_px if tip is None else config.close_up_of_px
    cameras = [_random_camera(config, center, radius, px, rng) for _ in q]
    if tip is None:
        return cameras
    off = rng.uniform(-config.close_up_off, config.close_up_off, (len(q), 2))
    return [
        _close_up_camera(robot, config, *each, tip) for each in zip(q, cameras, off, strict=True)
    ]


def _random_camera(
    config: FitConfig, center: np.ndarray, radius: float, px: int, rng: np.random.Generator
) -> Camera:
    """A camera around a robot whose workspace has a center (3,) and a radius [m]."""
    return orbit(
        azimuth_deg=rng.uniform(-180, 180),
        elevation_deg=rng.uniform(*config.elevation_deg),
        distance=radius * rng.uniform(*config.distance),
        target=(center + rng.normal(size=3) * radius * config.target_spread).tolist(),
        fovy_deg=rng.uniform(*config.fovy_deg),
        height=px,
        width=px,
    )


def _close_up_camera(
    robot, config: FitConfig, q: np.ndarray, camera: Camera, off: np.ndarray, tip
) -> Camera:
    """The part of a view around a point of a link, ``off`` (2,) heights away from its middle."""
    link, point = tip
    pose = np.asarray(link_poses(robot.chain, jnp.asarray(q, jnp.float32)))[link]
    pixel, _ = project(camera, pose[:3, :3] @ point + pose[:3, 3])
    px = config.close_up.size_px
    return cut(camera, np.round(np.asarray(pixel) + (off - 0.5) * px), px, px)


def _surface_points(robot, q, camera: Camera, depth, link, inside, rgb) -> np.ndarray:
    """Points (m, 7) of an image's pixels that are ``inside``: link, local position, color."""
    # From pixels and depths to points in the camera's frame, and in the world.
    y, x = np.nonzero(inside)
    z = depth[y, x]
    center, focal = np.asarray(camera.principal_point), float(camera.focal)
    in_cam = np.stack([(x + 0.5 - center[0]) / focal * z, (y + 0.5 - center[1]) / focal * z, z], 1)
    cam_to_world = np.linalg.inv(np.asarray(camera.world_to_cam, np.float64))
    world = in_cam @ cam_to_world[:3, :3].T + cam_to_world[:3, 3]
    # From the world to each point's own link.
    poses = np.asarray(link_poses(robot.chain, jnp.asarray(q, jnp.float32)), np.float64)
    pose = poses[link[y, x]]
    local = np.einsum("nji,nj->ni", pose[:, :3, :3], world - pose[:, :3, 3])
    return np.concatenate([link[y, x, None], local, rgb[y, x]], axis=1).astype(np.float32)
