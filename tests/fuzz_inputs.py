"""Small valid inputs of every kind that the commands read, and the command lines that read them."""

import json
import shutil
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from nrp_jax.homes.grid import Grid
from nrp_jax.learning.data import MANIFEST
from nrp_jax.learning.shards import DatasetSettings, checksum
from nrp_jax.problems import PACKAGED
from nrp_jax.samplers import packaged_file
from vrrt_jax.core.tree_file import Nodes, save_nodes
from vrrt_jax.robots import scenes_dir
from vrrt_jax.robots.robot_folder import Record, sha256, write_record
from vrrt_jax.splat.camera import look_at

START = "--start=-0.9693,-0.1394,-1.8025,-1.5824,-1.4606,0.8257,1.2331"
ARM = """<mujoco>
  <include file="defaults.xml"/>
  <worldbody>
    <body name="upper" pos="0 0 .1">
      <joint name="turn" axis="0 0 1" range="-2 2"/>
      <geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/>
      <body name="lower" pos=".3 0 0">
        <joint name="bend" axis="0 1 0" range="-2 2"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
DEFAULTS = """<mujocoinclude><compiler angle="radian"/></mujocoinclude>\n"""
URDF = """<robot name="arm">
  <link name="base"/>
  <joint name="turn" type="revolute">
    <origin xyz="0 0 0.5"/><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="10"/>
  </joint>
  <link name="upper"><collision>
    <origin xyz="0.2 0 0"/><geometry><mesh filename="package://arm/part.stl"/></geometry>
  </collision></link>
  <joint name="bend" type="revolute">
    <origin xyz="0.4 0 0"/><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1.5"/>
  </joint>
  <link name="lower"><collision><geometry><box size=".1 .1 .1"/></geometry></collision></link>
</robot>
"""
WORLD = """<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" pos="0 0 -.3"/>
    <geom name="box" type="box" size=".1 .1 .1" pos=".9 .9 .9" quat="1 0 0 0"/>
    <geom name="can" type="cylinder" size=".1 .2" pos="-.9 .9 .9"/>
    <geom name="ball" type="sphere" size=".1" pos="-.9 -.9 .9" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""
CALIBRATION = """%YAML:1.0
---
image_width: 480
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [579.4, 0., 239.5, 0., 579.4, 239.5, 0., 0., 1.]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [0.01, 0., 0., 0., 0.]
"""
ROOM = """<mujoco>
  <worldbody>
    <geom type="plane" size="4 4 .1"/>
    <geom type="box" size="3 .1 1" pos="2 -2 1"/>
    <geom type="box" size=".1 3 1" pos="-2 2 1"/>
    <geom type="cylinder" size=".2 1" pos="3.6 3.6 1"/>
  </worldbody>
</mujoco>
"""


def vrrt_inputs(folder: Path) -> list[tuple[str, list[str]]]:
    """Write the inputs; returns commands, each with the folder or file whose files it reads."""
    problem = json.loads((scenes_dir() / "problems/panda_open/problem.json").read_text())
    _write(folder, "arm.xml", ARM)
    _write(folder, "defaults.xml", DEFAULTS)
    _write(folder, "arm.urdf", URDF)
    _write(folder, "world.xml", WORLD)
    _write(folder, "camera.json", problem["views"][0]["camera"])
    _write(folder, "calibration.yaml", CALIBRATION)
    camera = look_at((1.75, -1.1, 1.1), (0.1, 0, 0.4))
    _write(folder, "extrinsics.json", {"world_to_camera": np.asarray(camera.world_to_cam).tolist()})
    _write(folder, "limits.json", {"velocity": 1.0, "acceleration": [2.0] * 7, "jerk": 20.0})
    _stl(folder / "part.stl")
    panda = scenes_dir() / "robots/panda"
    shutil.copy(panda / "robot.xml", folder / "panda.xml")
    shutil.copy(panda / "self_model.npz", folder)
    with Image.open(scenes_dir() / "problems/panda_open/goal.png") as goal:
        goal.save(folder / "goal.png")
        goal.getchannel("A").save(folder / "mask.png")
        seen = Image.new("RGB", goal.size, (200, 210, 220))
        seen.save(folder / "background.png")
        seen.paste(goal.convert("RGB"), mask=goal.getchannel("A"))
        seen.save(folder / "plain.jpg", quality=95)
    own, plan = folder / "problem", folder / "plan"
    fields = {"robot": "robot.xml", "world": "world.xml", "self_model": "self_model.npz"}
    for place in (own, plan / "problem"):
        for source, name in (("panda.xml", "robot.xml"), ("world.xml",) * 2, ("goal.png",) * 2):
            place.mkdir(parents=True, exist_ok=True)
            shutil.copy(folder / source, place / name)
        shutil.copy(folder / "self_model.npz", place)
        _write(place, "problem.json", problem | fields)
    path = np.array([problem["start"], problem["true_goal"]], np.float32)
    np.savez(plan / "path.npz", path=path, raw_path=path)
    _tree(plan / "tree.npz", path)
    _write(plan, "result.json", {"status": "SOLVED", "advice": "", "loss": 0.001, "seed": 0})
    fitted = folder / "fitted"
    fitted.mkdir()
    shutil.copy(folder / "panda.xml", fitted / "robot.xml")
    shutil.copy(folder / "self_model.npz", fitted)
    write_record(
        fitted,
        Record(
            name="panda",
            made_of={"source": "panda", "freeze": {}, "seed": 0, "detail": 1.0},
            source_sha256="0",
            model_sha256=sha256(fitted / "robot.xml"),
            versions={},
            rounds=1,
        ),
    )
    np.savez(folder / "arm_problems.npz", **_arm_problems())
    (folder / "problems").mkdir()
    (folder / "arm_problems.npz").rename(folder / "problems/shelf.npz")
    shots = folder / "dream"
    _write(shots, "_camera_settings.json", _dream_camera())
    _write(shots, "000001.json", _dream_frame(problem["true_goal"]))
    shutil.copy(folder / "plain.jpg", shots / "000001.rgb.jpg")
    shutil.copy(folder / "mask.png", shots / "000001.mask.png")
    _write(folder, "results.json", _results())
    at = {name: str(folder / name) for name in ("world.xml", "goal.png", "camera.json")}
    fast = ["--engine", "closed_form", "--out", "OUT"]
    plain = ["plan", "--robot", str(folder / "panda.xml"), "--world", at["world.xml"], START, *fast]
    plain += ["--self-model", str(folder / "self_model.npz")]
    seen = ["--goal", at["goal.png"], "--camera", at["camera.json"]]
    photo = ["--camera", str(folder / "calibration.yaml")]
    photo += ["--extrinsics", str(folder / "extrinsics.json"), "--goal", str(folder / "plain.jpg")]
    arm, urdf = (["--robot", str(folder / name)] for name in ("arm.xml", "arm.urdf"))
    robot = ["--robot", "panda"]
    drawn = ["--q=0.1,0.2", "--camera", at["camera.json"], "--out", "OUT/drawn.png"]
    times = ["--trajectory", "OUT/t.csv", "--limits", str(folder / "limits.json")]
    return [
        (".", [*plain, *seen]),
        (".", [*plain, *photo, "--robot-mask", str(folder / "mask.png")]),
        (".", [*plain, *photo, "--background", str(folder / "background.png")]),
        (".", [*plain, *seen, *times]),
        ("problem", ["plan", "--problem", str(own), *fast]),
        ("fitted", ["plan", "--robot", str(fitted), "--world", "open", START, *seen, *fast]),
        ("plan", ["view", str(plan)]),
        (".", ["render", *arm, *drawn]),
        (".", ["render", *urdf, *drawn]),
        (".", ["fit", str(folder / "arm.urdf"), "--out", "OUT/new"]),
        (".", ["spheres", *arm, "--num", "10", "--worlds", at["world.xml"]]),
        (".", ["spheres", *urdf, "--num", "10"]),
        (".", ["spheres", *robot, "--out", "OUT/arm.xml", "--into", str(folder / "panda.xml")]),
        (".", ["worlds", *urdf, "--num", "1", "--out", "OUT/worlds"]),
        ("results.json", ["report", str(folder / "results.json"), "--out", "OUT"]),
        ("problems", ["bench", "arm", "--problems", str(folder / "problems"), "--robot", "panda"]),
        (".", ["bench", "dream", str(shots), *photo[2:4], "--engine", "closed_form"]),
    ]


def nrp_inputs(folder: Path) -> list[tuple[str, list[str]]]:
    """As :func:`vrrt_inputs`, for homes."""
    shutil.copytree(PACKAGED / "home_1", folder / "problem")
    problem = json.loads((folder / "problem/problem.json").read_text())
    shutil.copy(folder / "problem/home.npz", folder)
    _write(folder, "room.xml", ROOM)
    maps = folder / "ros"
    pixels = np.full((120, 120), 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 0
    maps.mkdir()
    Image.fromarray(pixels).save(maps / "map.pgm")
    about = "image: map.pgm\nresolution: 0.05\norigin: [-3.0, -3.0, 0.0]\nnegate: 0\n"
    _write(maps, "map.yaml", about + "occupied_thresh: 0.65\nfree_thresh: 0.196\n")
    plan = folder / "plan"
    plan.mkdir()
    path = np.array([problem["start"], problem["goal"]], np.float32)
    shutil.copy(folder / "home.npz", plan / "map.npz")
    _tree(plan / "tree.npz", path)
    record = {"robot": "snake", "map": "home.npz", "status": "SOLVED", "verified": True}
    _write(plan, "path.json", {**record, "path": path.tolist(), "trajectory": path.tolist()})
    models = folder / "models"
    for kind in ("discriminator", "next"):
        (models / kind).mkdir(parents=True)
        shutil.copy(packaged_file("snake", kind), models / kind / "model.npz")
    poses = {"left": problem["start"], "right": problem["goal"], "unit": "m"}
    _write(folder, "poses.json", poses)
    _write(folder, "curves.json", _curves())
    data = folder / "data"
    _dataset(data, path)
    packaged = ["plan", "--problem", "home_1", "--out", "OUT", "--method"]
    ends = [f"--{n}={','.join(map(str, problem[n]))}" for n in ("start", "goal")]
    part = ["--map", str(maps / "map.yaml"), "--crop=-2.5,-2.5,2.8,2.8"]
    ros = ["--start=1.5,1.5,0,0,0,0,0,0", "--goal=2,1.5,0,0,0,0,0,0"]
    still = ["--out", "OUT", "--method", "rrt-connect"]
    home, rows = str(folder / "home.npz"), ["--data", str(data)]
    _write(maps, "poses.json", {"a": [1, 2] + [0] * 6, "b": [2, 1] + [0] * 6})
    curves = ["--homes", home, "--poses", str(folder / "poses.json"), "--nodes", "0"]
    mapped = ["--poses", str(maps / "poses.json")]
    train = ["train", "--task", "snake", *rows, "--out", "OUT/model", "--model"]
    score = ["--maps", str(maps), "--discriminator", str(models / "discriminator")]
    return [
        ("home.npz", ["plan", "--map", home, *ends, *still]),
        ("ros", ["plan", "--map", str(maps / "map.yaml"), *ros, *still]),
        ("ros", ["plan", *part, *ros, *still]),
        ("room.xml", ["plan", "--map", str(folder / "room.xml"), *ros, *still]),
        ("problem", ["plan", "--problem", str(folder / "problem"), *still]),
        ("models", [*packaged, "nrp-d", "--model", str(models / "discriminator")]),
        ("models", [*packaged, "next", "--model", str(models / "next/model.npz")]),
        ("plan", ["view", str(plan)]),
        ("curves.json", ["report", str(folder / "curves.json"), "--out", "OUT"]),
        (".", ["bench", "curves", *curves, "--json", "OUT/curves.json"]),
        ("ros", ["bench", "curves", "--homes", str(maps / "map.yaml"), *mapped, "--nodes", "0"]),
        ("data", ["score", "--task", "snake", *rows, *score]),
        ("data", [*train, "discriminator"]),
        ("data", [*train, "next"]),
    ]


def _write(folder: Path, name: str, content) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    text = content if isinstance(content, str) else json.dumps(content, indent=1)
    (folder / name).write_text(text)


def _stl(file: Path) -> None:
    """A pyramid."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    triangles = b"".join(bytes(12) + corners[face].tobytes() + bytes(2) for face in faces)
    file.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + triangles)


def _tree(file: Path, q: np.ndarray) -> None:
    save_nodes(Nodes(q=q, parent=np.array([-1, 0]), score=np.array([0.1, 0.01], np.float32)), file)


def _arm_problems() -> dict[str, np.ndarray]:
    from arm_cases import arrays_of

    from vrrt_jax.robots import load_robot

    return arrays_of(load_robot("panda"), [[-0.6, -0.6, 0.1]], [[-0.6, 0.6, 0.1]])


def _dream_camera() -> dict:
    inner = {"fx": 579.4, "fy": 579.4, "cx": 239.5, "cy": 239.5}
    size = {"width": 480, "height": 480}
    return {"camera_settings": [{"intrinsic_settings": inner, "captured_image_size": size}]}


def _dream_frame(q: list[float]) -> dict:
    joints = [{"name": f"panda_joint{k + 1}", "position": v} for k, v in enumerate(q)]
    names = ("link0", "link2", "link3", "link4", "link6", "link7", "hand")
    points = [
        {"name": f"panda_{name}", "projected_location": [100.0 + 30 * k, 200.0 + 7 * k * k]}
        for k, name in enumerate(names)
    ]
    return {"objects": [{"keypoints": points}], "sim_state": {"joints": joints}}


def _results() -> dict:
    """What ``vrrt bench visual`` writes, of one task."""
    level = {
        **{"distance_rad": 1.0, "level": 1.0, "n": 1, "success": 1.0, "causes": {}},
        **{"median_time_s": 1.0, "p95_time_s": 1.0, "path_length": 2.0, "mean_error_rad": 0.01},
        **{"median_psnr_db": 30.0, "refused_paths": 0},
    }
    return {
        **{"what": "visual", "robot": "panda", "seed": 0, "engine": "mjx", "hard": False},
        "variants": [{"method": "vrrt", "name": "", "config": {"lineages": {"num": 64}}}],
        "scenery": {"views": 1, "occluded": False, "light": 1.0, "azimuth_deg": 0.0},
        **{"average_success": 1.0, "levels": [level], "tasks": [{"index": 0, "time_s": 1.0}]},
    }


def _curves() -> dict:
    """What ``nrp bench curves`` writes, of one planner."""
    shares = {name: [0.5, 1.0] for name in ("success", "optimality")}
    shares |= {f"{name}_deviation": [0.1, 0.0] for name in ("success", "optimality")}
    found = {"time_s": [1.0, 10.0], "n": 2, "median_first_s": 0.5, "not_verified": 0, **shares}
    by = {name: {"at": [100.0, 1000.0], **shares} for name in ("expansions", "checks")}
    return {
        **{"what": "curves", "task": "snake", "command": "nrp bench curves", "runs": 1},
        **{"machine": {"cores": 1, "processor": "x"}, "homes": ["home"], "notes": []},
        "reference": {"what": "a roadmap"},
        "planners": {"rrt": {**found, **by, "optimality_shortened": 0.9}},
    }


def _dataset(folder: Path, path: np.ndarray) -> None:
    """A data set of the snake, of three homes of two queries each."""
    settings = DatasetSettings(task="snake", queries=2, waypoints=2, nodes=500)
    occupied = np.zeros((100, 100, 20), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    assert Grid(occupied=occupied).resolution == 0.1
    q = np.repeat(path[:1], 4, axis=0)
    columns = {"q_start": q, "q_goal": np.repeat(path[1:], 4, axis=0), "waypoint": q}
    columns |= {"optimal": q, "ratio": np.ones(4, np.float32), "length": np.ones(4, np.float32)}
    shards = {}
    folder.mkdir()
    for name in ("train_00000.npz", "train_00001.npz", "test_00000.npz"):
        np.savez(
            folder / name,
            occupied=np.packbits(occupied, axis=-1),
            layers=20,
            query=np.array([0, 0, 1, 1]),
            **columns,
        )
        shards[name] = {"rows": 4, "seed": 0, "sha256": checksum(folder / name)}
    _write(folder, MANIFEST, {"settings": vars(settings), "rows": 12, "shards": shards})
