"""Data sets: complete after any interruption, and refused rather than mixed."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from nrp_jax.cli import main
from nrp_jax.learning import data, shards
from nrp_jax.learning.difficulty import fair_house
from nrp_jax.scene.robots import load_robot

SETTINGS = shards.DatasetSettings(task="snake", queries=6, waypoints=4, nodes=500, seed=4)
HOMES = {"homes": 2, "test_homes": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("rows") / "set"
    data.write_dataset(out, SETTINGS, **HOMES)
    return out


@pytest.fixture(scope="module")
def whole(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_rows_and_homes(folder):
    train, test = (data.load_dataset(folder, split) for split in ("train", "test"))
    assert (len(train), len(test)) == (48, 24) and train.settings == SETTINGS
    for key in ("q_start", "q_goal", "waypoint", "optimal"):
        assert train.rows[key].shape == (48, 8) and train.rows[key].dtype == np.float32
    assert np.bincount(train.rows["home"]).tolist() == [24, 24]
    assert (np.bincount(train.rows["query"]) == 8).all()
    first = fair_house(load_robot("snake"), shards.home_seed(SETTINGS, "train", 0)).grid
    assert (train.grids[0].occupied == first.occupied).all()
    for grid in train.grids:
        assert (grid.occupied != test.grids[0].occupied).any()
    assert not list(folder.glob("*.part"))


def test_splits_never_share_a_home():
    train = {shards.home_seed(dataclasses.replace(SETTINGS, seed=s), "train", k)
             for s in (0, 1, 99) for k in (0, 1, 9_999)}  # fmt: skip
    test = {shards.home_seed(dataclasses.replace(SETTINGS, seed=s), "test", k)
            for s in (0, 1, 99) for k in (0, 1, 9_999)}  # fmt: skip
    assert len(train) == len(test) == 9 and max(train) < min(test)


def test_a_second_run_does_nothing(folder, whole):
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
    calls = []
    data.write_dataset(folder, SETTINGS, **HOMES, on_progress=lambda *c: calls.append(c))
    assert calls == [(3, 3)]
    assert before == {path: path.stat().st_mtime_ns for path in folder.glob("*.npz")}


@pytest.mark.light_compilation
def test_scores_are_written(folder, tmp_path, capsys):
    maps = tmp_path / "maps"
    maps.mkdir()
    data.load_dataset(folder, "test").grids[0].save(maps / "home.npz")
    own = shutil.copytree(folder, tmp_path / "set")  # roadmaps will be kept in it
    out = tmp_path / "score.json"
    unmapped = ["score", "--data", str(own), "--queries", "8", "--nodes", "500"]
    unmapped += ["--json", str(out)]
    command = [*unmapped, "--maps", str(maps)]
    assert main([*command, "--task", "snake"]) == 0
    found = json.loads(out.read_text())
    assert found["checked"] and found["maps"]["names"] == ["home.npz"]
    for homes in (found["unseen_homes"], found["maps"]):
        for kind in ("discriminator", "cvae"):
            assert 0.5 < homes[kind]["optimality_score"] <= 1.0 and homes[kind]["queries"] == 8
            assert homes[kind]["ms_per_32"] > 0
    assert main([*unmapped, "--task", "snake", "--unchecked"]) == 0
    rough = json.loads(out.read_text())["unseen_homes"]["cvae"]["optimality_score"]
    assert rough < found["unseen_homes"]["cvae"]["optimality_score"]
    trained = ["--split", "train", "--num-homes", "1"]
    assert main([*unmapped, "--task", "snake", *trained]) == 0
    found = json.loads(out.read_text())
    assert "unseen_homes" not in found and len(found["training_homes"]["cvae"]["by_home"]) == 1
    assert main([*command, "--task", "fetch"]) == 2
    assert "is of task 'snake'; expected 'fetch'" in capsys.readouterr().err


def test_a_damaged_shard_is_refused_and_made_again(folder, whole):
    victim = folder / "train_00001.npz"
    content = bytearray(victim.read_bytes())
    content[len(content) // 2] ^= 0xFF
    victim.write_bytes(content)
    with pytest.raises(ValueError, match="train_00001.npz' is missing or damaged; run `nrp data"):
        data.load_dataset(folder)
    assert len(data.load_dataset(folder, "test")) == 24
    calls = []
    data.write_dataset(folder, SETTINGS, **HOMES, on_progress=lambda *c: calls.append(c))
    assert calls == [(2, 3), (3, 3)]
    assert rows_of(victim.read_bytes(), folder) == rows_of(whole[victim.name], folder)


def rows_of(content: bytes, folder: Path) -> dict[str, bytes]:
    scratch = folder.parent / "rows.npz"
    scratch.write_bytes(content)
    with np.load(scratch) as arrays:
        return {key: arrays[key].tobytes() for key in arrays}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"task": "fetch"}, "was made with task snake, not fetch"),
        ({"waypoints": 5}, "was made with waypoints 4, not 5"),
        ({"homes_version": 99}, "was made with homes_version 1, not 99"),
        ({"rows_version": 99}, f"was made with rows_version {shards.VERSION}, not 99"),
    ],
)
def test_a_data_set_of_other_settings_is_refused(folder, changes, words):
    with pytest.raises(ValueError, match=words):
        data.write_dataset(folder, dataclasses.replace(SETTINGS, **changes), **HOMES)


def test_bad_input(tmp_path, folder):
    (tmp_path / "letter.txt").write_text("keep me")
    with pytest.raises(ValueError, match="is not empty and holds no data set"):
        data.write_dataset(tmp_path, SETTINGS)
    with pytest.raises(ValueError, match="unknown task 'arm'; have: snake, fetch"):
        data.write_dataset(tmp_path / "a", shards.DatasetSettings(task="arm"))
    with pytest.raises(ValueError, match="0 queries: expected at least 1"):
        data.write_dataset(tmp_path / "a", dataclasses.replace(SETTINGS, queries=0))
    with pytest.raises(ValueError, match="unknown split 'validation'"):
        data.load_dataset(folder, "validation")
    with pytest.raises(FileNotFoundError, match="no data set in"):
        data.load_dataset(tmp_path / "nowhere")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / data.MANIFEST).write_text("{ broken")
    with pytest.raises(ValueError, match="is not readable"):
        data.load_dataset(tmp_path / "b")
    assert not (tmp_path / "a").exists()


def test_a_killed_run_leaves_what_the_next_one_finishes(tmp_path):
    out = tmp_path / "set"
    script = (
        "from nrp_jax.learning import data, shards\n"
        f"data.write_dataset({str(out)!r}, shards.{SETTINGS}, homes=3, test_homes=0)\n"
    )
    cache = {
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
    root = Path(__file__).parents[3]
    run = subprocess.Popen([sys.executable, "-c", script], cwd=root, env=os.environ | cache)
    try:
        deadline = time.monotonic() + 240
        while not (out / "train_00000.npz").exists():
            assert time.monotonic() < deadline and run.poll() is None
            time.sleep(0.02)
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    manifest = json.loads((out / data.MANIFEST).read_text())
    assert len(manifest["shards"]) < 3
    if manifest["shards"]:
        assert len(data.load_dataset(out)) == 24 * len(manifest["shards"])
    (out / f"train_00001.{os.getpid()}.part").write_bytes(b"half of a shard")
    data.write_dataset(out, SETTINGS, homes=2, test_homes=0)
    assert len(data.load_dataset(out)) == 48
    assert not list(out.glob("*.part"))


def test_what_was_done_survives_a_failure(whole, tmp_path):
    out = tmp_path / "set"
    data.write_dataset(out, SETTINGS, homes=0, test_homes=0)
    in_the_way = out / "train_00001.npz"
    in_the_way.mkdir()
    with pytest.raises(OSError):
        data.write_dataset(out, SETTINGS, homes=2, test_homes=0)
    done = json.loads((out / data.MANIFEST).read_text())["shards"]
    assert list(done) == ["train_00000.npz"]
    assert (out / "train_00000.npz").read_bytes() == whole["train_00000.npz"]
