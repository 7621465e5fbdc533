"""A small robot with colors, for all that renders or learns its images."""

import pytest

from vrrt_jax.robots import load_robot
from vrrt_jax.robots.mesh_sources import mesh_spec
from vrrt_jax.splat.mujoco_images import MeshRenderer

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="base">
      <geom type="cylinder" size="0.1 0.05" pos="0 0 0.05" rgba="0.2 0.4 0.8 1"/>
      <body name="upper" pos="0 0 0.1">
        <joint name="lift" axis="0 1 0" range="-120 120"/>
        <geom type="capsule" size="0.04 0.15" pos="0 0 0.2" rgba="0.9 0.9 0.9 1"/>
        <body name="hand" pos="0 0 0.4">
          <joint name="turn" axis="0 0 1" range="-170 170"/>
          <geom type="box" size="0.02 0.08 0.05" pos="0 0 0.05" rgba="0.9 0.3 0.1 1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="session")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "arm.xml"
    path.write_text(ARM)
    robot = load_robot(path)
    spec = mesh_spec(robot)
    assert spec is not None
    try:
        MeshRenderer(spec).check()
    except RuntimeError as error:
        pytest.skip(str(error))
    return robot, spec
