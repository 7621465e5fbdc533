"""What this machine has of what the commands need, and what to install for the rest."""

import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

import jax
import mujoco

from vrrt_jax.core.timing import machine, versions
from vrrt_jax.robots import load_robot, robot_names
from vrrt_jax.robots.mesh_sources import install_hint, mesh_file, mesh_spec

# Extras of the package: what they are for, and a module that each brings.
_EXTRAS = {
    "plot": ("figures and animations", "matplotlib"),
    "view": ("plans in the browser", "viser"),
    "photo": ("lenses with distortion, masks from boxes, camera poses", "cv2"),
    "notebook": ("notebooks", "nbclient"),
    "peers": ("OMPL's planners in benchmarks", "ompl"),
}


def findings() -> Iterator[tuple[str, str]]:
    """What there is, as pairs of a name and what was found or what to do."""
    found = machine()
    yield "machine", f"{found['processor']}, {found['cores']} cores, {found['platform']}"
    yield "versions", ", ".join(f"{name} {version}" for name, version in versions().items())
    yield "devices", ", ".join(str(device) for device in jax.devices())
    yield "OpenGL", _opengl()
    for name in robot_names():
        yield f"meshes of {name}", _meshes(name)
    yield "compiled programs", _cache()
    for extra, (purpose, module) in _EXTRAS.items():
        missing = importlib.util.find_spec(module) is None
        yield extra, f"{purpose}: " + (f'pip install "vrrt-jax[{extra}]"' if missing else "yes")


def _opengl() -> str:
    """Whether MuJoCo draws, with which backend."""
    backend = os.environ.get("MUJOCO_GL", "the system's")
    try:
        model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
        with mujoco.Renderer(model, 16, 16) as renderer:
            renderer.update_scene(mujoco.MjData(model))
            renderer.render()
    except Exception as error:  # noqa: BLE001 - each backend fails in a way of its own
        return f"{backend} does not draw ({error}); apt-get install libosmesa6"
    return f"{backend} draws"


def _meshes(name: str) -> str:
    """Where the true geometry of a packaged robot is."""
    robot = load_robot(name)
    if mesh_spec(robot, visuals=False) is None:
        hint = install_hint(robot.mesh_source)
        return f"none, so spheres are checked and drawn instead; {hint}"
    return str(mesh_file(robot.mesh_source))


def _cache() -> str:
    """Where compiled programs are kept, and how much there is."""
    folder = jax.config.jax_compilation_cache_dir
    if folder is None:
        return "not kept"
    sizes = [file.stat().st_size for file in Path(folder).glob("*") if file.is_file()]
    return f"{folder}: {len(sizes)} files, {sum(sizes) / 1e6:.0f} MB"
