import ast
import importlib
import pkgutil
import re
from pathlib import Path

import jax
import numpy as np
import pytest

import nrp_jax
import vrrt_jax
from vrrt_jax.outcome import ADVICE

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "vrrt_jax"


def imports(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def test_every_public_name_resolves_and_has_a_docstring():
    assert sorted(vrrt_jax.__all__) == vrrt_jax.__all__
    for name in vrrt_jax.__all__:
        assert getattr(vrrt_jax, name).__doc__, name


@pytest.mark.parametrize("package", ["vrrt_jax", "nrp_jax"])
def test_every_module_imports(package):
    """Names that modules import from each other exist."""
    found = importlib.import_module(package)
    for module in pkgutil.walk_packages(found.__path__, f"{package}."):
        importlib.import_module(module.name)


def test_names_in_place_of_what_they_name_are_told():
    panda = vrrt_jax.load_robot("panda")
    world = vrrt_jax.build_world(panda, engine="closed_form")
    home, key = panda.home, jax.random.key(0)
    robot, room = r"the robot is 'panda'; .*load_robot", r"the world is 'open'; .*load_world"
    with pytest.raises(ValueError, match=robot):
        vrrt_jax.build_world("panda")
    with pytest.raises(ValueError, match=robot):
        vrrt_jax.plan_to_configuration("panda", world, home, home, key=key)
    with pytest.raises(ValueError, match=room):
        vrrt_jax.plan_to_configuration(panda, "open", home, home, key=key)
    with pytest.raises(ValueError, match=robot):
        vrrt_jax.verify_path("panda", [], home[None])
    with pytest.raises(ValueError, match="the world is None"):
        vrrt_jax.inverse_kinematics(panda, None, np.eye(4), key=key)
    snake = nrp_jax.load_robot("snake")
    with pytest.raises(ValueError, match=r"the map is 'home.npz'; .*nrp_jax.load_map"):
        nrp_jax.plan(snake, "home.npz", np.zeros(8), np.zeros(8), key=key)


def test_numbers_that_make_no_sense_are_told():
    panda = vrrt_jax.load_robot("panda")
    box = vrrt_jax.Obstacle(name="box", kind="box", position=(1, 1, 1), size=(0.1, 0.1, 0.1))
    world = vrrt_jax.build_world(panda, [box], engine="closed_form")
    with pytest.raises(ValueError, match="3 positive numbers"):
        vrrt_jax.move_obstacle(world, "box", size=(0.1, 0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match="num is 2.5"):
        vrrt_jax.inverse_kinematics(panda, world, np.eye(4), key=jax.random.key(0), num=2.5)
    far = np.stack([panda.home, 1e6 * panda.home])
    with pytest.raises(ValueError, match="check its units"):
        vrrt_jax.verify_path(panda, [], far)
    with pytest.raises(ValueError, match="between 0 and 1"):
        vrrt_jax.write_image("image.png", np.zeros((2, 2, 3)), np.full((2, 2), np.nan))


def test_mjx_is_in_its_engine_alone():
    users = [
        str(file.relative_to(PACKAGE))
        for file in PACKAGE.rglob("*.py")
        if any(m == "mujoco.mjx" or m.startswith("mujoco.mjx.") for m in imports(file))
        or "from mujoco import mjx" in file.read_text()
    ]
    assert users == ["scene/mjx.py"]


def test_files_are_short():
    for package in (PACKAGE, ROOT / "nrp_jax"):
        for file in package.rglob("*.py"):
            assert len(file.read_text().splitlines()) <= 420, file.name


@pytest.mark.parametrize("index", [0, 1])
def test_the_readme_runs(index, tmp_path, monkeypatch):
    """The README's Python, as it stands there."""
    codes = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(codes) == 2
    monkeypatch.chdir(tmp_path)
    scope = {}
    exec(compile(codes[index], "README.md", "exec"), scope)
    assert scope["result"].ok


def test_the_documents_give_the_advice_that_plans_give():
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    for status, advice in ADVICE.items():
        if advice and status.name != "INTERRUPTED":
            assert f"| `{status.name}` | {status.value} | {advice} |" in page, status
        assert f"\n## {status.name}\n" in page, status


def test_the_python_of_the_documents_compiles():
    """Names that the documents import exist."""
    for page in [*(ROOT / "docs").glob("*.md"), ROOT / "CONTRIBUTING.md"]:
        for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
            tree = ast.parse(code)
            for node in ast.walk(tree):
                if isinstance(node, ast.ImportFrom) and node.module:
                    module = importlib.import_module(node.module)
                    for alias in node.names:
                        assert hasattr(module, alias.name), f"{page.name}: {alias.name}"
                elif (
                    isinstance(node, ast.Attribute)
                    and isinstance(node.value, ast.Name)
                    and node.value.id in ("vrrt_jax", "nrp_jax")
                ):
                    package = importlib.import_module(node.value.id)
                    assert hasattr(package, node.attr), f"{page.name}: {node.attr}"
