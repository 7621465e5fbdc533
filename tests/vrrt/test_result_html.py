"""Results as notebooks show them: numbers, a picture, escaped texts and no scripts."""

import base64
import dataclasses
import io
import re

import jax
import numpy as np
import pytest
from pictures import Q_GOAL
from PIL import Image

import nrp_jax
import vrrt_jax
from vrrt_jax.core.result import Status
from vrrt_jax.visual.end_picture import EndPicture

pytestmark = pytest.mark.light_compilation


@pytest.fixture(scope="module")
def result(panda, open_world):
    """A plan that starts at its goal: nothing is searched for."""
    return vrrt_jax.plan_to_configuration(panda, open_world, Q_GOAL, Q_GOAL, key=jax.random.key(0))


def pictures(html):
    found = re.findall(r'src="data:image/png;base64,([^"]*)"', html)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


def test_a_joint_goal_has_numbers_and_no_picture(result):
    html = result._repr_html_()
    assert "SOLVED" in html and Status.SOLVED.value in html
    assert f"({result.verification.checked} configurations, " in html
    assert "verify" in html and not pictures(html)


def test_texts_are_escaped(result):
    contact = dataclasses.replace(result.verification, ok=False, contact='<script>"x"&</script>')
    failed = dataclasses.replace(
        result, status=Status.NOT_VERIFIED, advice="<b>try</b>", verification=contact
    )
    html = failed._repr_html_()
    assert "&lt;b&gt;try&lt;/b&gt;" in html and "&lt;script&gt;&quot;x&quot;&amp;" in html
    assert "<script" not in html and "<b>try" not in html


def test_an_image_goal_stands_beside_the_end(result, panda, self_model, camera, image):
    goal = vrrt_jax.ImageGoal(self_model, camera, image)
    html = dataclasses.replace(result, draw=EndPicture(goal, panda))._repr_html_()
    assert EndPicture.caption in html
    (shown,) = pictures(html)
    target, end = np.split(shown.astype(float), 2, axis=1)
    assert target.min() < 100  # the robot is there
    there = np.abs(target - end).mean()
    assert there < 1.5  # the path ends at the pose that the image shows
    q = Q_GOAL.copy()
    q[1] += 0.5
    elsewhere = dataclasses.replace(result, path=q[None])
    target, end = np.split(EndPicture(goal, panda)(elsewhere).astype(float), 2, axis=1)
    assert np.abs(target - end).mean() > 3 * there


def test_a_plan_in_a_home_shows_the_way(tmp_path):
    occupied = np.zeros((60, 40), bool)
    occupied[30:, :5] = True  # below, on the right
    grid = nrp_jax.Grid(occupied=occupied)
    q = np.array([1.0, 2.0, 0.0, 0.1, 0.1, 0.1, 0.1, 0.1], np.float32)
    there = nrp_jax.plan(nrp_jax.load_robot("snake"), grid, q, q, key=jax.random.key(0))
    assert there.ok
    (shown,) = pictures(there._repr_html_())
    height, width, _ = shown.shape
    assert (width, height) == (320, round(320 * 40 / 60))
    assert shown[-10, -10].max() < 128 and shown[-10, 10].min() > 200 and shown[10, -10].min() > 200
    dot = shown[height - round(2.0 / 0.1 * 320 / 60), round(1.0 / 0.1 * 320 / 60)]
    assert dot[0] > 150 and dot[1] < 100  # red: the goal, which is drawn last
