"""Robots load from names and files, and their kinematics is MuJoCo's."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.robots import load_robot, mesh_sources, packaged
from vrrt_jax.robots.kinematics import body_links, lever_arms, link_poses, place, placement

POSE_TOLERANCE = 1e-5  # float32 over seven joints; worst seen 6e-7

# Frames, Euler angles, a reference, a joint off the body's origin, an unlimited hinge, two joints
# in one body, and clutter that planning has no use for.
ARM = """
<mujoco model="arm">
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <light pos="0 0 3"/>
    <body name="base" pos="0.1 0 0">
      <geom type="cylinder" size="0.08 0.05" pos="0 0 0.05"/>
      <frame pos="0 0 0.2" euler="0 0 30">
        <body name="upper" euler="0 20 0">
          <joint name="turn" axis="0 0 1" pos="0 0.02 0" range="-100 150" ref="10"/>
          <geom type="box" size="0.03 0.03 0.15" pos="0 0 0.15"/>
          <site name="mark"/>
          <body name="fore" pos="0 0 0.35">
            <joint name="bend" axis="0 1 0" limited="false"/>
            <joint name="roll" axis="0 0 1" range="-90 90"/>
            <geom type="capsule" size="0.03 0.1" pos="0 0 0.12"/>
            <body name="rod" pos="0 0 0.25">
              <joint name="reach" type="slide" axis="0 0 2" range="0 0.2"/>
              <geom type="ellipsoid" size="0.02 0.02 0.08" pos="0 0 0.05"/>
              <geom type="sphere" size="0.2" contype="0" conaffinity="0"/>
            </body>
          </body>
        </body>
      </frame>
    </body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="bend" coef="1"/></fixed></tendon>
  <actuator><motor name="m" joint="turn"/><motor tendon="t"/></actuator>
  <sensor><jointpos joint="turn"/><framepos objtype="site" objname="mark"/></sensor>
  <keyframe>
    <key name="zero" qpos="0 0 0 0"/>
    <key name="home" qpos="0.5 1.2 0.2 0.1" ctrl="1 0"/>
  </keyframe>
</mujoco>
"""

URDF = """
<robot name="two">
  <link name="base">
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.1 0.1 0.2"/></geometry></collision>
  </link>
  <link name="arm">
    <collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.03" length="0.3"/></geometry>
    </collision>
  </link>
  <link name="tip">
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.04 0.04 0.2"/></geometry></collision>
  </link>
  <link name="claw"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="arm"/><origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1.5" effort="1" velocity="1"/>
  </joint>
  <joint name="wrist" type="continuous">
    <parent link="arm"/><child link="tip"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="grip" type="revolute">
    <parent link="tip"/><child link="claw"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
</robot>
"""

BALLS = """
<mujoco>
  <worldbody>
    <body name="a">
      <joint name="j" axis="0 0 1" range="-90 90"/>
      <geom size="0.1" pos="0.2 0 0"/>
      <body name="b" pos="0.4 0 0">
        <joint name="k" axis="0 1 0" range="-90 90"/>
        <geom size="0.05" pos="0.1 0 0"/>
        <geom size="0.04" pos="0.2 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def write(folder, text, name="arm.xml"):
    path = folder / name
    path.write_text(text)
    return path


def body_positions(model, names, q):
    """World positions (n, len(names), 3) of bodies at q (n, nq)."""
    data = mujoco.MjData(model)
    found = []
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        found.append([data.body(name).xpos.copy() for name in names])
    return np.array(found)


def chain_positions(robot, q):
    """World positions (n, D, 3) of the bodies that the joints move."""
    poses = jax.jit(jax.vmap(link_poses, (None, 0)))(robot.chain, q.astype(np.float32))
    return np.asarray(poses)[:, 1:, :3, 3]


@pytest.fixture(scope="module")
def arm_path(tmp_path_factory):
    return write(tmp_path_factory.mktemp("robots"), ARM)


@pytest.fixture(scope="module")
def arm(arm_path):
    return load_robot(arm_path)


def random_q(robot, num, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(robot.lower, robot.upper, (num, robot.num_joints))


def test_panda_is_a_panda(panda):
    assert panda.joint_names == tuple(f"joint{k}" for k in range(1, 8))
    assert panda.link_names == tuple(f"link{k}" for k in range(8))
    assert not panda.is_continuous.any()
    np.testing.assert_allclose(panda.lower[[0, 3]], [-2.8973, -3.0718])
    np.testing.assert_allclose(panda.upper[[0, 3]], [2.8973, -0.0698])
    assert np.all((panda.lower < panda.home) & (panda.home < panda.upper))
    assert len(panda.collision_sphere_bodies) == len(panda.collision_spheres.radius) <= 64
    assert (
        "link0" not in panda.collision_sphere_bodies
        and "link0" in panda.self_collision_sphere_bodies
    )
    assert {"left_finger", "hand", "link1"} <= set(panda.collision_sphere_bodies)


def test_panda_kinematics_is_that_of_its_file(panda):
    q = random_q(panda, 50)
    model = mujoco.MjModel.from_xml_string(panda.xml)
    truth = body_positions(model, panda.link_names[1:], q)
    np.testing.assert_allclose(chain_positions(panda, q), truth, atol=POSE_TOLERANCE)


def test_panda_kinematics_is_that_of_menagerie(panda):
    spec = mesh_sources.mesh_spec(panda, visuals=False)
    if spec is None:
        pytest.skip("the Panda's meshes are not installed (mujoco-menagerie or genesis-world)")
    model = spec.compile()
    assert model.nq == 7
    q = random_q(panda, 50)
    bodies = [*panda.link_names[1:], "hand", "left_finger", "right_finger"]
    truth = body_positions(model, bodies, q)
    np.testing.assert_allclose(chain_positions(panda, q), truth[:, :7], atol=POSE_TOLERANCE)
    own = body_positions(mujoco.MjModel.from_xml_string(panda.xml), bodies, q)
    np.testing.assert_allclose(own, truth, atol=1e-9)
    np.testing.assert_allclose(model.jnt_range, np.stack([panda.lower, panda.upper], -1))


def test_visual_meshes_keep_their_materials(panda):
    spec = mesh_sources.mesh_spec(panda)
    if spec is None:
        pytest.skip("the Panda's meshes are not installed (mujoco-menagerie or genesis-world)")
    visual = [geom for geom in spec.geoms if not (geom.contype or geom.conaffinity)]
    assert len(visual) > 50
    assert all(geom.material for geom in visual)
    names = [spec.actuators, spec.tendons, spec.equalities, spec.keys, spec.lights, spec.cameras]
    assert not any(names)


def test_gripper_is_mounted_rigidly_where_its_joints_rest():
    """Compare the folded gripper with the model it comes from, geom by geom."""
    spec = mesh_sources.mesh_spec(load_robot("ur5e"))
    if spec is None:
        pytest.skip("the meshes are not installed (genesis-world and gym-hil)")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    tool = model.body("tool_base_mount").id
    assert model.body_parentid[tool] == model.body("wrist_3_link").id
    own = np.flatnonzero(model.geom_bodyid == tool)

    source = mujoco.MjModel.from_xml_path(str(mesh_sources.tool_file("ur5e")))
    there = mujoco.MjData(source)  # at rest: its joints at zero
    there.qpos[:] = 0
    mujoco.mj_kinematics(source, there)
    mount = source.body("base_mount").id
    meshes = {}
    for geom in range(source.ngeom):
        body = source.geom_bodyid[geom]
        while body and body != mount:
            body = source.body_parentid[body]
        if body == mount and source.geom_dataid[geom] >= 0 and source.geom_group[geom] == 2:
            name = source.mesh(source.geom_dataid[geom]).name
            meshes.setdefault(name, []).append(
                there.xmat[mount].reshape(3, 3).T @ (there.geom_xpos[geom] - there.xpos[mount])
            )
    assert sum(map(len, meshes.values())) == 14
    found = {}
    for geom in own:
        name = model.mesh(model.geom_dataid[geom]).name.removeprefix("tool_")
        found.setdefault(name, []).append(
            data.xmat[tool].reshape(3, 3).T @ (data.geom_xpos[geom] - data.xpos[tool])
        )
    assert found.keys() == meshes.keys()
    for name, places in meshes.items():
        apart = np.linalg.norm(np.array(places)[:, None] - np.array(found[name])[None], axis=-1)
        assert apart.min(axis=1).max() < 1e-6 and apart.min(axis=0).max() < 1e-6


def test_collision_model_checks_what_it_should(panda):
    """Collision spheres against obstacles, self-collision spheres against each other, no more."""
    spec = mujoco.MjSpec.from_string(panda.xml)
    spec.worldbody.add_geom(
        name="obstacle", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.6] * 3, contype=1, conaffinity=0
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = panda.home
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    obstacle = model.geom("obstacle").id
    groups = {
        tuple(sorted(model.geom_group[[g for g in pair if g != obstacle]]))
        for pair in data.contact.geom
    }
    assert groups == {(3,)}


def test_pairs_are_those_of_c_mujoco(panda):
    model = mujoco.MjModel.from_xml_string(panda.xml)
    data = mujoco.MjData(model)
    thin = np.flatnonzero(model.geom_group == 4)
    radius = model.geom_size[thin, 0]
    first, second = panda.self_collision_pairs.T
    colliding = 0
    for q in random_q(panda, 1000, seed=3):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        center = data.geom_xpos[thin]
        apart = np.linalg.norm(center[first] - center[second], axis=1)
        touching = {
            (int(thin[a]), int(thin[b]))
            for a, b in panda.self_collision_pairs[apart < radius[first] + radius[second]]
        }
        theirs = data.contact.geom[data.contact.dist < 0]
        assert touching == {(min(pair), max(pair)) for pair in theirs.tolist()}
        colliding += bool(touching)
    assert colliding > 20


def test_every_kind_of_geom_and_joint(arm, arm_path):
    robot, path = arm, arm_path
    assert robot.joint_names == ("turn", "bend", "roll", "reach")
    assert robot.is_continuous.tolist() == [False, True, False, False]
    np.testing.assert_allclose(robot.lower, [np.radians(-100), -np.pi, np.radians(-90), 0])
    np.testing.assert_allclose(robot.home, [0.5, 1.2, 0.2, 0.1])
    assert set(robot.collision_sphere_bodies) == {"upper", "fore", "rod"}
    # the body with two joints touches nothing but its neighbors in the file
    assert set(robot.self_collision_sphere_bodies) == {"base", "upper", "rod"}
    assert len(robot.self_collision_pairs) > 0
    q = random_q(robot, 20)
    truth = body_positions(mujoco.MjModel.from_xml_path(str(path)), ["upper", "fore", "rod"], q)
    np.testing.assert_allclose(chain_positions(robot, q)[:, [0, 2, 3]], truth, atol=1e-5)


def test_freeze_fixes_joints_where_they_are(tmp_path):
    path = write(tmp_path, ARM)
    frozen = {"turn": 0.4, "bend": -0.7, "roll": 0.3}
    robot = load_robot(path, freeze=frozen)
    assert robot.joint_names == ("reach",)
    assert robot.frozen == frozen
    q = random_q(robot, 5)
    full = np.hstack([np.tile(list(frozen.values()), (5, 1)), q])
    truth = body_positions(mujoco.MjModel.from_xml_path(str(path)), ["rod"], full)
    np.testing.assert_allclose(chain_positions(robot, q), truth, atol=1e-5)


def test_urdf(tmp_path):
    robot = load_robot(write(tmp_path, URDF, "two.urdf"), freeze={"grip": 0.0})
    assert robot.joint_names == ("shoulder", "wrist")
    assert robot.link_names == ("base", "arm", "tip")
    assert robot.is_continuous.tolist() == [False, True]
    np.testing.assert_allclose(robot.upper, [1.5, np.pi])
    assert ("base", "arm") in robot.ignored_pairs
    assert set(robot.collision_sphere_bodies) == {"arm", "tip"}


def test_spheres_are_used_as_they_are(tmp_path):
    robot = load_robot(write(tmp_path, BALLS))
    assert robot.collision_sphere_bodies == robot.self_collision_sphere_bodies == ("a", "b", "b")
    np.testing.assert_allclose(robot.collision_spheres.radius, [0.1, 0.05, 0.04])
    np.testing.assert_allclose(robot.collision_spheres.center[:, 0], [0.2, 0.1, 0.2], atol=1e-7)
    assert robot.collision_spheres.link.tolist() == [1, 2, 2]
    assert len(robot.self_collision_pairs) == 0


def test_written_model_loads_as_the_same_robot(tmp_path):
    robot = load_robot(write(tmp_path, ARM), freeze={"turn": 0.1})
    again = load_robot(write(tmp_path, robot.xml, "again.xml"))
    assert again.xml == robot.xml and again.name == "arm"  # whose self-model it may use
    assert again.mesh_source == robot.mesh_source and again.frozen == {"turn": 0.1}
    np.testing.assert_array_equal(again.collision_spheres.radius, robot.collision_spheres.radius)
    np.testing.assert_array_equal(again.self_collision_pairs, robot.self_collision_pairs)
    assert again.ignored_pairs == robot.ignored_pairs


def test_bodies_with_several_joints_belong_to_the_last(arm):
    spec = mesh_sources.mesh_spec(arm)
    assert spec is not None
    model = spec.compile()
    link = dict(
        zip((model.body(k).name for k in range(model.nbody)), body_links(model), strict=True)
    )
    assert link == {"world": 0, "base": 0, "upper": 1, "fore": 3, "rod": 4}


def test_visuals_of_a_urdf_are_drawn(tmp_path):
    look = '<visual><geometry><sphere radius="0.09"/></geometry></visual>'
    robot = load_robot(
        write(
            tmp_path,
            URDF.replace('<link name="claw"/>', f'<link name="claw">{look}</link>').replace(
                '<link name="arm">', f'<link name="arm">{look}'
            ),
            "two.urdf",
        )
    )
    spec = mesh_sources.mesh_spec(robot)
    assert spec is not None
    drawn = {}
    for body in spec.bodies:
        drawn[body.name] = [g.type.name for g in body.geoms if g.group < 3]
    assert drawn["arm"] == drawn["claw"] == ["mjGEOM_SPHERE"]
    assert drawn["tip"] == ["mjGEOM_BOX"]
    model, plain = spec.compile(), mesh_sources.mesh_spec(robot, visuals=False).compile()
    assert np.sum(model.geom_contype > 0) == plain.ngeom == 3

    mesh = '<visual><geometry><mesh filename="none.dae"/></geometry></visual>'
    robot = load_robot(
        write(tmp_path, URDF.replace('<link name="arm">', f'<link name="arm">{mesh}'), "dae.urdf")
    )
    with pytest.warns(UserWarning, match="collision shapes are drawn instead"):
        spec = mesh_sources.mesh_spec(robot)
    assert spec is not None and spec.compile().ngeom == 3


def test_coupled_joints_are_fixed_with_a_warning(tmp_path):
    equality = '<equality><joint joint1="roll" joint2="bend"/></equality><keyframe>'
    path = write(tmp_path, ARM.replace("<keyframe>", equality))
    with pytest.warns(UserWarning, match=r"roll = 1.2, bend = 1.2; pass freeze"):
        robot = load_robot(path)
    assert robot.joint_names == ("turn", "reach")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_robot(path, freeze={"roll": 0.0, "bend": 0.0}).num_joints == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody>", "complete MJCF or URDF"),
        ("", "complete MJCF or URDF"),
        ("not a robot", "complete MJCF or URDF"),
        (ARM.replace('type="box" size="0.03 0.03 0.15"', 'type="mesh" mesh="no"'), "meshes are"),
        (
            BALLS.replace('<joint name="j"', '<freejoint name="float"/><joint name="j"'),
            "more than 6 dofs",
        ),
        (BALLS.replace('axis="0 0 1" range="-90 90"', 'type="ball"'), "'j' of body 'a' is a ball"),
        (BALLS.replace('axis="0 0 1" range="-90 90"', 'type="free"'), "'j' of body 'a' is a free"),
        (BALLS.replace('axis="0 0 1" range="-90 90"', 'type="slide"'), "slide joint 'j' has no ra"),
        (BALLS.replace("<geom ", '<geom contype="0" conaffinity="0" '), "no collision geom"),
        ("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", "no joint"),
    ],
)
def test_bad_files_are_one_clear_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as raised:
        load_robot(write(tmp_path, text))
    assert "\n" not in str(raised.value)


def test_bad_arguments_list_what_there_is(tmp_path):
    with pytest.raises(ValueError, match=r"unknown robot 'pand'; have: .*panda"):
        load_robot("pand")
    with pytest.raises(FileNotFoundError, match=r"nowhere.xml' does not exist.*panda"):
        load_robot(tmp_path / "nowhere.xml")
    with pytest.raises(ValueError, match="joint 'elbow' not in robot; have: j, k"):
        load_robot(write(tmp_path, BALLS), freeze={"elbow": 0.0})
    with pytest.raises(ValueError, match="joint 'j' got nan; expected a finite"):
        load_robot(write(tmp_path, BALLS), freeze={"j": float("nan")})
    with pytest.raises(ValueError, match="fix joint 'roll': joint 'bend' of the same body"):
        load_robot(write(tmp_path, ARM), freeze={"roll": 0.0})


def test_meshes_are_looked_for_where_the_user_says(panda, tmp_path, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"has no franka_emika_panda/panda.xml"):
        mesh_sources.mesh_spec(panda)
    (tmp_path / "franka_emika_panda").mkdir()
    (tmp_path / "franka_emika_panda" / "panda.xml").touch()
    assert mesh_sources.mesh_file("panda") == tmp_path / "franka_emika_panda" / "panda.xml"


def test_no_meshes_anywhere_is_none(panda, monkeypatch):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setattr(mesh_sources.importlib.util, "find_spec", lambda name: None)
    assert mesh_sources.mesh_spec(panda) is None


def test_scenes_folder_has_the_robots():
    assert (packaged.scenes_dir() / "robots" / "panda" / "robot.xml").is_file()
    assert "panda" in packaged.robot_names()


@pytest.mark.parametrize("name", ["panda", "fetch"])
def test_lever_arms_bound_how_far_spheres_move(name, rng):
    robot = load_robot(name)
    spheres = robot.collision_spheres
    link, center = np.asarray(spheres.link), np.asarray(spheres.center)
    arms = lever_arms(robot.chain, link, center, robot.lower, robot.upper)
    matrix = placement(link, center, robot.chain.num_links)
    moved = jax.jit(
        jax.vmap(jax.jacfwd(lambda q: place(jnp.asarray(matrix), link_poses(robot.chain, q))))
    )(rng.uniform(robot.lower, robot.upper, (300, robot.num_joints)).astype(np.float32))
    most = np.linalg.norm(np.asarray(moved), axis=1).max(axis=0).T  # (D, n)
    assert np.all(most <= arms + 1e-5)
    # The bound is not much longer than what some configuration reaches.
    assert np.median(arms[arms > 0.05] / most[arms > 0.05]) < 1.3


def test_poses_of_links_are_asked_of_a_robot_too(panda):
    expected = link_poses(panda.chain, jnp.asarray(panda.home, jnp.float32))
    for whose in (panda, vrrt_jax.build_world(panda, [], engine="closed_form")):
        np.testing.assert_allclose(link_poses(whose, panda.home.tolist()), expected, atol=1e-6)
    with pytest.raises(ValueError, match=r"q has shape \(2, 7\); expected \(7,\)"):
        link_poses(panda, np.zeros((2, 7)))
