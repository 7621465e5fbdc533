"""XML files that would make MuJoCo read without end, or fill the memory, are refused before."""

import os
import time

import pytest

from vrrt_jax.robots import load_robot
from vrrt_jax.robots.xml_file import check_mjcf, xml_root
from vrrt_jax.scene.obstacles import load_obstacles

LAUGHS = '<!DOCTYPE a [<!ENTITY a "ha">' + "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)
BODY = '<body><joint name="turn" range="-1 1"/><geom size=".1"/></body>'


def scene(folder, inner, name="scene.xml", head=""):
    text = f"{head}<mujoco><worldbody>{inner}</worldbody></mujoco>"
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(
    "text",
    [
        LAUGHS + "]><mujoco>&j;</mujoco>",
        '<!DOCTYPE a [<!ENTITY f SYSTEM "/etc/passwd">]><a>&f;</a>',
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_not_expanded(tmp_path, text, encoding):
    file = tmp_path / "robot.xml"
    file.write_text(text, encoding=encoding)
    for read in (xml_root, load_robot, load_obstacles):
        began = time.monotonic()
        with pytest.raises(ValueError, match="declares the XML entity '[af]'"):
            read(file)
        assert time.monotonic() - began < 5


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        ('<replicate count="99999999">GEOM</replicate>', "makes 99999999 copies"),
        (
            '<replicate count="9999"><replicate count="9999">GEOM</replicate></replicate>',
            "makes 99980001 copies",
        ),
        (
            '</worldbody><asset><hfield name="h" nrow="60000" ncol="60000"/></asset><worldbody>',
            "nrow [*] ncol = 3600000000",
        ),
        ('<flexcomp name="f" count="1000 1000 1000"/>', "count = 1000000000"),
        ('<geom size="nan"/>', "geom '' has size=\"nan\"; expected numbers"),
        ('</worldbody><include file="/dev/zero"/><worldbody>', "names '/dev/zero'"),
        ('</worldbody><include file="pipe"/><worldbody>', "names 'pipe', which is no plain file"),
        ('</worldbody><include file="folder"/><worldbody>', "includes 'folder', which is a folder"),
        ('</worldbody><include file="inner.xml"/><worldbody>', "names 'pipe'"),
        (
            '</worldbody><asset><mesh name="m" file="pipe"/></asset><worldbody>',
            "names 'pipe', which is no plain file",
        ),
    ],
)
def test_what_has_no_end_is_refused(tmp_path, inner, words):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "inner.xml").write_text('<mujocoinclude><include file="pipe"/></mujocoinclude>')
    file = scene(tmp_path, inner.replace("GEOM", '<geom size=".1"/>') + BODY)
    for read in (check_mjcf, load_robot, load_obstacles):
        with pytest.raises(ValueError, match=words):
            read(file)


def test_files_that_include_each_other_and_others_are_read(tmp_path):
    scene(tmp_path, BODY, "robot.xml")
    (tmp_path / "below").mkdir()
    file = tmp_path / "below" / "main.xml"
    file.write_text('<mujoco><include file="../robot.xml"/></mujoco>')
    assert load_robot(file).joint_names == ("turn",)  # robots lie beside their parts
    (tmp_path / "loop.xml").write_text('<mujoco><include file="loop.xml"/></mujoco>')
    with pytest.raises(ValueError, match="already included"):
        load_robot(tmp_path / "loop.xml")


def test_soft_limits_of_a_urdf_hold(tmp_path):
    urdf = """<robot name="arm"><link name="base"/><link name="l">
      <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
      <joint name="turn" type="revolute"><parent link="base"/><child link="l"/>
      <axis xyz="0 0 1"/><limit lower="-2" upper="2"/>SOFT</joint></robot>"""
    file = tmp_path / "arm.urdf"
    file.write_text(urdf.replace("SOFT", '<safety_controller soft_lower_limit="-1.5" '
                                 'soft_upper_limit="2.5" k_velocity="1"/>'))  # fmt: skip
    with pytest.warns(UserWarning, match=r"'turn' is planned within \[-1.5, 2\], the soft limits"):
        robot = load_robot(file)
    assert robot.lower[0] == -1.5 and robot.upper[0] == 2.0
    for soft, words in (("3", "none is inside"), ("x", "expected two numbers")):
        text = f'<safety_controller soft_lower_limit="{soft}" soft_upper_limit="4"/>'
        file.write_text(urdf.replace("SOFT", text))
        with pytest.raises(
            ValueError, match=f"arm.urdf.*joint 'turn' has the soft limits .*{words}"
        ):
            load_robot(file)
    file.write_text(urdf.replace("SOFT", '<safety_controller k_velocity="1"/>'))
    assert load_robot(file).upper[0] == 2.0


def test_a_home_outside_of_the_limits_is_told(tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text(
        f"<mujoco><worldbody>{BODY.replace('-1 1', '-50 50')}</worldbody>"
        '<keyframe><key name="home" qpos="2"/></keyframe></mujoco>'
    )
    with pytest.warns(UserWarning, match="home is outside of the limits: turn is at 2, .* 0.87"):
        robot = load_robot(file)
    assert robot.home[0] == pytest.approx(robot.upper[0])
