"""What files of robots say and MuJoCo does not mind: limits, URLs, couplings, masks, names."""

import warnings

import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.robots import load_robot
from vrrt_jax.robots import robot as robot_module
from vrrt_jax.scene.obstacles import load_obstacles

LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
URDF = """
<robot name="two">
  <link name="base"/>
  <link name="arm">
    <collision><origin xyz="0 0 0.3"/><geometry>GEOMETRY</geometry></collision>
  </link>
  <link name="tip">
    <collision><origin xyz="0 0 0.3"/><geometry><sphere radius="0.05"/></geometry></collision>
  </link>
  <joint name="lift" type="revolute">
    <parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>LIMIT
  </joint>
  <joint name="slide" type="prismatic">
    <parent link="arm"/><child link="tip"/><origin xyz="0 0 0.4"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.2" effort="1" velocity="1"/>
  </joint>
</robot>
"""
BALL = '<sphere radius="0.05"/>'
HINGE = """
<mujoco><compiler angle="radian"/><worldbody><body name="arm">
  <joint name="lift" axis="0 1 0" LIMITS/><geom size="0.05" pos="0 0 0.3"/>
</body></worldbody></mujoco>
"""
GRIPPER = """
<mujoco><compiler angle="radian"/><worldbody><body name="arm">
  <joint name="a" axis="0 1 0" range="-1 1"/><geom size="0.03" pos="0 0 0.2"/>
  <body name="left" pos="0.05 0 0.3">
    <joint name="fl" type="slide" axis="1 0 0" range="0 0.05"/><geom size="0.01"/>
  </body>
  <body name="right" pos="-0.05 0 0.3">
    <joint name="fr" type="slide" axis="-1 0 0" range="0 0.05"/><geom size="0.01"/>
  </body>
</body></worldbody>TIES</mujoco>
"""


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    """What touches what is clear soon in robots as simple as these."""
    monkeypatch.setattr(robot_module, "_NUM_SAMPLES", 300)


def write(folder, text, name="robot.xml"):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def urdf(folder, *, limit=LIMIT, geometry=BALL, name="robot.urdf"):
    return write(folder, URDF.replace("LIMIT", limit).replace("GEOMETRY", geometry), name)


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("", "is revolute and has no limits"),
        ('<limit effort="1" velocity="1"/>', "is revolute and has no limits"),
        ('<limit lower="0" upper="0"/>', "limits lower=0, upper=0"),
        ('<limit lower="0.5" upper="-0.5"/>', "limits lower=0.5, upper=-0.5"),
        ('<limit lower="0.5"/>', "limits lower=0.5, upper=0"),
        ('<limit lower="nan" upper="1"/>', "limits lower=nan, upper=1"),
        ('<limit lower="-inf" upper="inf"/>', "limits lower=-inf, upper=inf"),
        ('<limit lower="low" upper="1"/>', "limits lower=low, upper=1"),
    ],
)
def test_unclear_limits_of_a_urdf_are_refused_by_name(tmp_path, limit, words):
    path = urdf(tmp_path, limit=limit)
    if '"low"' not in limit:  # MuJoCo reads no words
        assert load_robot(path, freeze={"lift": 0.0}).joint_names == ("slide",)
        with pytest.raises(ValueError, match=f"joint 'lift' .*{words}.*type=\"continuous\""):
            load_robot(path)
    else:
        with pytest.raises(ValueError, match="robot"):
            load_robot(path)


def test_only_continuous_joints_of_a_urdf_turn_for_ever(tmp_path):
    path = urdf(tmp_path, limit="")
    path.write_text(path.read_text().replace('"revolute"', '"continuous"'))
    assert load_robot(path).is_continuous.tolist() == [True, False]
    path = urdf(tmp_path, limit='<limit lower="-0.5"/>')  # what is left out is 0
    assert load_robot(path).lower[0] == -0.5 and load_robot(path).upper[0] == 0.0
    text = URDF.replace("LIMIT", LIMIT).replace("GEOMETRY", BALL).replace('upper="0.2"', "")
    with pytest.raises(
        ValueError, match="'slide' is prismatic and has the limits lower=0, upper=0"
    ):
        load_robot(write(tmp_path, text, "slide.urdf"))


def test_limits_of_many_turns_may_be_in_degrees(tmp_path):
    with pytest.warns(UserWarning, match=r"'lift' has the range \[-180, 180\] rad, of many turns"):
        load_robot(urdf(tmp_path, limit='<limit lower="-180" upper="180"/>'))
    text = HINGE.replace("LIMITS", 'range="-1 90"')
    with pytest.warns(UserWarning, match="'lift' has the range .* of many turns"):
        load_robot(write(tmp_path, text))
    with warnings.catch_warnings(action="error"):
        load_robot(urdf(tmp_path, limit='<limit lower="-12.6" upper="12.6"/>'))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('<link name="loose"/>', "loose are children of no joint; expected one such link"),
        ('<link name="l"/><link name="l"/>', "two links are named l"),
        ('<joint name="j" type="fixed"/><joint name="j" type="fixed"/>', "two joints are named j"),
    ],
)
def test_a_urdf_is_one_tree_with_names_of_their_own(tmp_path, more, words):
    text = urdf(tmp_path).read_text().replace("</robot>", more + "</robot>")
    with pytest.raises(ValueError, match=words):
        load_robot(write(tmp_path, text, "other.urdf"))


def test_a_body_for_motion_capture_is_no_moving_link(tmp_path):
    text = """<mujoco><worldbody><body name="base"><geom size=".1"/><body name="arm" pos="0 0 .3">
    <joint axis="0 1 0" range="-90 90"/><geom size=".05"/></body></body>
    <body name="target" mocap="true" pos="1 0 0"><geom size=".2"/></body></worldbody></mujoco>"""
    robot = load_robot(write(tmp_path, text, "mocap.xml"))
    assert set(robot.collision_sphere_bodies) == {"arm"}


def test_what_is_no_urdf_yet_is_refused(tmp_path):
    for site in ("www.ros.org/wiki", "wiki.ros.org"):
        spaced = f'<robot name="two" xmlns:xacro="http://{site}/xacro">'
        text = URDF.replace('<robot name="two">', spaced)
        text = text.replace("LIMIT", LIMIT).replace("GEOMETRY", BALL)
        assert load_robot(write(tmp_path, text)).num_joints == 2  # the name space alone is no harm
        text = text.replace("</robot>", '<xacro:include filename="hand.xacro"/></robot>')
        with pytest.raises(
            ValueError, match="element xacro:include.*: xacro a.urdf.xacro > a.urdf"
        ):
            load_robot(write(tmp_path, text, "a.urdf.xacro"))


@pytest.mark.parametrize("limits", ["1 -1", "1 1", "0 0", "-inf inf", "-1 1e9"])
def test_unclear_ranges_of_mjcf_are_refused_by_name(tmp_path, limits):
    path = write(tmp_path, HINGE.replace("LIMITS", f'range="{limits}"'))
    with pytest.raises(ValueError, match=r"joint 'lift' has .*freeze={'lift'"):
        load_robot(path)


def test_a_hinge_of_mjcf_without_a_range_turns_for_ever(tmp_path):
    for limits in ("", 'limited="false"', 'limited="false" range="0 0"'):
        robot = load_robot(write(tmp_path, HINGE.replace("LIMITS", limits)))
        assert robot.is_continuous.all()
    with pytest.warns(UserWarning, match="'lift' has the range .* without limits"):
        load_robot(write(tmp_path, HINGE.replace("LIMITS", 'limited="false" range="-1 1"')))


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A folder with ``my_arm/meshes/arm one.obj``, a pyramid."""
    folder = tmp_path_factory.mktemp("packages") / "my_arm"
    corners = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.3)]
    faces = [(1, 3, 2), (1, 2, 4), (2, 3, 4), (1, 4, 3)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
    write(folder, "\n".join(lines), "meshes/arm one.obj")
    return folder


@pytest.mark.parametrize(
    "name",
    [
        "package://my_arm/meshes/arm one.obj",
        "package://another_name/meshes/arm one.obj",
        "model://my_arm/meshes/arm one.obj",
        "$(find my_arm)/meshes/arm one.obj",
        "FILE",
        "ABSOLUTE",
        "../meshes/arm one.obj",
        "..\\meshes\\arm one.obj",
        "meshes/arm one.obj",
        "package://my_arm/meshes/arm%20one.obj",
    ],
)
def test_meshes_of_a_urdf_are_found(package, name):
    mesh = package / "meshes" / "arm one.obj"
    name = name.replace("FILE", mesh.as_uri()).replace("ABSOLUTE", str(mesh))
    path = urdf(package, geometry=f'<mesh filename="{name}"/>', name="urdf/robot.urdf")
    robot = load_robot(path)
    assert "arm" in robot.collision_sphere_bodies
    # The exact check reads the same mesh.
    assert vrrt_jax.verify_path(robot, [], np.zeros((1, 2)), geometry="meshes").ok


def test_a_mesh_of_another_package_is_told(package):
    """Where a file names several packages, a folder of none of them may hold the wrong mesh."""
    name = "package://PACKAGE/meshes/arm one.obj"
    other = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    text = URDF.replace("LIMIT", LIMIT).replace("GEOMETRY", f'<mesh filename="{name}"/>')
    text = text.replace("PACKAGE", "hand").replace(
        '<link name="base"/>', f'<link name="base">{other.replace("PACKAGE", "my_arm")}</link>'
    )
    with pytest.warns(UserWarning, match="of link 'arm' is taken from .* in no folder 'hand'"):
        load_robot(write(package, text, "urdf/two.urdf"))
    with warnings.catch_warnings(action="error"):
        load_robot(write(package, text.replace("my_arm", "hand"), "urdf/one.urdf"))


def test_a_mesh_that_is_nowhere_is_named_with_what_to_write(package):
    path = urdf(package, geometry='<mesh filename="package://my_arm/no.stl"/>', name="no.urdf")
    with pytest.raises(ValueError, match=r"'package://my_arm/no.stl' of link 'arm' was not.*write"):
        load_robot(path)
    write(package, "", "meshes/arm.dae")
    path = urdf(package, geometry='<mesh filename="meshes/arm.dae"/>', name="dae.urdf")
    with pytest.raises(ValueError, match=r"is a \.dae file; expected one of \.stl, \.obj, \.msh"):
        load_robot(path)


def ties(polynomial="0 1 0 0 0", more=""):
    return f'<equality><joint joint1="fr" joint2="fl" polycoef="{polynomial}" {more}/></equality>'


@pytest.mark.filterwarnings("ignore:joints coupled")
@pytest.mark.parametrize(
    ("polynomial", "freeze", "frozen"),
    [
        ("0 1 0 0 0", None, {"fl": 0.0, "fr": 0.0}),
        ("0 1 0 0 0", {"fl": 0.03}, {"fl": 0.03, "fr": 0.03}),
        ("0 1 0 0 0", {"fr": 0.03}, {"fl": 0.03, "fr": 0.03}),
        ("0.02 1 0 0 0", {"fl": 0.01}, {"fl": 0.01, "fr": 0.03}),
        ("0.02 1 0 0 0", {}, {"fl": 0.0, "fr": 0.02}),
        ("0.05 -1 0 0 0", {"fr": 0.02}, {"fl": 0.03, "fr": 0.02}),
        ("0 0 20 0 0", {"fl": 0.04}, {"fl": 0.04, "fr": 0.032}),
        ("0 0 20 0 0", {"fr": 0.032}, {"fl": 0.04, "fr": 0.032}),
    ],
)
def test_a_follower_is_where_its_leader_puts_it(tmp_path, polynomial, freeze, frozen):
    path = write(tmp_path, GRIPPER.replace("TIES", ties(polynomial)))
    robot = load_robot(path, freeze=freeze)
    assert robot.joint_names == ("a",)
    assert robot.frozen == pytest.approx(frozen)


@pytest.mark.filterwarnings("ignore:joints coupled")
def test_a_mimic_joint_follows(tmp_path):
    mimic = '<mimic joint="lift" multiplier="-0.1" offset="0.02"/>'
    text = URDF.replace("LIMIT", LIMIT).replace("GEOMETRY", BALL)
    text = text.replace('<parent link="arm"/>', mimic + '<parent link="arm"/>')
    third = """<link name="end"><collision><geometry><sphere radius="0.01"/></geometry></collision>
      </link><joint name="turn" type="continuous"><parent link="tip"/><child link="end"/></joint>
      </robot>"""
    path = write(tmp_path, text.replace("</robot>", third), "mimic.urdf")
    assert load_robot(path, freeze={"lift": -0.5}).frozen == pytest.approx(
        {"lift": -0.5, "slide": 0.07}
    )


def test_a_joint_that_mimics_nothing_is_refused(tmp_path):
    text = URDF.replace("LIMIT", LIMIT).replace("GEOMETRY", BALL)
    text = text.replace('<parent link="arm"/>', '<mimic joint="lif"/><parent link="arm"/>')
    path = write(tmp_path, text)
    with pytest.raises(ValueError, match=r"'slide' mimics 'lif', which is no joint that moves; .*"):
        load_robot(path)
    assert load_robot(path, freeze={"slide": 0.1}).joint_names == ("lift",)


@pytest.mark.parametrize("value", ["open", None, [0.1, 0.2], np.nan])
def test_what_freezes_a_joint_is_a_number(tmp_path, value):
    path = write(tmp_path, GRIPPER.replace("TIES", ""))
    with pytest.raises(ValueError, match="joint 'fl' got .*; expected a finite position"):
        load_robot(path, freeze={"fl": value})
    assert load_robot(path, freeze={"fl": np.array(0.01)}).frozen == {"fl": 0.01}


def test_what_ties_joints_and_is_not_kept_is_said(tmp_path):
    tendon = '<tendon><fixed name="t" RANGE><joint joint="fl" coef="1"/><joint joint="fr" '
    tendon += 'coef="-1"/></fixed></tendon>'
    equality = '<equality><tendon tendon1="t" MORE/></equality>'
    for text, words in (
        (tendon.replace("RANGE", "") + equality.replace("MORE", ""), "tendon 't' .joints fl, fr"),
        (tendon.replace("RANGE", 'range="-1 1"'), "limits of tendon 't'"),
    ):
        with pytest.warns(UserWarning, match=words):
            robot = load_robot(write(tmp_path, GRIPPER.replace("TIES", text)))
        assert robot.joint_names == ("a", "fl", "fr")
    path = write(tmp_path, GRIPPER.replace("TIES", ties()))
    with pytest.warns(UserWarning, match="'fr' is fixed at 0.01, but .* at 0.03 would have it at"):
        load_robot(path, freeze={"fl": 0.03, "fr": 0.01})
    with pytest.raises(ValueError, match="no position of 'fl' in its range"):
        load_robot(write(tmp_path, GRIPPER.replace("TIES", ties("1 1 0 0 0"))), freeze={"fr": 0.0})


@pytest.mark.filterwarnings("error")
def test_what_is_switched_off_fixes_nothing(tmp_path):
    off = ties(more='active="false"').replace(
        "</equality>",
        '<connect body1="left" body2="right" anchor="0 0 0" active="false"/></equality>',
    )
    robot = load_robot(write(tmp_path, GRIPPER.replace("TIES", off)))
    assert robot.joint_names == ("a", "fl", "fr") and not robot.frozen


def test_neighbors_are_those_of_the_file(tmp_path):
    """A body with two joints is written as two, and may touch the one that carries it."""
    text = """
    <mujoco><compiler angle="radian"/><worldbody>
      <body name="post"><joint name="pan" range="-3 3"/><geom size="0.05" pos="0 0 .2"/>
        <body name="post__x"><joint name="nod" axis="0 1 0" range="-1 1"/>
          <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
        <body name="fore" pos="0 0 0.3">
          <joint name="x" axis="1 0 0" range="-2.6 2.6"/><joint name="y" axis="0 1 0" range="-1 1"/>
          <geom size="0.05" pos="0 0 0.14"/>
          <body name="tip" pos="0 0 0.15"><geom size="0.05"/></body>
        </body>
      </body></worldbody></mujoco>"""
    path = write(
        tmp_path, text.replace("post__x", "fore__x")
    )  # the name that is made for the split
    robot = load_robot(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    names = [robot.joint_names.index(model.joint(j).name) for j in range(model.njnt)]
    world = vrrt_jax.build_world(robot, engine="closed_form")
    for q in rng.uniform(robot.lower, robot.upper, (50, robot.num_joints)):
        data.qpos[:] = q[names]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        assert bool(vrrt_jax.is_free(world, q.astype(np.float32))) == (data.ncon == 0)
    assert {("post", "fore"), ("post", "tip")} <= set(robot.ignored_pairs)


def test_decoration_is_no_obstacle_and_no_robot(tmp_path):
    world = """<mujoco><worldbody>
      <geom name="geom_1" type="box" size="1 1 1" contype="0" conaffinity="0"/>
      <geom size="0.1"/><geom name="geom_1_" size="0.2"/><geom size="0.3" contype="0"/>
      <geom type="ellipsoid" size="1 2 3" contype="0" conaffinity="0"/>
    </worldbody></mujoco>"""
    found = load_obstacles(write(tmp_path, world))
    assert [o.size[0] for o in found] == [0.1, 0.2, 0.3]
    assert [o.name for o in found] == ["geom_1__", "geom_1_", "geom_3"]
    path = write(
        tmp_path,
        '<mujoco><worldbody><geom size="1" contype="0" conaffinity="0"/></worldbody></mujoco>',
    )
    with pytest.warns(UserWarning, match="no geom of .* is an obstacle"):
        assert load_obstacles(path) == []
    robot = HINGE.replace("LIMITS", "").replace(
        "<geom", '<geom size="1" contype="0" conaffinity="0"/><geom'
    )
    assert load_robot(write(tmp_path, robot)).collision_spheres.radius == pytest.approx(0.05)


def test_a_robot_whose_masks_let_nothing_touch_is_warned_of(tmp_path):
    masked = GRIPPER.replace("TIES", "").replace("<geom ", '<geom contype="1" conaffinity="2" ')
    with pytest.warns(UserWarning, match="let no two of its links touch"):
        load_robot(write(tmp_path, masked))
    paired = GRIPPER.replace(
        'range="0 0.05"/><geom ', 'range="0 0.05"/><geom name="pad" contype="0" conaffinity="0" ', 1
    ).replace("TIES", '<contact><pair geom1="pad" geom2="ball"/></contact>')
    paired = paired.replace('<geom size="0.03"', '<geom name="ball" size="0.03"')
    with pytest.warns(UserWarning, match="geoms pad collide by contact pairs only"):
        load_robot(write(tmp_path, paired))


def test_made_up_names_never_clash(tmp_path):
    """Bodies and joints without names get some, whatever the others are called."""
    text = """<mujoco><compiler angle="radian"/><worldbody><body name="body_2">
      <joint name="joint_1" axis="0 1 0" range="-1 1"/><geom size="0.05" pos="0 0 0.3"/>
      <body pos="0 0 0.5"><joint axis="1 0 0" range="-1 1"/><geom size="0.05" pos="0 0 0.3"/></body>
    </body></worldbody></mujoco>"""
    robot = load_robot(write(tmp_path, text))
    assert robot.joint_names == ("joint_1", "joint_1_")
    assert set(robot.collision_sphere_bodies) == {"body_2", "body_2_"}


def test_a_robot_without_pairs_answers_in_large_batches(tmp_path):
    robot = load_robot(write(tmp_path, HINGE.replace("LIMITS", 'range="-1 1"')))
    world = vrrt_jax.build_world(robot)
    assert np.asarray(vrrt_jax.scene.world.batch_is_free(world, np.zeros((300, 1)))).all()
