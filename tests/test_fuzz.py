"""Damaged and odd inputs for both commands; ``tests/fuzz.py`` tries thousands."""

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import fuzz
import numpy as np
import pytest

pytestmark = pytest.mark.light_compilation
COUNT = 16


@pytest.mark.parametrize("name", ["vrrt", "nrp"])
def test_every_answer_is_as_it_should_be(name):
    rows = fuzz.work(name, 20, range(COUNT))
    assert [row for row in rows if row["faults"]] == []
    assert sum(row["told"].startswith("2:") for row in rows) > COUNT // 2


@pytest.mark.parametrize("name", ["vrrt", "nrp"])
def test_odd_options_are_answered_as_they_should_be(name):
    rows = fuzz.work(name, 20, range(COUNT), options=True)
    assert [row for row in rows if row["faults"]] == []
    assert sum(row["told"].startswith("2:") for row in rows) > COUNT // 2


@pytest.mark.parametrize(
    "words",
    [
        ["spheres", "--robot=panda", "--num=two\nlines"],
        ["spheres", "--robot=/proc/self/mem"],
        ["spheres", "--robot=panda", "--out=\udcff.xml"],
        ["spheres", "--robot=arm"],
    ],
)
def test_options_that_once_failed_are_told_in_one_line(words):
    with fuzz.inputs_of("vrrt") as inputs:
        (inputs.folder.parent / "arm").write_text("<mujoco/>")
        row = fuzz.judged(inputs, "vrrt", inputs.folder, "", words)
    assert not row["faults"] and row["told"].startswith("2:"), row


@pytest.mark.parametrize("name", ["vrrt", "nrp"])
def test_valid_inputs_are_read_whole(name):
    """So what the fuzzer damages is what is refused."""
    with fuzz.inputs_of(name) as inputs:
        for _, words in inputs.commands:
            row = fuzz.judged(inputs, name, inputs.files[0], "nothing", inputs.written(words))
            assert not row["faults"] and row["told"].startswith(("read:", "0:")), row


def text(old, new):
    return lambda file: file.write_text(file.read_text().replace(old, new, 1))


def fields(**changes):
    return lambda file: file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def without(name):
    def spoil(file):
        kept = json.loads(file.read_text())
        del kept[name]
        file.write_text(json.dumps(kept))

    return spoil


def pipe(file):
    file.unlink()
    os.mkfifo(file)


def folder(file):
    file.unlink()
    file.mkdir()


def array(name, change):
    def spoil(file):
        with np.load(file) as saved:
            arrays = dict(saved)
        np.savez(file, **arrays | {name: change(arrays[name])})

    return spoil


def terabyte(name):
    def spoil(file):
        content = io.BytesIO()
        about = {"descr": "<f8", "fortran_order": False, "shape": (1 << 37,)}
        np.lib.format.write_array_header_1_0(content, about)
        with np.load(file) as saved:
            arrays = {key: saved[key] for key in saved.files if key != name}
        np.savez(file, **arrays)
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr(f"{name}.npy", content.getvalue())

    return spoil


BOTH_LONG = np.ones(1 << 20)
# What once ended in another way: by the command, the file, and what is done to it.
ONCE = [
    ("vrrt", "mask.png", pipe),
    ("vrrt", "defaults.xml", pipe),
    ("vrrt", "defaults.xml", folder),
    ("vrrt", "problem/self_model.npz", lambda file: file.write_text("a text")),
    ("vrrt", "problem/self_model.npz", terabyte("2/tau")),
    ("vrrt", "problem/self_model.npz", array("2/rgb", lambda a: a[:0])),
    ("vrrt", "problem/self_model.npz", array("1/radius", lambda a: a.astype(complex))),
    ("vrrt", "problem/self_model.npz", array("2/shade", lambda a: a.astype(float) + 1e308)),
    ("vrrt", "problem/problem.json", fields(start=[[0.0]])),
    ("vrrt", "plan/path.npz", array("path", lambda a: a[:, :3])),
    ("vrrt", "plan/tree.npz", array("parent", lambda a: a + 9)),
    ("vrrt", "plan/result.json", lambda file: file.write_text("[]")),
    ("vrrt", "camera.json", fields(target=[0, 1e308, 0])),
    ("vrrt", "results.json", fields(levels=[{"x": 1}])),
    ("vrrt", "results.json", fields(scenery=3)),
    ("vrrt", "arm.urdf", text('xyz="0 0 1"', 'xyz="nan"')),
    ("vrrt", "limits.json", fields(jerk=[])),
    ("vrrt", "goal.png", lambda file: file.write_bytes(b"")),
    ("nrp", "home.npz", array("resolution_m", lambda _: BOTH_LONG)),
    ("nrp", "home.npz", terabyte("occupied")),
    ("nrp", "ros/map.pgm", pipe),
    ("nrp", "ros/map.yaml", text("0.05", "[]")),
    ("nrp", "problem/problem.json", fields(map=3)),
    ("nrp", "models/discriminator/model.npz", array("description", lambda _: np.array("{}"))),
    ("nrp", "plan/path.json", fields(trajectory=[[1e400] * 8])),
    ("nrp", "plan/tree.npz", array("q", lambda a: a.astype(float) * 1e300)),
    ("nrp", "curves.json", fields(planners={"rrt": 3})),
    ("nrp", "data/manifest.json", fields(shards={"train_0.npz": 3})),
    ("nrp", "data/manifest.json", without("shards")),
    ("vrrt", "dream/_camera_settings.json", text('"width": 480', '"width": Infinity')),
]


@pytest.mark.parametrize("name", ["vrrt", "nrp"])
def test_what_once_failed_is_told_in_one_line(name):
    with fuzz.inputs_of(name) as inputs:
        for place, change in [case[1:] for case in ONCE if case[0] == name]:
            file, words = inputs.reading(place)
            change(file)
            row = fuzz.judged(inputs, name, file, "", words)
            assert not row["faults"] and row["told"].startswith("2:"), row


def test_a_process_answers_too():
    """What the fuzzer asks in one process, a user asks in one of its own."""
    with fuzz.inputs_of("vrrt") as inputs:
        file, words = inputs.reading("problem/self_model.npz")
        file.write_text("a text")
        command = [sys.executable, "-m", "vrrt_jax.cli", *words]
        root = Path(__file__).parents[1]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=root)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert "self_model.npz' is no readable .npz" in done.stderr
