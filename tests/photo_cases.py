"""Photographs as users have them: rendered, before a background, through a lens."""

import io

import cv2
import numpy as np
from PIL import Image
from scipy import ndimage


def clutter(height, width, seed=0):
    """A colorful background with coarse and fine details (H, W, 3)."""
    rng = np.random.default_rng(seed)
    layers = [
        ndimage.gaussian_filter(rng.uniform(size=(height, width, 3)), (sigma, sigma, 0))
        for sigma in (1.5, 6.0, 25.0)
    ]
    mixed = sum((layer - layer.mean()) / layer.std() for layer in layers) / 3
    return np.clip(0.45 + 0.16 * mixed, 0.02, 0.98).astype(np.float32)


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
