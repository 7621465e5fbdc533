"""Robots: packaged ones, and any MJCF or URDF file with a fixed base."""

from vrrt_jax.robots.packaged import robot_names, scenes_dir
from vrrt_jax.robots.robot import Robot, load_robot

__all__ = ["Robot", "load_robot", "robot_names", "scenes_dir"]
