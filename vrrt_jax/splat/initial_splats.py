"""Splats to start a training from: clusters of the robot's visible surface points."""

import jax.numpy as jnp
import numpy as np
from scipy.cluster.vq import kmeans2

from vrrt_jax.splat.types import SplatModel, layer_starts

MIN_SPLATS = 8  # of a link, if it has as many points
POINTS_PER_SPLAT = 60  # that are clustered, but at least MIN_POINTS of a link
MIN_POINTS = 2000
RADIUS_M = (0.002, 0.05)  # range of the first radii [m]
LONE_RADIUS_M = 0.01  # of a splat with hardly any points [m]


def initial_splats(points: np.ndarray, num_splats: int, seed: int) -> SplatModel:
    """Cluster visible surface points into splats, link by link.

    Args:
        points: (m, 7) link, position in the link's frame [m], color.
        num_splats: G.
        seed: of the clustering.

    Returns:
        Splats of one density, with the points' mean colors, the same from all sides.
    """
    rng = np.random.default_rng(seed)
    mean, radius, rgb, link = [], [], [], []
    for index, num in zip(*_splats_per_link(points, num_splats), strict=True):
        own = points[points[:, 0] == index]
        own = own[rng.permutation(len(own))[: max(POINTS_PER_SPLAT * num, MIN_POINTS)]]
        center, label = kmeans2(own[:, 1:4], num, iter=8, minit="points", rng=rng)
        apart = np.linalg.norm(own[:, 1:4] - center[label], axis=1)
        for k in range(num):
            members = label == k
            mean.append(center[k])
            rgb.append(own[members, 4:].mean(0) if members.any() else own[:, 4:].mean(0))
            radius.append(
                np.sqrt((apart[members] ** 2).mean()) if members.sum() > 2 else LONE_RADIUS_M
            )
        link += [index] * num
    radius = np.clip(radius, *RADIUS_M)
    return SplatModel(
        starts=layer_starts(np.array(link)),
        mean=jnp.asarray(mean, jnp.float32),
        radius=jnp.asarray(radius, jnp.float32),
        density=jnp.full(num_splats, 3.0, jnp.float32),
        rgb=jnp.asarray(rgb, jnp.float32),
        view_color_gradient=jnp.zeros((num_splats, 3)),
        link=jnp.asarray(link, jnp.int32),
        tau=jnp.float32(0.04),
    )


def _splats_per_link(points: np.ndarray, num_splats: int) -> tuple[np.ndarray, np.ndarray]:
    """Links that show any points, and the number of splats for each."""
    links, counts = np.unique(points[:, 0].astype(int), return_counts=True)
    # The square root keeps small but telling links, such as fingers, from starving.
    shares = np.sqrt(counts)
    quota = np.maximum(MIN_SPLATS, np.floor(shares / shares.sum() * num_splats)).astype(int)
    quota = np.minimum(quota, counts)
    # The largest link takes what rounding leaves.
    quota[np.argmax(quota)] += num_splats - quota.sum()
    return links, quota
