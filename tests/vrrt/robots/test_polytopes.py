"""Polytopes of few planes that contain the bodies of a robot."""

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from vrrt_jax.robots import load_robot
from vrrt_jax.robots.geom_pieces import collision_pieces, primitive_points
from vrrt_jax.robots.polytopes import faces, outer_polytope, outer_polytopes, read_polytopes

CLOUD = np.random.default_rng(0).normal(size=(300, 3)) * [0.05, 0.08, 0.2]
ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="base">
      <geom type="box" size="0.1 0.1 0.05"/>
      <body name="upper" pos="0 0 0.1">
        <joint name="turn" axis="0 1 0" range="-2 2"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.05"/>
        <body name="hand" pos="0 0 0.4" euler="20 30 0">
          <geom type="box" size="0.02 0.06 0.01" pos="0 0 0.02"/>
          <geom type="box" size="0.01 0.01 0.05" pos="0 0.05 0.07"/>
          <geom type="box" size="0.01 0.01 0.05" pos="0 -0.05 0.07"/>
          <geom type="sphere" size="0.01" pos="0 0 0.03"/>
          <geom type="cylinder" size="0.02 0.01" pos="0.01 0 0.02"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def beyond(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far points (n, 3) are outside the polytope of vertices (V, 3), (n,) [m]."""
    normals, offsets = faces(vertices)
    return (points @ normals.T - offsets).max(axis=1)


@pytest.mark.parametrize(
    ("points", "most"),
    [
        (primitive_points(mujoco.mjtGeom.mjGEOM_BOX, np.array([0.1, 0.2, 0.05]))[0], 1e-4),
        (primitive_points(mujoco.mjtGeom.mjGEOM_CAPSULE, np.array([0.05, 0.2, 0]))[0], 0.008),
        (primitive_points(mujoco.mjtGeom.mjGEOM_SPHERE, np.array([0.05, 0, 0]))[0], 0.006),
        (CLOUD, 0.03),
    ],
)
def test_a_polytope_contains_its_points_and_little_more(points, most):
    vertices = outer_polytope(points)
    assert beyond(vertices, points).max() <= 0
    assert len(faces(vertices)[0]) <= 60 and len(vertices) < 100
    assert beyond(points, vertices).max() < most


def test_faces_are_those_of_a_hull():
    normals, offsets = faces(CLOUD)
    inside = np.random.default_rng(1).dirichlet(np.ones(len(CLOUD)), 200) @ CLOUD
    assert np.all(inside @ normals.T <= offsets + 1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    np.testing.assert_allclose((CLOUD @ normals.T).max(axis=0), offsets)
    cube = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) / 10
    assert len(faces(cube)[0]) == 6


def test_a_robot_has_polytopes_that_its_file_keeps(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    robot = load_robot(tmp_path / "arm.xml")
    count = [sum(p.body == name for p in robot.polytopes) for name in ("base", "upper", "hand")]
    assert count == [1, 1, 4]  # five geoms of the hand, two of which are taken together
    assert [p.link for p in robot.polytopes] == [0, 1, 1, 1, 1, 1]
    model = mujoco.MjModel.from_xml_string(ARM)
    found = outer_polytopes(model)
    for body, pieces in collision_pieces(model).items():
        for piece in pieces:
            assert min(beyond(part, piece.vertices).max() for part in found[body]) <= 0
        joined = ConvexHull(np.vstack([piece.vertices for piece in pieces])).volume
        assert all(ConvexHull(part).volume < 1.1 * joined for part in found[body])
    (tmp_path / "again.xml").write_text(robot.xml)
    again = load_robot(tmp_path / "again.xml")
    for old, new in zip(robot.polytopes, again.polytopes, strict=True):
        assert (old.body, old.link) == (new.body, new.link)
        np.testing.assert_array_equal(old.vertices, new.vertices)
    # MuJoCo sees no contact between them in the robot's own model.
    own = mujoco.MjModel.from_xml_string(robot.xml)
    assert len(read_polytopes(own)[own.body("hand").id]) == 4
    data = mujoco.MjData(own)
    mujoco.mj_forward(own, data)
    groups = own.geom_group[data.contact.geom].ravel()
    assert 5 not in groups


def test_a_robot_of_spheres_needs_none(tmp_path):
    text = '<mujoco><worldbody><body><joint range="-1 1"/><geom size=".1" pos="1 0 0"/></body>'
    (tmp_path / "ball.xml").write_text(text + "</worldbody></mujoco>")
    assert load_robot(tmp_path / "ball.xml").polytopes == ()
