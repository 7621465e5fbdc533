"""A scene in the browser: bodies that move along a path, lines, pictures and numbers.

The page is served by viser, to this machine alone.
"""

import contextlib
import html
import socket
import threading
from collections.abc import Callable, Collection, Mapping
from typing import Any

import mujoco
import numpy as np

from vrrt_jax.scene.body_meshes import body_mesh

HOST = "127.0.0.1"
FRAMES_PER_S = 30
# Colors of a value from the lowest, which is the best, to the highest, which hides nothing.
_SCALE = np.array([[0, 110, 60], [0, 130, 160], [150, 185, 220], [225, 228, 238]])
_TABLE = "table"
_TABLE_STYLE = "font-size:0.8em;line-height:1.35;padding:0 0.8em;overflow-wrap:anywhere"


class Page:
    """A page in the browser at :attr:`url`; in a notebook it shows itself.

    Args:
        title: of the page.
        port: of 127.0.0.1; a free one if None.

    Raises:
        ModuleNotFoundError: viser is not installed.
        OSError: the port is taken.
    """

    def __init__(self, title: str, port: int | None = None):
        """Start to serve an empty page."""
        try:
            import viser
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                "the page needs viser, which is missing; pip install 'vrrt-jax[view]'"
            ) from None
        self._server = viser.ViserServer(HOST, _checked_port(port), label=title, verbose=False)
        self._server.scene.set_up_direction("+z")
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._closed, self._playing = threading.Event(), threading.Event()
        self._shown: dict[str, Any] = {}  # lines, pictures and the table, by name
        self._boxes: dict[str, Any] = {}  # that hide lines
        self._model: mujoco.MjModel | None = None
        self.moving: dict[int, Any] = {}  # bodies that move, by number in the model
        self._poses: Any = None  # (T, nbody, 3) and (T, nbody, 4) along the path
        self._play: Any = None  # the button
        self.slider: Any = None  # along the path, once there is a robot
        self.buttons: dict[str, Callable[[], None]] = {}  # what they do, by label
        self.obstacles: Any = None  # see ``movable.MovableObstacles``

    @property
    def host(self) -> str:
        """The address that is listened at."""
        return self._server.get_host()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.host}:{self._server.get_port()}"

    @property
    def scene(self) -> Any:
        """The scene of viser, to add things to."""
        return self._server.scene

    @property
    def gui(self) -> Any:
        """The panel of viser, to add boxes and buttons to."""
        return self._server.gui

    def look_from(self, eye: np.ndarray, target: np.ndarray, fovy: float = 0.8) -> None:
        """Look from a place (3,) to another [m] at first, with a vertical field of view [rad]."""
        camera = self._server.initial_camera
        camera.up, camera.fov = (0.0, 0.0, 1.0), fovy
        camera.position, camera.look_at = tuple(map(float, eye)), tuple(map(float, target))

    def add_robot(self, model: mujoco.MjModel, groups: Collection[int]) -> None:
        """Add a robot, with what is fixed to its world.

        Args:
            model: a compiled model.
            groups: of the geoms that are drawn.
        """
        self._model = model
        for body in range(model.nbody):
            mesh = body_mesh(model, body, groups)
            if mesh is None:
                continue
            handle = self.scene.add_mesh_trimesh(f"/bodies/{body}", mesh)
            if body:  # the world's stands still
                self.moving[body] = handle
        self._add_player()

    def show_trajectory(self, trajectory: np.ndarray) -> None:
        """Let the robot of :meth:`add_robot` go along a path, by a slider and a button.

        Args:
            trajectory: (T, D) configurations, a picture each [rad] or [m]; it takes the place of
                the one before.
        """
        self._playing.clear()
        self._poses = _body_poses(self._model, trajectory)
        slider, last = self.slider, len(trajectory) - 1
        slider.max, slider.disabled, slider.value = max(last, 1), not last, 0
        self._play.disabled = not last
        self._pose(0)

    def _pose(self, step: int) -> None:
        position, quaternion = self._poses
        step = min(step, len(position) - 1)
        with self._server.atomic():
            for body, handle in self.moving.items():
                handle.position, handle.wxyz = position[step, body], quaternion[step, body]

    def _add_player(self) -> None:
        """A slider along the path, and a button that plays it."""
        slider = self.slider = self.gui.add_slider("along the path", 0, 1, 1, 0)
        self._play = button = self.gui.add_button("play")
        slider.on_update(lambda _: self._pose(int(slider.value)))

        @button.on_click
        def _(_: Any) -> None:
            if self._playing.is_set():
                self._playing.clear()
                return
            if slider.value >= slider.max:
                slider.value = 0
            self._playing.set()

        def play() -> None:
            while not self._closed.wait(1 / FRAMES_PER_S):
                if not self._playing.is_set():
                    continue
                slider.value = min(int(slider.value) + 1, slider.max)
                if slider.value >= slider.max:
                    self._playing.clear()

        threading.Thread(target=play, daemon=True).start()

    def add_mesh(
        self, name: str, vertices: np.ndarray, faces: np.ndarray, color: tuple[int, int, int]
    ) -> None:
        """Add something that stands still: vertices (n, 3) [m], faces (m, 3) int."""
        self.scene.add_mesh_simple(
            f"/{name}", vertices, faces, color=color, flat_shading=True, side="double"
        )

    def show_lines(self, name: str, lines: np.ndarray, colors: np.ndarray, width: float) -> None:
        """Show lines as one object, in place of those of that name, with a box that hides them.

        Args:
            name: what they are.
            lines: (E, P, 3) points of each line in the world [m].
            colors: (3,) or (E, 3) uint8.
            width: on the screen [px].
        """
        pieces = np.stack([lines[:, :-1], lines[:, 1:]], axis=2)  # (E, P - 1, 2, 3)
        each = np.broadcast_to(np.asarray(colors, np.uint8).reshape(-1, 1, 1, 3), pieces.shape)
        if name in self._shown:
            self._shown.pop(name).remove()
        if not pieces.size:
            return
        lines = self._shown[name] = self.scene.add_line_segments(
            f"/{name}",
            pieces.reshape(-1, 2, 3).astype(np.float32),
            each.reshape(-1, 2, 3),
            thickness=width,
            thickness_units="screen",
        )
        if name not in self._boxes:
            self._boxes[name] = self._add_box(name)
        lines.visible = self._boxes[name].value

    def _add_box(self, name: str) -> Any:
        """A box that hides the lines of a name, whichever are shown."""
        box = self.gui.add_checkbox(name, True)

        @box.on_update
        def _(_: Any) -> None:
            if name in self._shown:
                self._shown[name].visible = box.value

        return box

    def add_button(self, label: str, act: Callable[[Callable[[str], None]], None]) -> None:
        """Add a button that can be pressed again when it is done.

        Args:
            label: of the button.
            act: what it does; is given a function that shows another label meanwhile.
        """
        button = self.gui.add_button(label)

        def press(_: Any = None) -> None:
            button.disabled = True
            try:
                act(lambda text: setattr(button, "label", text))
            finally:
                button.disabled, button.label = False, label

        button.on_click(press)
        self.buttons[label] = press

    def show_picture(self, label: str, picture: np.ndarray) -> None:
        """Show a picture (H, W, 3) uint8, in place of the one of that label."""
        if label in self._shown:
            self._shown[label].image = picture
        else:
            self._shown[label] = self.gui.add_image(picture, label=label)

    def show_numbers(self, numbers: Mapping[str, Any]) -> None:
        """Show a table of names and values, in place of the one before."""
        rows = "".join(
            f'<tr><td style="white-space:nowrap">{html.escape(name)}</td>'
            f"<td><b>{html.escape(_words(value))}</b></td></tr>"
            for name, value in numbers.items()
        )
        content = f'<div style="{_TABLE_STYLE}"><table>{rows}</table></div>'
        if _TABLE in self._shown:
            self._shown[_TABLE].content = content
        else:
            self._shown[_TABLE] = self.gui.add_html(content)

    def serve(self) -> None:
        """Say where the page is, wait until Ctrl-C, then end the page."""
        print(f"open {self.url}; Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            self._closed.wait()
        self.close()

    def close(self) -> None:
        """End the page."""
        if not self._closed.is_set():
            self._closed.set()
            self._server.stop()

    def _repr_html_(self) -> str:
        """The page inside a notebook that runs on this machine."""
        return f'<iframe src="{self.url}" width="100%" height="600" frameborder="0"></iframe>'


def colors_of(values: np.ndarray) -> np.ndarray:
    """Colors (n, 3) uint8 of values (n,), from strong for the lowest to pale for the highest.

    Values that are not finite are pale.
    """
    finite = np.isfinite(values)
    low, high = (values[finite].min(), values[finite].max()) if finite.any() else (0.0, 1.0)
    share = np.where(finite, (values - low) / max(high - low, 1e-12), 1.0)
    places = np.linspace(0, 1, len(_SCALE))
    channels = [np.interp(share, places, channel) for channel in _SCALE.T]
    return np.stack(channels, axis=1).astype(np.uint8)


def _checked_port(port: int | None) -> int:
    """The port, or a free one; viser would silently take another one than it is told.

    Raises:
        OSError: it is taken.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port or 0))
        except OSError as error:
            raise OSError(
                f"cannot serve at {HOST}:{port}: {error.strerror}; give another --port, or none "
                "for one that is free"
            ) from None
        return probe.getsockname()[1]


def _body_poses(model: mujoco.MjModel, trajectory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, nbody, 3) [m] and quaternions (T, nbody, 4) of all bodies along a path."""
    data, poses = mujoco.MjData(model), []
    for q in trajectory:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        poses.append((data.xpos.copy(), data.xquat.copy()))
    position, quaternion = zip(*poses, strict=True)
    return np.stack(position), np.stack(quaternion)


def _words(value: Any) -> str:
    """A value as people read it."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_words(each)}" for name, each in value.items())
    return str(value)
