"""Who may import whom: a room uses only what is below it."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# From the ground up. A module of a room may import its own room and those before it.
VRRT_ROOMS = (
    ("gl",),
    ("core",),
    ("robots",),
    ("scene",),
    ("motion",),
    ("splat",),
    ("config", "checks", "outcome"),
    ("visual",),
    ("attempts", "joint"),
    ("planner", "batch", "pose", "problems", "random_problem"),
    ("report", "viz", "viewer", "doctor"),
    ("bench", "robot_commands"),
    ("cli", "__main__"),
)
NRP_ROOMS = (
    ("config",),
    ("homes",),
    ("scene",),
    ("learning",),
    ("samplers", "generators", "guides", "retrieval"),
    ("planners",),
    ("planner", "batch", "problems", "online", "online_problems"),
    ("viz", "viewer"),
    ("bench",),
    ("cli", "__main__"),
)
FILES = sorted(
    path.relative_to(ROOT).as_posix()
    for package in ("vrrt_jax", "nrp_jax")
    for path in (ROOT / package).rglob("*.py")
)


def imported(file):
    """Modules that a file imports, at any depth of its code."""
    for node in ast.walk(ast.parse((ROOT / file).read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def floor(module, rooms):
    """The index of the room that a module, such as "core.tree", lives in; None if it has none."""
    for index, names in enumerate(rooms):
        if any(module == name or module.startswith(f"{name}.") for name in names):
            return index
    return None


def room_of(file):
    """The package of a file, its rooms, and the index of its own; None for the package itself."""
    package, _, inner = file.removesuffix(".py").removesuffix("/__init__").partition("/")
    rooms = VRRT_ROOMS if package == "vrrt_jax" else NRP_ROOMS
    return package, rooms, floor(inner.replace("/", "."), rooms)


@pytest.mark.parametrize("file", FILES)
def test_a_room_uses_only_what_is_below_it(file):
    package, rooms, here = room_of(file)
    if file.count("/") == 1 and file.endswith("__init__.py"):
        return  # the package's face is above all rooms
    assert here is not None, f"{file} has no room"
    for module in imported(file):
        other, _, rest = module.partition(".")
        if other != package:
            continue
        there = floor(rest, rooms)
        if there is None:  # a name of the package's face, such as vrrt_jax.plan
            there = len(rooms) - 1
        assert there <= here, f"{file} imports {module}, which is above it"


def test_vrrt_never_imports_nrp():
    for file in FILES:
        if file.startswith("vrrt_jax/"):
            assert not any(m.split(".")[0] == "nrp_jax" for m in imported(file)), file


def test_nrp_takes_the_four_lower_rooms_from_vrrt():
    allowed = ("vrrt_jax.core", "vrrt_jax.robots", "vrrt_jax.scene", "vrrt_jax.motion")
    for file in FILES:
        if file.startswith("nrp_jax/"):
            for module in imported(file):
                assert not module.startswith("vrrt_jax") or module.startswith(allowed), module


def test_the_core_knows_neither_robots_nor_images_nor_networks():
    for file in FILES:
        if file.startswith("vrrt_jax/core/"):
            for module in imported(file):
                assert not module.startswith(("mujoco", "flax", "optax", "scipy")), (file, module)
