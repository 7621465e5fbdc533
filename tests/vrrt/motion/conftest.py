"""A ball on a table that slides along x and y: its paths are drawn on paper."""

import pytest

import vrrt_jax

GANTRY = """
<mujoco>
  <worldbody>
    <body name="beam">
      <joint name="x" type="slide" axis="1 0 0" range="-1 9"/>
      <geom type="sphere" size="0.001" pos="0 0 9" contype="0" conaffinity="0" mass="1"/>
      <body name="ball">
        <joint name="y" type="slide" axis="0 1 0" range="-1 9"/>
        <geom type="sphere" size="0.01" mass="2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="x" forcerange="-30 30"/>
    <motor joint="y" forcerange="-30 30"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="session")
def gantry(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "gantry.xml"
    path.write_text(GANTRY)
    return vrrt_jax.load_robot(path)


@pytest.fixture(scope="session")
def slow():
    return vrrt_jax.MotionLimits(velocity=1.0, acceleration=2.0, jerk=10.0)
