"""Sums over splats against a plain loop."""

import jax.numpy as jnp
import numpy as np
from reference.splats import footprint_sum

from vrrt_jax.splat.footprints import sum_footprints
from vrrt_jax.splat.projection import ProjectedSplats
from vrrt_jax.splat.windows import ImageLayout

FLOAT32_TOLERANCE = 2e-5  # of sums; worst seen 3e-6


def test_the_product_of_matrices_is_the_sum_over_splats(rng):
    pixel, inv_sigma = rng.uniform(-2, 14, (20, 2)), rng.uniform(0.3, 2, 20)
    features = rng.normal(size=(20, 3))
    arrays = (jnp.asarray(a.T, jnp.float32) for a in (pixel, inv_sigma, features))
    layout = ImageLayout(size=(8, 12), starts=(0,), windows=None)
    (total,) = sum_footprints(ProjectedSplats(*arrays), None, layout)
    expected = footprint_sum(pixel, inv_sigma, features, (8, 12))
    np.testing.assert_allclose(jnp.moveaxis(total, 0, -1), expected, atol=FLOAT32_TOLERANCE)
