"""Choose MuJoCo's OpenGL backend before MuJoCo is imported."""

import ctypes.util
import os
import sys


def choose_backend() -> None:
    """On Linux without a display, render in memory if a library for that is installed.

    MuJoCo reads ``MUJOCO_GL`` once, when it is imported, and dies there if the library is missing;
    so the variable is set only to what exists, and never changed if the user has set it.
    """
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ or "DISPLAY" in os.environ:
        return
    if ctypes.util.find_library("OSMesa"):
        os.environ["MUJOCO_GL"] = "osmesa"
    elif ctypes.util.find_library("EGL") and ctypes.util.find_library("GL"):
        os.environ["MUJOCO_GL"] = "egl"
