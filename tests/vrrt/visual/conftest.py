"""A robot of one joint, for what hardly needs one."""

import pytest

import vrrt_jax

SLIDER = """
<mujoco>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" range="-1 1"/>
      <geom type="box" size="0.1 0.1 0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="session")
def slider(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "slider.xml"
    path.write_text(SLIDER)
    return vrrt_jax.load_robot(path)
