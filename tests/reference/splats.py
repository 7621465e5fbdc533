"""Plain numpy twins of the splat renderers, which import nothing of the package."""

import numpy as np


def footprint_sum(pixel, inv_sigma, features, size):
    """Sum (H, W, C) over splats of footprint times feature, pixel by pixel.

    ``pixel`` (G, 2) x, y [px], ``inv_sigma`` (G,) [1/px], ``features`` (G, C), ``size`` (H, W).
    """
    total = np.zeros((*size, features.shape[1]))
    for row, column in np.ndindex(size):
        for g in range(len(pixel)):
            offset = (np.array([column, row]) + 0.5 - pixel[g]) * inv_sigma[g]
            total[row, column] += np.exp(-0.5 * offset @ offset) * features[g]
    return total


def painted(pixel, covariance, depth, density, rgb, size):
    """Front to back, pixel by pixel: rgb (H, W, 3) over black, and alpha (H, W).

    ``pixel`` (G, 2) x, y [px], ``covariance`` (G, 2, 2) [px^2], ``depth`` (G,), ``density`` (G,),
    ``rgb`` (G, 3), ``size`` (H, W).
    """
    image, alpha = np.zeros((*size, 3)), np.zeros(size)
    for row, column in np.ndindex(size):
        light = 1.0
        for g in np.argsort(depth):
            offset = np.array([column, row]) + 0.5 - pixel[g]
            footprint = np.exp(-0.5 * offset @ np.linalg.inv(covariance[g]) @ offset)
            opacity = 1.0 - np.exp(-density[g] * footprint)
            image[row, column] += light * opacity * rgb[g]
            light *= 1.0 - opacity
        alpha[row, column] = 1.0 - light
    return image, alpha


def render_gaussians(mean, quaternion, scale, density, rgb, *, camera, blur):
    """Render anisotropic Gaussians: rgb (H, W, 3) over black, and alpha (H, W).

    ``mean`` (G, 3) [m], ``quaternion`` (G, 4) wxyz from principal axes to the world, of any length,
    ``scale`` (G, 3) deviations along the principal axes [m], ``density`` (G,), ``rgb`` (G, 3);
    ``blur`` [px]. All Gaussians are in front of the camera.
    """
    rotation = np.asarray(camera.world_to_cam[:3, :3], float)
    translation = np.asarray(camera.world_to_cam[:3, 3], float)
    focal, principal_point = float(camera.focal), np.asarray(camera.principal_point, float)
    pixel, covariance, depth = [], [], []
    for center, turn, deviation in zip(mean, quaternion, scale, strict=True):
        x, y, z = rotation @ center + translation
        # The projection is linear near the center, with this derivative.
        jacobian = focal / z * np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]])
        spread = jacobian @ rotation @ (_rotation(turn) * deviation)
        pixel.append(focal * np.array([x, y]) / z + principal_point)
        covariance.append(spread @ spread.T + blur**2 * np.eye(2))
        depth.append(z)
    return painted(pixel, covariance, depth, density, rgb, (camera.height, camera.width))


def _rotation(quaternion):
    w, *axis = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
