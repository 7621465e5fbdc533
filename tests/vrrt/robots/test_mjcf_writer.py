"""Spheres in a written file can be replaced; what stands beside them stays."""

import xml.etree.ElementTree as ET

import pytest

from vrrt_jax.robots.mjcf_writer import replace_spheres
from vrrt_jax.robots.packaged import robot_path


def packaged(name):
    return robot_path(name).read_text()


def geoms(text, body):
    found = next(part for part in ET.fromstring(text).iter("body") if part.get("name") == body)
    return [geom.attrib for geom in found.findall("geom")]


def test_a_file_into_itself_is_the_same_file():
    assert replace_spheres(packaged("panda"), packaged("panda")) == packaged("panda")


def test_spheres_and_pairs_are_new_and_joints_stay():
    old = packaged("panda")
    new = old.replace('name="joint1"', 'name="turn"').replace(' size="0.0', ' size="0.1')
    new = new.replace('<exclude body1="link0" body2="link1" />', "")
    found = replace_spheres(old, new)
    assert geoms(found, "link5") == geoms(new, "link5") != geoms(old, "link5")
    assert 'name="joint1"' in found and 'name="turn"' not in found
    assert found.count("<exclude") == old.count("<exclude") - 1


def test_another_robot_is_refused():
    with pytest.raises(ValueError, match="bodies of one model only: .*link5.*expected the same"):
        replace_spheres(packaged("panda"), packaged("ur5e"))
