"""Train a robot's self-model on MuJoCo's images of its true meshes.

Poses are set kinematically and cameras are exact. Splats start on the visible surface, as depth
images see it, and are refined photometrically, one level of detail after the other. The last level
is for a close-up of the outermost link, a hand or a tool, whose turn a whole image hardly tells.
"""

import dataclasses
import hashlib
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
from scipy.cluster.vq import kmeans2
from tqdm import tqdm

from vrrt_jax.core.files import replacing
from vrrt_jax.robots.kinematics import body_links, link_poses
from vrrt_jax.robots.mesh_sources import mesh_file
from vrrt_jax.robots.robot import workspace
from vrrt_jax.scene.world import batch_is_free, build_world
from vrrt_jax.splat.camera import cut, orbit, project, shrunk, stack_cameras
from vrrt_jax.splat.loss import image_loss, psnr_db
from vrrt_jax.splat.model import Level, SelfModel, save_self_model
from vrrt_jax.splat.mujoco_images import MeshRenderer
from vrrt_jax.splat.raster import render
from vrrt_jax.splat.types import Camera, SplatModel, layer_starts


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelConfig:
    """How one level of detail is trained."""

    num_splats: int
    size_px: int  # image height and width
    steps: int
    batch: int  # images a step


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How a self-model is trained."""

    num_images: int = 400
    num_surface_images: int = 150  # of them, those with depth, to place the splats
    num_validation: int = 60
    image_px: int = 256
    fovy_deg: tuple[float, float] = (40.0, 55.0)
    elevation_deg: tuple[float, float] = (-75.0, 5.0)
    # in radii of the robot's workspace, whose center the cameras look at
    distance: tuple[float, float] = (1.5, 2.6)
    target_spread: float = 0.15
    learning_rate: float = 0.1
    detail: float = 1.0  # times the splats of all levels but the close-up; large robots need more
    levels: tuple[LevelConfig, ...] = (
        LevelConfig(num_splats=300, size_px=32, steps=1000, batch=8),
        LevelConfig(num_splats=600, size_px=64, steps=1500, batch=6),
        LevelConfig(num_splats=1500, size_px=128, steps=600, batch=4),
        LevelConfig(num_splats=5000, size_px=256, steps=300, batch=2),
    )
    # a part of an image of that height, around the outermost link, at most so far off its middle
    close_up: LevelConfig = LevelConfig(num_splats=2400, size_px=96, steps=1500, batch=4)
    close_up_of_px: int = 480
    close_up_off: float = 0.15  # of the part's height


@dataclasses.dataclass(frozen=True, kw_only=True)
class Images:
    """n training or validation images."""

    q: np.ndarray  # (n, D)
    cameras: Camera  # leading axis n
    rgb: np.ndarray  # (n, H, W, 3) float16
    alpha: np.ndarray  # (n, H, W) float16


def fit_self_model(robot, spec: mujoco.MjSpec, path: str | Path, *, seed: int, config: FitConfig):
    """Train a self-model and write it, level by level.

    What is finished lies beside ``path`` as ``<path>.work/`` until the end, so that an interrupted
    training goes on where it was.

    Args:
        robot: from :func:`vrrt_jax.load_robot`.
        spec: the robot with its visual meshes.
        path: where the ``.npz`` goes.
        seed: of poses, cameras and training.
        config: sizes and numbers of steps.

    Returns:
        The self-model.

    Raises:
        RuntimeError: OpenGL is not available.
        ValueError: ``<path>.work/`` belongs to another robot, seed or configuration.
    """
    path, started = Path(path), time.perf_counter()
    work = path.with_name(path.name + ".work")
    _claim(work, robot, seed, config)
    images = train, _, points = _cached_images(robot, spec, config, work, seed, None)
    levels = []
    for level in config.levels:
        level = dataclasses.replace(level, num_splats=round(config.detail * level.num_splats))
        name = f"level_{len(levels)}"
        levels.append(_fit_level(robot, *images, level, name, config, work, seed))
    images = _cached_images(robot, spec, config, work, seed, outermost(points))
    close_up = _fit_level(robot, *images, config.close_up, "close_up", config, work, seed)
    model = SelfModel(
        robot=robot.name,
        joint_names=robot.joint_names,
        levels=tuple(levels),
        close_up=close_up,
        seed=seed,
        info={
            "num_images": config.num_images,
            "num_validation": config.num_validation,
            "seconds": round(time.perf_counter() - started, 1),
            "steps": [level.steps for level in (*config.levels, config.close_up)],
            "versions": {"jax": jax.__version__, "mujoco": mujoco.__version__},
        },
    )
    save_self_model(model, path)
    for file in work.iterdir():
        file.unlink()
    work.rmdir()
    return model


def _claim(work: Path, robot, seed: int, config: FitConfig) -> None:
    """Make the work folder ours, or see that it was already."""
    source = mesh_file(robot.mesh_source)
    what = robot.xml.encode() + (source.read_bytes() if source else b"")
    stamp = json.dumps(
        {
            "robot": robot.name,
            "content": hashlib.sha256(what).hexdigest(),
            "seed": seed,
            "config": dataclasses.asdict(config),
        },
        sort_keys=True,
    )
    work.mkdir(parents=True, exist_ok=True)
    file = work / "training.json"
    if file.exists() and file.read_text() != stamp:
        raise ValueError(
            f"'{work}' holds an unfinished training of another robot, seed or configuration; "
            "finish that one or delete the folder"
        )
    file.write_text(stamp)


def random_configurations(robot, num: int, rng: np.random.Generator) -> np.ndarray:
    """Configurations (num, D) inside the limits that do not touch themselves."""
    world = build_world(robot)
    found = np.zeros((0, len(robot.lower)))
    while len(found) < num:
        q = rng.uniform(robot.lower, robot.upper, (256, len(robot.lower)))
        free = np.asarray(batch_is_free(world, jnp.asarray(q, jnp.float32)))
        found = np.concatenate([found, q[free]])
    return found[:num]


def random_camera(
    config: FitConfig, center: np.ndarray, radius: float, px: int, rng: np.random.Generator
) -> Camera:
    """A camera around a robot whose workspace has a center (3,) and a radius [m]."""
    return orbit(
        azimuth_deg=rng.uniform(-180, 180),
        elevation_deg=rng.uniform(*config.elevation_deg),
        distance=radius * rng.uniform(*config.distance),
        target=(center + rng.normal(size=3) * radius * config.target_spread).tolist(),
        fovy_deg=rng.uniform(*config.fovy_deg),
        height=px,
        width=px,
    )


def outermost(points: np.ndarray) -> tuple[int, np.ndarray]:
    """The last link of surface points (m, 7), and their middle (3,) in its frame [m]."""
    link = points[:, 0].max()
    return int(link), points[points[:, 0] == link, 1:4].mean(axis=0)


def close_up_camera(
    robot, config: FitConfig, q: np.ndarray, camera: Camera, tip: tuple[int, np.ndarray], off
) -> Camera:
    """The part of a view around a point of a link, ``off`` (2,) heights away from its middle."""
    link, point = tip
    pose = np.asarray(link_poses(robot.chain, jnp.asarray(q, jnp.float32)))[link]
    pixel, _ = project(camera, pose[:3, :3] @ point + pose[:3, 3])
    px = config.close_up.size_px
    return cut(camera, np.round(np.asarray(pixel) + (off - 0.5) * px), px, px)


def render_images(
    robot,
    spec: mujoco.MjSpec,
    config: FitConfig,
    num: int,
    seed: int,
    num_surfaces: int = 0,
    tip: tuple[int, np.ndarray] | None = None,
) -> tuple[Images, np.ndarray]:
    """Render n images of random poses from random cameras; and surface points with colors.

    Args:
        robot: the robot.
        spec: with its visual meshes.
        config: sizes and ranges.
        num: n.
        seed: of poses and cameras.
        num_surfaces: images, of the n, that surface points are taken from.
        tip: a link and a point (3,) of it [m]: the images are close-ups of it.

    Returns:
        The images; points (m, 7): link, position in the link's frame [m], color.
    """
    renderer = MeshRenderer(spec)
    body_link = body_links(renderer.model)
    rng = np.random.default_rng(seed)
    q = random_configurations(robot, num, rng)
    center, radius = workspace(robot)
    px = config.image_px if tip is None else config.close_up_of_px
    cameras = [random_camera(config, center, radius, px, rng) for _ in range(num)]
    if tip is not None:
        off = rng.uniform(-config.close_up_off, config.close_up_off, (num, 2))
        cameras = [
            close_up_camera(robot, config, *each)
            for each in zip(q, cameras, [tip] * num, off, strict=True)
        ]
    rgb = np.zeros((num, cameras[0].height, cameras[0].width, 3), np.float16)
    alpha = np.zeros(rgb.shape[:3], np.float16)
    points = []
    for i in tqdm(range(num), desc="rendering", unit="image", leave=False):
        picture = renderer.picture(q[i], cameras[i])
        rgb[i], alpha[i] = picture.rgb, picture.alpha
        if i < num_surfaces:
            depth, geom = renderer.surface(q[i], cameras[i])
            link = np.where(geom >= 0, body_link[renderer.model.geom_bodyid[geom]], -1)
            inside = (link >= 0) & (picture.alpha > 0.999)
            points.append(
                _surface_points(robot, q[i], cameras[i], depth, link, inside, picture.rgb)
            )
    images = Images(q=q, cameras=stack_cameras(cameras), rgb=rgb, alpha=alpha)
    return images, np.concatenate(points) if points else np.zeros((0, 7), np.float32)


def _surface_points(robot, q, camera: Camera, depth, link, inside, rgb) -> np.ndarray:
    y, x = np.nonzero(inside)
    z = depth[y, x]
    center, focal = np.asarray(camera.principal_point), float(camera.focal)
    in_cam = np.stack([(x + 0.5 - center[0]) / focal * z, (y + 0.5 - center[1]) / focal * z, z], 1)
    cam_to_world = np.linalg.inv(np.asarray(camera.world_to_cam, np.float64))
    world = in_cam @ cam_to_world[:3, :3].T + cam_to_world[:3, 3]
    poses = np.asarray(link_poses(robot.chain, jnp.asarray(q, jnp.float32)), np.float64)
    pose = poses[link[y, x]]
    local = np.einsum("nji,nj->ni", pose[:, :3, :3], world - pose[:, :3, 3])
    return np.concatenate([link[y, x, None], local, rgb[y, x]], axis=1).astype(np.float32)


def _cached_images(
    robot, spec, config: FitConfig, work: Path, seed: int, tip
) -> tuple[Images, Images, np.ndarray]:
    """Images for training and for validation, and surface points; close-ups if there is a tip."""
    kind = "whole" if tip is None else "close_up"

    def cached(use: str, *numbers: int) -> tuple[Images, np.ndarray]:
        file = work / f"{kind}_{use}.npz"
        if not file.exists():
            _write_images(file, *render_images(robot, spec, config, *numbers, tip=tip))
        return _read_images(file)

    train, points = cached("train", config.num_images, seed, config.num_surface_images)
    held_out, _ = cached("held_out", config.num_validation, seed + 1)
    return train, held_out, points


def _write_images(file: Path, images: Images, points: np.ndarray) -> None:
    with replacing(file) as handle:
        np.savez(
            handle,
            q=images.q,
            rgb=images.rgb,
            coverage=images.alpha,
            points=points,
            world_to_cam=np.asarray(images.cameras.world_to_cam),
            focal=np.asarray(images.cameras.focal),
            principal_point=np.asarray(images.cameras.principal_point),
        )


def _read_images(file: Path) -> tuple[Images, np.ndarray]:
    with np.load(file) as saved:
        height, width = saved["coverage"].shape[1:]
        cameras = Camera(
            world_to_cam=jnp.asarray(saved["world_to_cam"]),
            focal=jnp.asarray(saved["focal"]),
            principal_point=jnp.asarray(saved["principal_point"]),
            height=height,
            width=width,
        )
        images = Images(q=saved["q"], cameras=cameras, rgb=saved["rgb"], alpha=saved["coverage"])
        return images, saved["points"]


def shrink(images: Images, size_px: int) -> Images:
    """The same images with fewer pixels, by area."""
    factor = images.rgb.shape[1] // size_px

    def blocks(array: np.ndarray) -> np.ndarray:
        n, h, w = array.shape[:3]
        cut = array.reshape(n, h // factor, factor, w // factor, factor, *array.shape[3:])
        return cut.astype(np.float32).mean(axis=(2, 4))

    return Images(
        q=images.q,
        cameras=shrunk(images.cameras, factor),
        rgb=blocks(images.rgb),
        alpha=blocks(images.alpha),
    )


def initial_splats(points: np.ndarray, num_splats: int, seed: int) -> SplatModel:
    """Cluster visible surface points (m, 7) into splats, link by link."""
    rng = np.random.default_rng(seed)
    links, counts = np.unique(points[:, 0].astype(int), return_counts=True)
    # The square root keeps small but telling links, such as fingers, from starving.
    shares = np.sqrt(counts)
    quota = np.maximum(8, np.floor(shares / shares.sum() * num_splats)).astype(int)
    quota = np.minimum(quota, counts)
    quota[np.argmax(quota)] += num_splats - quota.sum()
    mean, radius, rgb, link = [], [], [], []
    for index, num in zip(links, quota, strict=True):
        own = points[points[:, 0] == index]
        own = own[rng.permutation(len(own))[: max(60 * num, 2000)]]
        center, label = kmeans2(own[:, 1:4], num, iter=8, minit="points", rng=rng)
        apart = np.linalg.norm(own[:, 1:4] - center[label], axis=1)
        for k in range(num):
            members = label == k
            mean.append(center[k])
            rgb.append(own[members, 4:].mean(0) if members.any() else own[:, 4:].mean(0))
            radius.append(np.sqrt((apart[members] ** 2).mean()) if members.sum() > 2 else 0.01)
        link += [index] * num
    radius = np.clip(radius, 0.002, 0.05)
    return SplatModel(
        starts=layer_starts(np.array(link)),
        mean=jnp.asarray(mean, jnp.float32),
        radius=jnp.asarray(radius, jnp.float32),
        density=jnp.full(num_splats, 3.0, jnp.float32),
        rgb=jnp.asarray(rgb, jnp.float32),
        view_color_gradient=jnp.zeros((num_splats, 3)),
        link=jnp.asarray(link, jnp.int32),
        tau=jnp.float32(0.04),
    )


def _assemble(start: SplatModel, change: dict[str, jax.Array]) -> SplatModel:
    """Splats from unconstrained changes, scaled so that one learning rate suits all."""
    return dataclasses.replace(
        start,
        mean=start.mean + 0.02 * change["mean"],
        radius=start.radius * jnp.exp(0.5 * change["radius"]),
        density=start.density * jnp.exp(change["density"]),
        rgb=start.rgb + 0.5 * change["rgb"],
        view_color_gradient=start.view_color_gradient + 0.5 * change["view_color_gradient"],
        tau=0.03 + (start.tau - 0.03) * jnp.exp(change["tau"]),
    )


def _fit_level(
    robot,
    train: Images,
    held_out: Images,
    points: np.ndarray,
    level: LevelConfig,
    name: str,
    config: FitConfig,
    work: Path,
    seed: int,
) -> Level:
    file = work / f"{name}.npz"
    train, held_out = shrink(train, level.size_px), shrink(held_out, level.size_px)
    start = initial_splats(points, level.num_splats, seed)
    change = {
        name: jnp.zeros_like(getattr(start, name))
        for name in ("mean", "radius", "density", "rgb", "view_color_gradient", "tau")
    }
    schedule = optax.cosine_decay_schedule(config.learning_rate, level.steps, 0.02)
    optimizer = optax.adam(schedule, b1=0.9, b2=0.99)
    state = optimizer.init(change)

    def loss(change, q, camera, rgb, alpha):
        image = render(_assemble(start, change), link_poses(robot.chain, q), camera)
        return image_loss(*image, rgb, alpha, jnp.ones_like(alpha))

    @jax.jit
    def step(change, state, *batch):
        def add(total, example):
            value, gradient = jax.value_and_grad(loss)(change, *example)
            return jax.tree.map(jnp.add, total, (value, gradient)), None

        zero = (jnp.float32(0), jax.tree.map(jnp.zeros_like, change))
        (value, gradient), _ = jax.lax.scan(add, zero, batch)
        gradient = jax.tree.map(lambda g: g / level.batch, gradient)
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(change, updates), state, value / level.batch

    rng = np.random.default_rng(seed)
    order = rng.permuted(np.tile(np.arange(len(train.q)), (level.steps, 1)), axis=1)
    first = 0
    if file.exists():
        change, state, first = _restore(file, change, state)
    progress = tqdm(
        range(first, level.steps),
        desc=f"{level.num_splats} splats, {level.size_px} px",
        initial=first,
        total=level.steps,
        unit="step",
    )
    for i in progress:
        rows = order[i, : level.batch]
        batch = (
            jnp.asarray(train.q[rows], jnp.float32),
            jax.tree.map(lambda leaf: leaf[rows], train.cameras),  # noqa: B023 - used at once
            jnp.asarray(train.rgb[rows]),
            jnp.asarray(train.alpha[rows]),
        )
        change, state, value = step(change, state, *batch)
        if i % 50 == 49:
            progress.set_postfix_str(f"{psnr_db(float(value)):.1f} dB")
            _store(file, change, state, i + 1)
    splats = jax.tree.map(jax.lax.stop_gradient, _assemble(start, change))
    losses, covered = validate(robot, splats, held_out)
    return Level(
        splats=splats,
        size_px=level.size_px,
        psnr_db=round(psnr_db(float(losses.mean())), 2),
        match_threshold=float(f"{np.quantile(losses / covered, 0.95):.4g}"),
    )


def validate(robot, splats: SplatModel, images: Images) -> tuple[np.ndarray, np.ndarray]:
    """Losses (n,) at the true poses, and covered shares (n,) of the images."""

    @jax.jit
    def loss(q, camera, rgb, alpha):
        image = render(splats, link_poses(robot.chain, q), camera)
        return image_loss(*image, rgb, alpha, jnp.ones_like(alpha))

    losses = [
        float(
            loss(
                jnp.asarray(images.q[i], jnp.float32),
                jax.tree.map(lambda leaf: leaf[i], images.cameras),  # noqa: B023 - used at once
                jnp.asarray(images.rgb[i], jnp.float32),
                jnp.asarray(images.alpha[i], jnp.float32),
            )
        )
        for i in range(len(images.q))
    ]
    covered = images.alpha.reshape(len(losses), -1).astype(np.float32).mean(axis=1)
    return np.array(losses), np.maximum(covered, 1e-3)


def _store(file: Path, change, state, steps: int) -> None:
    leaves: list[Any] = [np.asarray(leaf) for leaf in jax.tree.leaves((change, state))]
    with replacing(file) as handle:
        np.savez(handle, steps=steps, **{f"leaf_{i}": leaf for i, leaf in enumerate(leaves)})


def _restore(file: Path, change, state):
    structure = jax.tree.structure((change, state))
    with np.load(file) as saved:
        leaves = [jnp.asarray(saved[f"leaf_{i}"]) for i in range(structure.num_leaves)]
        change, state = jax.tree.unflatten(structure, leaves)
        return change, state, int(saved["steps"])
