"""A plan in the browser."""

import time
import urllib.request

import jax
import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.core.tree_file import Nodes, load_nodes, save_nodes
from vrrt_jax.problems import load_problem, save_problem
from vrrt_jax.scene.page import Page, colors_of
from vrrt_jax.scene.world import obstacle_list
from vrrt_jax.viewer import view_folder

ARM = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="arm">
      <joint name="turn" axis="0 0 1"/>
      <geom name="rod" type="capsule" size=".02" fromto="0 0 0 1 0 0"/>
      <body name="hand" pos="1 0 0"><geom name="ball" size=".05"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def page():
    page = Page("test")
    yield page
    page.close()


def test_the_slider_moves_the_robot(page):
    model = mujoco.MjModel.from_xml_string(ARM)
    page.add_robot(model, groups=(0,))
    page.show_trajectory(np.array([[0.0], [np.pi / 4], [np.pi / 2]]))
    hand = page.moving[model.body("hand").id]
    np.testing.assert_allclose(hand.position, [1, 0, 0], atol=1e-6)
    page.slider.value = 2
    deadline = time.monotonic() + 5.0
    while np.abs(np.asarray(hand.position) - [0, 1, 0]).max() > 1e-6:
        assert time.monotonic() < deadline, hand.position
        time.sleep(0.02)


def test_the_page_is_served_to_this_machine_alone(page):
    assert page.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(page.url, timeout=5) as answer:
        assert answer.status == 200
    port = int(page.url.rpartition(":")[2])
    with pytest.raises(OSError, match="give another --port"):
        Page("another", port)
    assert page.host == "127.0.0.1"
    page.close()
    page.close()  # once more does no harm


def test_a_plan_shows_tree_path_and_numbers():
    problem = load_problem("panda_open", engine="closed_form")
    goal = vrrt_jax.ConfigurationGoal(q=problem.true_goal)
    result = vrrt_jax.plan(
        problem.robot,
        problem.world,
        goal,
        problem.q_start,
        key=jax.random.key(0),
        planner="rrt-connect",
    )
    page = vrrt_jax.view(result, problem.world, goal)
    try:
        assert len(page.moving) >= problem.robot.num_joints
        assert page.slider.max > 1
        assert page.url in page._repr_html_()
    finally:
        page.close()


def test_obstacles_are_dragged_and_the_page_plans_again_among_them():
    problem = load_problem("panda_posts", engine="closed_form")
    goal = vrrt_jax.ConfigurationGoal(q=problem.true_goal)
    run = (problem.robot, problem.world, goal, problem.q_start)
    result = vrrt_jax.plan(*run, key=jax.random.key(0))
    page = vrrt_jax.view(result, problem.world, goal)
    try:
        before = page.slider.max, len(page.moving)
        *others, name = [obstacle.name for obstacle in page.obstacles.obstacles]
        page.obstacles.move(name, np.array([0.9, -0.9, 0.2]), np.array([1.0, 0, 0, 0]))
        page.buttons["plan again"]()
        assert (page.slider.max, len(page.moving)) == before
        table = page._shown["table"].content
        assert "SOLVED" in table
        # Inside the robot: nothing is planned, and the page says so.
        page.obstacles.move(name, np.array([0.0, 0.0, 0.5]), np.array([1.0, 0, 0, 0]))
        page.buttons["plan again"]()
        table = page._shown["table"].content
        assert "not planned" in table and name in table
        moved = {o.name: o.position for o in page.obstacles.obstacles}
        assert moved[name] == (0.0, 0.0, 0.5) and len(moved) == 1 + len(others)
        # The world that was given stays as it was.
        assert obstacle_list(problem.world)[-1].position != (0.0, 0.0, 0.5)
    finally:
        page.close()


def test_a_folder_keeps_the_problem_and_the_tree(tmp_path):
    problem = load_problem("panda_posts", engine="closed_form")
    save_problem(problem, tmp_path / "problem")
    again = load_problem(tmp_path / "problem", engine="closed_form")
    assert again.robot.joint_names == problem.robot.joint_names
    np.testing.assert_array_equal(again.q_start, problem.q_start)
    for old, new in zip(obstacle_list(problem.world), obstacle_list(again.world), strict=True):
        assert (old.name, old.kind) == (new.name, new.kind)
        np.testing.assert_allclose(new.position, old.position, atol=1e-6)
    for old, new in zip(problem.goal_images, again.goal_images, strict=True):
        np.testing.assert_allclose(new, old, atol=1 / 255)

    nodes = Nodes(
        q=np.zeros((3, 7), np.float32), parent=np.array([-1, 0, 1]), score=np.array([3.0, 1.0, 2.0])
    )
    save_nodes(nodes, tmp_path / "tree.npz")
    found = load_nodes(tmp_path / "tree.npz", 7)
    np.testing.assert_array_equal(found.parent, nodes.parent)
    assert found.best_edges(1).tolist() == [1] and found.best_edges(9).tolist() == [1, 2]
    (tmp_path / "tree.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match="no readable .npz"):
        load_nodes(tmp_path / "tree.npz", 7)
    with pytest.raises(FileNotFoundError, match=r"has no result.json"):
        view_folder(tmp_path)


def test_low_values_are_strong_and_what_is_not_finite_is_pale():
    colors = colors_of(np.array([1.0, 2.0, 3.0, np.inf]))
    brightness = colors.astype(int).sum(axis=1)
    assert brightness[0] < brightness[1] < brightness[2] == brightness[3]
