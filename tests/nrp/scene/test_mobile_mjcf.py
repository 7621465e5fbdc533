"""The mobile Fetch has the arm of the packaged one, but for the numbers that its file states."""

import mujoco
import numpy as np
import pytest

from nrp_jax.scene import mobile_mjcf
from vrrt_jax.robots.packaged import robot_path, scenes_dir

# Position in the parent [m], joint axis, lower and upper limit [rad] or [m] (None: turns for ever).
# The packaged samplers were trained with these numbers, but for the lowest torso, then 0.1 m.
ARM = {
    "torso_lift": ((-0.086875, 0, 0.37743), "z", (0.0, 0.38615)),
    "shoulder_pan": ((0.119525, 0, 0.34858), "z", (-1.6056, 1.6056)),
    "shoulder_lift": ((0.117, 0, 0.06), "y", (-1.221, 1.518)),
    "upperarm_roll": ((0.219, 0, 0), "x", None),
    "elbow_flex": ((0.133, 0, 0), "y", (-2.251, 2.251)),
    "forearm_roll": ((0.197, 0, 0), "x", None),
    "wrist_flex": ((0.1245, 0, 0), "y", (-2.16, 2.16)),
    "wrist_roll": ((0.1385, 0, 0), "x", None),
}


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(mobile_mjcf.mobile_mjcf("fetch"))


def test_the_arm_is_what_the_samplers_were_trained_with(model):
    parent = "base"
    for name, (position, axis, limits) in ARM.items():
        body, joint = model.body(name), model.joint(name)
        assert model.body(body.parentid[0]).name == parent
        np.testing.assert_allclose(body.pos, position, atol=1e-9)
        np.testing.assert_allclose(body.quat, [1, 0, 0, 0], atol=1e-9)
        np.testing.assert_allclose(joint.axis, np.eye(3)["xyz".index(axis)], atol=1e-9)
        is_slide = joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE
        assert is_slide == (name == "torso_lift")
        if limits is None:
            assert not model.jnt_limited[joint.id]
        else:
            np.testing.assert_allclose(joint.range, limits, atol=1e-9)
        parent = name
    assert model.njnt == 3 + len(ARM)


def test_both_files_of_the_fetch_agree_but_for_the_lowest_torso(model):
    arm = mujoco.MjModel.from_xml_path(str(robot_path("fetch")))
    for name in ARM:
        body, joint = arm.body(f"robot0:{name}_link"), arm.joint(f"robot0:{name}_joint")
        np.testing.assert_allclose(model.body(name).pos, body.pos, atol=1e-4)
        own = model.joint(name).range[name == "torso_lift" :]
        np.testing.assert_allclose(own, joint.range[name == "torso_lift" :], atol=1e-4)


def test_a_robot_without_an_arm_of_another_file_is_read_as_it_is():
    text = (scenes_dir() / "mobile_robots" / "snake.xml").read_text()
    assert mobile_mjcf.mobile_mjcf("snake") == text


def mobile(tmp_path, monkeypatch, listed, arm):
    """The complete text of a robot that lists bodies, with the arm of another file."""
    (tmp_path / "mobile_robots").mkdir()
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{arm}</worldbody></mujoco>")
    (tmp_path / "mobile_robots" / "toy.xml").write_text(
        f'<mujoco model="toy"><custom><text name="arm" data="{tmp_path}/arm.xml"/></custom>'
        f'<worldbody><body name="base"><joint name="x"/>{listed}</body></worldbody></mujoco>'
    )
    monkeypatch.setattr(mobile_mjcf, "scenes_dir", lambda: tmp_path)
    return mobile_mjcf.mobile_mjcf("toy")


def test_a_missing_body_is_named(tmp_path, monkeypatch):
    arm = '<body name="r:elbow_link"><joint name="r:elbow_joint"/></body>'
    with pytest.raises(ValueError, match="lists no body 'elbow', which its arm has; have: base"):
        mobile(tmp_path, monkeypatch, "", arm)


def test_a_moving_body_on_a_fixed_one_is_refused(tmp_path, monkeypatch):
    arm = '<body name="post" pos="0 0 1"><body name="elbow"><joint name="elbow"/></body></body>'
    with pytest.raises(ValueError, match="'elbow' hangs on a body that has a frame but no joint"):
        mobile(tmp_path, monkeypatch, '<body name="elbow"/>', arm)
