"""Self-collision spheres that are fitted to a sample of configurations."""

import mujoco
import numpy as np

from vrrt_jax.robots.kinematics import BodySpheres
from vrrt_jax.robots.self_collision_fit import fit_radii_to_sample

ARM = """<mujoco><worldbody><body name="base"><geom size=".05"/></body>
<body name="tip" pos="0.2 0 0"><joint type="slide" axis="1 0 0" range="-0.2 0.2"/><geom size=".03"/>
</body></worldbody></mujoco>"""


def test_radii_touch_where_the_sample_collides_and_centers_stay(rng):
    """Two balls of 5 and 3 cm touch at 8 cm; spheres of 11 cm in sum are too large by 3 cm."""
    model = mujoco.MjModel.from_xml_string(ARM)
    spheres = BodySpheres(
        body=np.array([1, 2]), center=np.zeros((2, 3)), radius=np.array([0.06, 0.05])
    )
    q = rng.uniform(-0.2, 0.2, (500, 1))
    is_colliding = 0.2 + q[:, 0] < 0.08
    fitted = fit_radii_to_sample(model, spheres, np.array([[0, 1]]), q, is_colliding)
    assert np.array_equal(fitted.center, spheres.center)
    touches = 0.2 + q[:, 0] < fitted.radius.sum()
    assert not np.any(is_colliding & ~touches)
    assert np.abs(fitted.radius.sum() - 0.08) < 2e-3
