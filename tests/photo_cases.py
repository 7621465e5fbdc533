"""Photographs as users have them: rendered, before a background, through a lens."""

import io
import json

import cv2
import numpy as np
from PIL import Image
from scipy import ndimage

from vrrt_jax.bench.dream_data import body_places
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.mujoco_images import Picture


def clutter(height, width, seed=0):
    """A colorful background with coarse and fine details (H, W, 3)."""
    rng = np.random.default_rng(seed)
    layers = [
        ndimage.gaussian_filter(rng.uniform(size=(height, width, 3)), (sigma, sigma, 0))
        for sigma in (1.5, 6.0, 25.0)
    ]
    mixed = sum((layer - layer.mean()) / layer.std() for layer in layers) / 3
    return np.clip(0.45 + 0.16 * mixed, 0.02, 0.98).astype(np.float32)


def thing(height, width):
    """A picture (without OpenGL) of a bright, striped thing, in soft light."""
    y, x = np.mgrid[:height, :width] / height
    alpha = ((np.abs(x - 0.6) < 0.1) & (y > 0.2)) | (np.hypot(x - 0.85, y - 0.3) < 0.16)
    shade = 0.95 - 0.5 * (np.abs(y - 0.6) < 0.04) - 0.15 * x
    rgb = (alpha * shade)[..., None] * np.array([1.0, 0.99, 0.95])
    return Picture(rgb=rgb.astype(np.float32), alpha=alpha.astype(np.float32), valid=alpha)


def before(picture, background):
    """The robot of a picture before a background (H, W, 3)."""
    return picture.rgb + (1 - picture.alpha[..., None]) * background


def taken(image, *, exposure=1.0, noise=0.0, jpeg=None, seed=0):
    """The picture that a camera makes of an image: (H, W, 3) of 8 bits."""
    rng = np.random.default_rng(seed)
    noisy = exposure * image + noise * rng.normal(size=image.shape)
    pixels = np.round(255 * np.clip(noisy, 0, 1)).astype(np.uint8)
    if jpeg is None:
        return pixels
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=jpeg)
    return np.asarray(Image.open(file))


def through_lens(image, lens):
    """What the real camera sees of a pinhole camera's image (H, W, C)."""
    height, width = image.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    points = grid.reshape(-1, 1, 2).astype(np.float64)
    undistort = cv2.fisheye.undistortPoints if lens.model == "fisheye" else cv2.undistortPoints
    pinhole = undistort(points, lens.matrix, lens.coefficients, P=lens.pinhole)
    x, y = pinhole.reshape(height, width, 2).astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)


def overlap(mask, true_alpha):
    """Intersection over union of a mask and what the robot covers."""
    mask, true_alpha = mask > 0.5, true_alpha > 0.5
    return (mask & true_alpha).sum() / (mask | true_alpha).sum()


def dream_folder(folder, robot, camera, shots, *, jpeg=90):
    """Write a folder in DREAM's format.

    Args:
        folder: where to.
        robot: of the pictures.
        camera: of all of them.
        shots: for each frame q, its image (H, W, 3) of 8 bits, and the robot's mask or None.
        jpeg: quality.
    """
    folder.mkdir(exist_ok=True)
    focal, size = float(camera.focal), {"width": camera.width, "height": camera.height}
    cx, cy = np.asarray(camera.principal_point, float) - 0.5
    inner = {"fx": focal, "fy": focal, "cx": cx, "cy": cy, "resolution": size}
    settings = {"camera_settings": [{"intrinsic_settings": inner, "captured_image_size": size}]}
    (folder / "_camera_settings.json").write_text(json.dumps(settings))
    marked = ("link0", "link2", "link3", "link4", "link6", "link7", "hand")
    for index, (q, image, mask) in enumerate(shots):
        places = body_places(robot, q)
        pixels, _ = project(camera, np.array([places[name] for name in marked], np.float32))
        keypoints = [
            {"name": f"panda_{name}", "projected_location": (np.asarray(p, float) - 0.5).tolist()}
            for name, p in zip(marked, pixels, strict=True)
        ]
        joints = [
            {"name": f"panda_{name}", "position": float(value)}
            for name, value in zip(robot.joint_names, q, strict=True)
        ]
        joints.append({"name": "panda_finger_joint1", "position": 0.04})
        fields = {
            "objects": [{"class": "panda", "keypoints": keypoints}],
            "sim_state": {"joints": joints},
        }
        (folder / f"{index:06}.json").write_text(json.dumps(fields))
        Image.fromarray(image).save(folder / f"{index:06}.rgb.jpg", quality=jpeg)
        if mask is not None:
            white = Image.fromarray((255 * (mask > 0.5)).astype(np.uint8))
            white.save(folder / f"{index:06}.mask.png")
