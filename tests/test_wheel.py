"""The wheel works without the checkout: it brings all that plans load."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import vrrt_jax

ROOT = Path(__file__).parents[1]
# Run outside of the checkout. Everything that is packaged is loaded; nothing is planned.
LOAD = """
import pathlib, sys
import nrp_jax, nrp_jax.problems, vrrt_jax

for package in (vrrt_jax, nrp_jax):
    assert pathlib.Path(package.__file__).is_relative_to(sys.argv[1]), package.__file__
for name in vrrt_jax.problem_names():
    problem = vrrt_jax.load_problem(name, engine="closed_form")
for name in vrrt_jax.robot_names():
    robot = vrrt_jax.load_robot(name)
    vrrt_jax.load_self_model(vrrt_jax.problems.self_model_path(robot))
vrrt_jax.load_world("panda_1", problem.robot, engine="closed_form")
for name in nrp_jax.problems.problem_names():
    nrp_jax.problems.load_problem(name)
for robot in ("snake", "fetch"):
    nrp_jax.load_robot(robot)
    for kind in ("discriminator", "cvae"):
        nrp_jax.load_sampler(robot, kind)
print(*vrrt_jax.robot_names(), *vrrt_jax.problem_names(), *nrp_jax.problems.problem_names())
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (found,) = folder.glob("*.whl")
    return found


def test_the_wheel_has_types_scenes_and_the_version(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert f"vrrt_jax-{vrrt_jax.__version__}-" in wheel.name
    assert f"version: {vrrt_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert {"vrrt_jax/py.typed", "nrp_jax/py.typed"} <= names
    packaged = {file.relative_to(ROOT / "scenes").as_posix() for file in scenes()}
    assert {f"vrrt_jax/_scenes/{name}" for name in packaged} <= names
    modules = {
        file.relative_to(ROOT).as_posix()
        for package in ("vrrt_jax", "nrp_jax")
        for file in (ROOT / package).rglob("*.py")
    }
    assert {name for name in names if name.endswith(".py")} == modules


def scenes():
    return [file for file in (ROOT / "scenes").rglob("*") if file.suffix in (".xml", ".npz")]


def test_what_is_packaged_loads_from_the_wheel_alone(wheel, tmp_path):
    install = ["install", "-q", "--no-deps", "--no-index", "--target", str(tmp_path / "site")]
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    subprocess.run([*pip, *install, str(wheel)], check=True, capture_output=True)
    outside = tmp_path / "elsewhere"
    outside.mkdir()
    path = {"PYTHONPATH": str(tmp_path / "site"), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    ran = subprocess.run(
        [sys.executable, "-c", LOAD, str(tmp_path / "site")],
        cwd=outside,
        env=os.environ | path,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    assert "fetch panda ur5e" in ran.stdout and "panda_posts" in ran.stdout
    assert "home_1 home_fetch" in ran.stdout
