"""Shared fixtures: one robot, one world and few compiled functions for all files."""

import ctypes
import gc
import os
import resource
import sys
from pathlib import Path

# Read when JAX is imported. What is not of the package's own `host_jit` compiles quicker so, too.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1")

import jax
import numpy as np
import pytest

import vrrt_jax
from vrrt_jax.scene import exact

LARGE = 1.8e9  # bytes

# Compiled programs survive between runs and are shared by pytest-xdist's workers.
jax.config.update("jax_compilation_cache_dir", str(Path.home() / ".cache" / "vrrt_jax_tests"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def forget_what_was_compiled():
    """Drop compiled programs and scenes, and give what is freed back to the system."""
    jax.clear_caches()
    exact.forget()
    gc.collect()
    if sys.platform == "linux":
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def compile_as_marked(node):
    """Compile with little effort what a file or a test with the mark ``light_compilation`` runs.

    That takes half of the time or less, while programs run about four times as slow.
    """
    light = node.get_closest_marker("light_compilation") is not None
    jax.config.update("jax_disable_most_optimizations", light)


@pytest.fixture(scope="module", autouse=True)
def begin_small(request):
    """Each file begins without the programs and scenes of the one before: few files share any."""
    compile_as_marked(request.node)
    yield
    forget_what_was_compiled()


@pytest.fixture(autouse=True)
def stay_small(request):
    """A worker stays below what a laptop has; the programs come back from the cache on disk."""
    compile_as_marked(request.node)
    yield
    statm = Path("/proc/self/statm")
    if statm.exists() and int(statm.read_text().split()[1]) * resource.getpagesize() > LARGE:
        forget_what_was_compiled()


@pytest.fixture(scope="session")
def panda():
    return vrrt_jax.load_robot("panda")


@pytest.fixture(scope="session")
def wall_world(panda):
    """Something of every kind, with a wall between the two sides of the robot."""
    obstacles = [
        vrrt_jax.Obstacle(name="floor", kind="plane", position=(0, 0, -0.01), size=(1, 1, 0.1)),
        vrrt_jax.Obstacle(
            name="wall", kind="box", position=(0.45, 0.0, 0.4), size=(0.25, 0.02, 0.4)
        ),
        vrrt_jax.Obstacle(name="ball", kind="sphere", position=(-0.4, 0.3, 0.6), size=(0.1, 0, 0)),
        vrrt_jax.Obstacle(
            name="post", kind="cylinder", position=(-0.2, -0.5, 0.4), size=(0.05, 0.4, 0)
        ),
        vrrt_jax.Obstacle(
            name="pipe",
            kind="capsule",
            position=(0.0, 0.45, 0.9),
            quaternion=(0.7071, 0.7071, 0, 0),
            size=(0.04, 0.2, 0),
        ),
    ]
    return vrrt_jax.build_world(panda, obstacles, engine="closed_form")


@pytest.fixture(scope="session")
def free(wall_world):
    """A compiled ``(world, q (n, D)) -> (n,)``."""
    return jax.jit(jax.vmap(vrrt_jax.is_free, (None, 0)))


@pytest.fixture
def rng():
    return np.random.default_rng(0)
