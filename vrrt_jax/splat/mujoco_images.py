"""Images from MuJoCo's own renderer and a robot's true meshes; no screen is needed."""

import atexit
import contextlib
import dataclasses
import threading
import weakref
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from vrrt_jax.scene.held import HeldObject
from vrrt_jax.scene.obstacle_kinds import KINDS
from vrrt_jax.scene.obstacles import Obstacle
from vrrt_jax.splat.types import Camera

SUPERSAMPLING = 2  # rendered pixels per pixel and axis; the mean of a block is a pixel
MAX_RENDER_PX = 1024  # larger buffers are slow and some drivers refuse them
VISUAL_GROUPS = (0, 1, 2)
OBSTACLE_GROUP = 5

_Renderers = dict[tuple[int, int], mujoco.Renderer]  # by height and width [px]
_orphans: list[tuple[_Renderers, threading.Thread]] = []  # not needed any more, and their threads
_exiting = threading.Event()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Picture:
    """One rendered view."""

    rgb: np.ndarray  # (H, W, 3) float32, the robot over black
    alpha: np.ndarray  # (H, W) float32, share of the pixel that the robot covers
    valid: np.ndarray  # (H, W) bool, False where an obstacle may hide the robot


class _Own(threading.local):
    """What each thread that draws has for itself: OpenGL is bound to the thread that made it."""

    def __init__(self, model: mujoco.MjModel):
        self.data = mujoco.MjData(model)
        self.option = mujoco.MjvOption()
        self.option.geomgroup[:] = 0
        for group in VISUAL_GROUPS:
            self.option.geomgroup[group] = 1
        self.renderers: _Renderers = {}
        weakref.finalize(self.data, _close, self.renderers, threading.current_thread())


class MeshRenderer:
    """Renders a robot's meshes at given configurations with given cameras, in any thread.

    The only lamp sits on the camera, or shines from far away, with almost no highlights.

    Args:
        spec: the robot with its visual meshes; it is compiled here.
        obstacles: drawn by :meth:`scene`; in :meth:`picture` they only hide the robot.
        attached: what the robot holds, drawn likewise.
        shines: (3,) direction in the world of a lamp far away. Without it the lamp is on the
            camera, as in training.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        obstacles: Sequence[Obstacle] = (),
        attached: Sequence[HeldObject] = (),
        *,
        shines: Sequence[float] | None = None,
    ):
        """Compile the model; raises RuntimeError if OpenGL is not available."""
        spec = spec.copy()
        standing = [(spec.worldbody, obstacle) for obstacle in obstacles]
        carried = [(spec.body(held.body), held.obstacle) for held in attached]
        for body, obstacle in standing + carried:
            body.add_geom(
                name=f"obstacle {obstacle.name}",
                type=KINDS[obstacle.kind].geom,
                pos=obstacle.position,
                quat=obstacle.quaternion,
                size=KINDS[obstacle.kind].geom_size(obstacle.size),
                rgba=obstacle.rgba,
                group=OBSTACLE_GROUP,
            )
        _place_lamp(spec, shines)
        spec.visual.quality.shadowsize = 0
        spec.visual.quality.offsamples = 0
        spec.visual.global_.offwidth = spec.visual.global_.offheight = MAX_RENDER_PX
        self.model = spec.compile()
        self._own = _Own(self.model)

    def check(self) -> None:
        """Raise a RuntimeError if OpenGL is not available."""
        self._renderer((8, 8))

    def picture(self, q: np.ndarray, camera: Camera) -> Picture:
        """The robot alone over black, with its exact alpha; obstacles only hide it.

        Args:
            q: (D,) configuration [rad] or [m].
            camera: the view; its size is the image's.

        Raises:
            ValueError: the image is too large.
            RuntimeError: OpenGL is not available.
        """
        scale = max(1, min(SUPERSAMPLING, MAX_RENDER_PX // max(camera.height, camera.width)))
        with self._drawing_obstacles():
            renderer = self._aim(q, camera, scale)
            rgb = renderer.render().astype(np.float32) / 255.0
            renderer.enable_segmentation_rendering()
            segments = renderer.render()
            renderer.disable_segmentation_rendering()
        # Group of the geom that each pixel shows; -1 for the background.
        is_geom = segments[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
        group = np.append(self.model.geom_group, -1)[np.where(is_geom, segments[..., 0], -1)]
        mask = is_geom & (group != OBSTACLE_GROUP)
        return Picture(
            rgb=_block_mean(rgb * mask[..., None], scale),
            alpha=_block_mean(mask.astype(np.float32), scale),
            valid=_block_mean((group != OBSTACLE_GROUP).astype(np.float32), scale) > 0.999,
        )

    def surface(self, q: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Depths and geoms of the robot's surface, one sample a pixel.

        Args:
            q: (D,) configuration [rad] or [m].
            camera: the view.

        Returns:
            Depth (H, W) along the optical axis [m], and geom (H, W), -1 for none.
        """
        renderer = self._aim(q, camera, 1)
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        segments = renderer.render()
        renderer.disable_segmentation_rendering()
        is_geom = segments[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
        return depth, np.where(is_geom, segments[..., 0], -1)

    def scene(self, q: np.ndarray, camera: Camera) -> np.ndarray:
        """Robot and obstacles, for people: (H, W, 3) uint8."""
        scale = max(1, min(SUPERSAMPLING, MAX_RENDER_PX // max(camera.height, camera.width)))
        with self._drawing_obstacles():
            renderer = self._aim(q, camera, scale)
            image = renderer.render().astype(np.float32)
            renderer.enable_segmentation_rendering()
            image[renderer.render()[..., 0] < 0] = 250.0
            renderer.disable_segmentation_rendering()
        return _block_mean(image, scale).astype(np.uint8)

    @contextlib.contextmanager
    def _drawing_obstacles(self) -> Iterator[None]:
        self._own.option.geomgroup[OBSTACLE_GROUP] = 1
        try:
            yield
        finally:
            self._own.option.geomgroup[OBSTACLE_GROUP] = 0

    def _aim(self, q: np.ndarray, camera: Camera, scale: int) -> mujoco.Renderer:
        """A renderer with the robot posed and the camera placed, ``scale`` pixels per pixel."""
        renderer = self._renderer((camera.height * scale, camera.width * scale))
        data = self._own.data
        data.qpos[:] = q
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)
        renderer.update_scene(data, scene_option=self._own.option)
        _set_camera(renderer.scene, camera, self.model)
        return renderer

    def _renderer(self, size: tuple[int, int]) -> mujoco.Renderer:
        """The renderer for images of a height and a width [px], made when first needed."""
        height, width = size
        if max(size) > MAX_RENDER_PX:
            raise ValueError(
                f"an image of {width}x{height} px is too large to be drawn; expected at most "
                f"{MAX_RENDER_PX} px on a side"
            )
        renderers = self._own.renderers
        if size not in renderers:
            _close_orphans()
            try:
                renderers[size] = mujoco.Renderer(self.model, *size)
            except (ImportError, RuntimeError, mujoco.FatalError) as error:
                raise RuntimeError(
                    "OpenGL is not available for rendering meshes "
                    f"({error}); install libosmesa6 (or libegl1 and libgl1), or set MUJOCO_GL"
                ) from None
        return renderers[size]


def _place_lamp(spec: mujoco.MjSpec, shines: Sequence[float] | None) -> None:
    """Give the scene its only lamp; what comes from everywhere is the same for both kinds."""
    headlight = spec.visual.headlight
    ambient, diffuse, specular = [0.35] * 3, [0.6] * 3, [0.02] * 3
    headlight.ambient, headlight.diffuse, headlight.specular = ambient, diffuse, specular
    if shines is None:
        return
    headlight.diffuse, headlight.specular = [0.0] * 3, [0.0] * 3
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=list(shines),
        ambient=[0.0] * 3,
        diffuse=diffuse,
        specular=specular,
        castshadow=False,
    )


def _close(renderers: _Renderers, thread: threading.Thread) -> None:
    """Close a thread's renderers: at once, or when that thread draws next, as it has them bound."""
    is_elsewhere = thread is not threading.current_thread() and thread.is_alive()
    if is_elsewhere and not _exiting.is_set():
        _orphans.append((renderers, thread))
        return
    for renderer in renderers.values():
        renderer.close()


def _close_orphans() -> None:
    for orphan in [_orphans.pop() for _ in range(len(_orphans))]:
        _close(*orphan)


@atexit.register
def _close_at_exit() -> None:
    """Close all, while OpenGL still works."""
    _exiting.set()
    _close_orphans()


def _set_camera(scene: mujoco.MjvScene, camera: Camera, model: mujoco.MjModel) -> None:
    """Give the scene our camera with its pose, focal length and principal point."""
    world_to_cam = np.asarray(camera.world_to_cam, np.float64)
    rotation = world_to_cam[:3, :3]
    eye = -rotation.T @ world_to_cam[:3, 3]
    focal, (cx, cy) = float(camera.focal), np.asarray(camera.principal_point, np.float64)
    # MuJoCo turns its depth buffer into meters with these planes, so they must stay as they are.
    near = model.vis.map.znear * model.stat.extent
    far = model.vis.map.zfar * model.stat.extent
    for view in scene.camera:
        view.pos, view.forward, view.up = eye, rotation[2], -rotation[1]
        view.frustum_near, view.frustum_far = near, far
        view.frustum_top = near * cy / focal
        view.frustum_bottom = near * (cy - camera.height) / focal
        view.frustum_center = near * (camera.width / 2 - cx) / (focal * camera.aspect)
        view.frustum_width = near * camera.width / 2 / (focal * camera.aspect)
    for light in scene.lights[: scene.nlight]:
        if light.headlight:
            light.pos, light.dir = eye, rotation[2]


def _block_mean(image: np.ndarray, scale: int) -> np.ndarray:
    height, width = image.shape[0] // scale, image.shape[1] // scale
    blocks = image.reshape(height, scale, width, scale, *image.shape[2:])
    return blocks.mean(axis=(1, 3)).astype(np.float32)
