"""A robot's folder is loaded if it is whole, and refused in one line if it is not."""

import dataclasses
import json

import pytest

import vrrt_jax
from vrrt_jax.problems import self_model_path
from vrrt_jax.robots import mjcf_writer, robot_folder
from vrrt_jax.robots.robot_folder import MODEL, RECORD, SELF_MODEL, Record

ARM = """
<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="lift" axis="0 1 0" range="-120 120"/>
      <geom type="sphere" size="0.05" pos="0 0 0.2"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def folder(tmp_path):
    """A folder as ``vrrt fit`` leaves it, but for the self-model, which is not read here."""
    source, folder = tmp_path / "source.xml", tmp_path / "my_arm"
    source.write_text(ARM)
    folder.mkdir()
    text = mjcf_writer.renamed(vrrt_jax.load_robot(source).xml, "my_arm")
    (folder / MODEL).write_text(text)
    (folder / SELF_MODEL).write_bytes(b"")
    record = Record(
        name="my_arm",
        made_of={"source": str(source), "freeze": {}, "seed": 0, "detail": 1.0},
        source_sha256=robot_folder.sha256(source),
        model_sha256=robot_folder.sha256(folder / MODEL),
        versions={},
        rounds=1,
    )
    robot_folder.write_record(folder, record)
    return folder


def test_a_folder_is_a_robot_with_a_self_model(folder, tmp_path):
    robot = vrrt_jax.load_robot(folder)
    assert robot.name == "my_arm" and robot.joint_names == ("lift",)
    assert robot.mesh_source == str(tmp_path / "source.xml")
    assert self_model_path(robot) == folder / SELF_MODEL
    alone = vrrt_jax.load_robot(folder / MODEL)
    assert alone.folder is None and alone.xml == robot.xml
    with pytest.raises(ValueError, match="make a folder with one with: vrrt fit"):
        self_model_path(alone)
    assert self_model_path(alone, "other.npz").name == "other.npz"


def test_a_record_comes_back(folder):
    record = robot_folder.read_record(folder)
    again = dataclasses.replace(record, rounds=2, levels=({"size_px": 32},))
    robot_folder.write_record(folder, again)
    assert robot_folder.read_record(folder) == again
    assert robot_folder.model_file(folder) == folder / MODEL


def test_it_is_a_robot_without_the_file_that_it_was_made_of(folder, tmp_path):
    (tmp_path / "source.xml").unlink()
    assert vrrt_jax.load_robot(folder).num_joints == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda folder: (folder / RECORD).unlink(), "no robot's folder: it has no robot.json"),
        (lambda folder: (folder / RECORD).write_text('{"format": 1, '), "is not valid JSON"),
        (lambda folder: (folder / RECORD).write_text("[]"), "has format None, expected 1"),
        (lambda folder: edit(folder, format=2), "has format 2, expected 1"),
        (lambda folder: edit(folder, color="red"), "unknown fields: color"),
        (lambda folder: edit(folder, rounds=None), "lacks the field rounds"),
        (lambda folder: edit(folder, rounds="1"), "has rounds '1'; expected a whole number"),
        (lambda folder: edit(folder, made_of={}), "does not say what the robot was made of"),
        (lambda folder: edit(folder, rounds=0), "no self-model yet: .* go on with: vrrt fit .*arm"),
        (lambda folder: (folder / MODEL).unlink(), "has no robot.xml"),
        (lambda folder: (folder / SELF_MODEL).unlink(), "has no self_model.npz"),
        (
            lambda folder: (folder / MODEL).write_text(vrrt_jax.load_robot("panda").xml),
            "not the one that robot.json was written with: it was changed, or is of another",
        ),
        (
            lambda folder: (folder.parent / "source.xml").write_text(ARM.replace("0.05", "0.06")),
            "source.xml' has changed since '.*my_arm' was made of it",
        ),
    ],
)
def test_a_folder_that_is_not_whole_is_refused(folder, change, words):
    change(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=words) as refused:
        vrrt_jax.load_robot(folder)
    assert "\n" not in str(refused.value) and "vrrt fit" in str(refused.value)


def edit(folder, **changes):
    fields = json.loads((folder / RECORD).read_text()) | changes
    fields = {name: value for name, value in fields.items() if value is not None}
    (folder / RECORD).write_text(json.dumps(fields))
