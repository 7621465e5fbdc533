"""Obstacles on a page in the browser, which one can drag and turn."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from vrrt_jax.scene.body_meshes import obstacle_mesh
from vrrt_jax.scene.obstacles import Obstacle, floats
from vrrt_jax.scene.page import Page

_HANDLE_M = 0.25  # length of the arrows that an obstacle is dragged by


class MovableObstacles:
    """Obstacles on a page, and a box to tick that shows handles to drag them by.

    Args:
        page: to show them on.
        obstacles: whose names differ.
        movable: whether there are handles.
    """

    def __init__(self, page: Page, obstacles: Sequence[Obstacle], movable: bool):
        """Show them where they stand."""
        self._obstacles = {obstacle.name: obstacle for obstacle in obstacles}
        self._meshes, handles = {}, []
        for name, obstacle in self._obstacles.items():
            place = {"position": obstacle.position, "wxyz": obstacle.quaternion}
            mesh = obstacle_mesh(obstacle)
            self._meshes[name] = page.scene.add_mesh_trimesh(f"/obstacles/{name}", mesh, **place)
            if movable:
                handle = page.scene.add_transform_controls(
                    f"/handles/{name}", _HANDLE_M, visible=False, **place
                )
                handle.on_update(
                    lambda event, name=name: self.move(
                        name, event.target.position, event.target.wxyz
                    )
                )
                handles.append(handle)
        if handles:
            box = page.gui.add_checkbox("drag obstacles", False)

            @box.on_update
            def _(_: object) -> None:
                for handle in handles:
                    handle.visible = box.value

    @property
    def obstacles(self) -> list[Obstacle]:
        """The obstacles where they stand now."""
        return list(self._obstacles.values())

    def move(self, name: str, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Put an obstacle somewhere else, by its position (3,) [m] and quaternion (4,), w first."""
        self._obstacles[name] = dataclasses.replace(
            self._obstacles[name], position=floats(position), quaternion=floats(quaternion)
        )
        mesh = self._meshes[name]
        mesh.position, mesh.wxyz = position, quaternion
