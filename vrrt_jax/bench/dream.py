"""Joint angles from photographs in the DREAM format: the paper's table of errors by joint."""

import bisect
import dataclasses
import functools
import time
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from vrrt_jax import planner
from vrrt_jax.bench import dream_data
from vrrt_jax.bench.arm import evenly
from vrrt_jax.bench.dream_data import Frame
from vrrt_jax.bench.dream_table import summarize
from vrrt_jax.bench.tasks import bench_robot, bench_world, level_name
from vrrt_jax.config import PlannerConfig
from vrrt_jax.core.data_file import of_file, read_fields
from vrrt_jax.core.interrupt import uninterrupted
from vrrt_jax.core.results_file import fingerprint, plain, resume, write
from vrrt_jax.core.timing import machine, versions
from vrrt_jax.core.workers import in_workers
from vrrt_jax.problems import self_model_path
from vrrt_jax.robots.kinematics import link_poses
from vrrt_jax.robots.robot import Robot
from vrrt_jax.scene.world import World, batch_is_free, pose_error
from vrrt_jax.splat.camera import project
from vrrt_jax.splat.extrinsics import world_to_camera
from vrrt_jax.splat.foreground import robot_before_background, robot_in_box
from vrrt_jax.splat.model import SelfModel, load_self_model
from vrrt_jax.splat.picture_file import read_image
from vrrt_jax.splat.pixels import valid_mask
from vrrt_jax.splat.types import Camera
from vrrt_jax.visual.goal import ImageGoal

FORMAT = 1
MASKS = ("file", "background", "box", "plain")
BOX_RIM_PX = 8  # around the robot's spheres at the true pose
MOST_DRAWS = 2000  # of starts


@dataclasses.dataclass(frozen=True, kw_only=True)
class DreamBenchmark:
    """Everything that decides the numbers."""

    folder: str
    robot: str = "panda"
    levels: tuple[float, ...] = (1.0,)  # distances of the start from the true joints [rad]
    limit: int | None = None  # frames, evenly taken; all if None
    mask: str = "file"  # one of MASKS
    background: str | None = None  # the picture without the robot, for the mask "background"
    extrinsics: str | None = None  # a file of the camera's pose; by PnP from keypoints if None
    engine: str = "mjx"
    seed: int = 0
    config: PlannerConfig = PlannerConfig()

    @property
    def frames(self) -> list[str]:
        """The frames that are looked at."""
        names = dream_data.frame_names(self.folder)
        return [names[index] for index in evenly(len(names), self.limit)]

    def header(self) -> dict[str, Any]:
        """What a results file must agree on, to be gone on with."""
        files = {"background": self.background, "extrinsics": self.extrinsics}
        return plain(
            {
                "format": FORMAT,
                "what": "dream",
                **{name: getattr(self, name) for name in ("robot", "mask", "engine", "seed")},
                "camera": fingerprint(Path(self.folder) / dream_data.SETTINGS),
                **{name: file and fingerprint(Path(file)) for name, file in files.items()},
                "config": dataclasses.asdict(self.config),
                "versions": versions(),
                "self_model": fingerprint(self_model_path(bench_robot(self.robot))),
            }
        )


def run(
    benchmark: DreamBenchmark,
    file: str | Path | None,
    *,
    jobs: int = 1,
    cluster: str | None = None,
) -> dict[str, Any]:
    """Run what is not in the file yet, and write every frame at once.

    Args:
        benchmark: what to run; more frames or levels than the file has are added to it.
        file: JSON for the results, None to keep them in memory.
        jobs: processes.
        cluster: address of a Ray cluster, instead of processes.

    Returns:
        What the file holds: the header, ``machine``, ``rows``, and ``levels`` with what is told of
        each. Frames that cannot be read have a row that says why.

    Raises:
        FileNotFoundError: there are no frames, or no masks where they are asked for.
        ModuleNotFoundError: OpenCV is needed, and not installed.
        ValueError: an option makes no sense, or the file holds another benchmark.
        OSError: the file cannot be written; what it held stays.
    """
    _check(benchmark)
    results = {**benchmark.header(), "machine": machine(), "rows": []}
    if file is not None:
        results = resume(Path(file), benchmark.header(), results)
    # What was refused is tried again: its files may have been mended.
    results["rows"] = [row for row in results["rows"] if "refused" not in row]
    _check_done(benchmark.folder, results["rows"])
    results["rows"].sort(key=_key)  # and so they stay, whatever comes first
    done = {_key(row) for row in results["rows"]}
    todo = [
        (name, level)
        for name in benchmark.frames
        for level in benchmark.levels
        if (name, level) not in done
    ]
    with tqdm(total=len(todo), unit="frame", disable=None) as bar:
        for row in in_workers(partial(_run_frame, benchmark), todo, jobs, cluster):
            bisect.insort(results["rows"], row, key=_key)
            results["levels"] = summarize(results["rows"])
            if file is not None:
                write(Path(file), results)
            bar.update()
    results["levels"] = summarize(results["rows"])
    return results


def _key(row: dict[str, Any]) -> tuple[str, float]:
    return row["frame"], row["level"]


def _check_done(folder: str, rows: list[dict[str, Any]]) -> None:
    """Raise a ValueError for a row whose frame has changed since."""
    for name, old in {row["frame"]: row["fingerprint"] for row in rows}.items():
        if dream_data.frame_fingerprint(folder, name) != old:
            raise ValueError(
                f"frame {name} has changed since it was run: results of different files are not "
                "mixed; choose another --json"
            )


def _check(benchmark: DreamBenchmark) -> None:
    """Tell what is wrong before any work."""
    robot = bench_robot(benchmark.robot)
    dream_data.load_intrinsics(benchmark.folder)
    if benchmark.mask not in MASKS:
        raise ValueError(f"unknown mask '{benchmark.mask}'; have: {', '.join(MASKS)}")
    if (benchmark.mask == "background") != (benchmark.background is not None):
        raise ValueError("--mask background and --background FILE belong together; give both")
    if not benchmark.levels or not all(0 < level < np.pi for level in benchmark.levels):
        raise ValueError(f"got levels {list(benchmark.levels)}; expected distances below pi [rad]")
    bench_world(benchmark.robot, "", benchmark.engine)  # a name of an engine that is unknown
    if benchmark.extrinsics is not None:
        with of_file(benchmark.extrinsics):
            world_to_camera(_pose_fields(benchmark.extrinsics))
    if benchmark.mask == "file":
        folder = Path(benchmark.folder)
        bare = [f for f in benchmark.frames if not (folder / (f + dream_data.MASK)).is_file()]
        if bare:
            raise FileNotFoundError(
                f"{len(bare)} frames have no mask beside them, the first is "
                f"{bare[0]}{dream_data.MASK}; make pictures that are white on '{robot.name}', or "
                "take another --mask: background, box or plain"
            )


def _pose_fields(file: str) -> Mapping[str, Any]:
    fields = read_fields(file)
    if not isinstance(fields, Mapping):
        raise ValueError(f"'{file}' holds no fields; expected camera_to_world or world_to_camera")
    return fields


def _run_frame(benchmark: DreamBenchmark, item: tuple[str, float]) -> dict[str, Any]:
    """A row: what was found, or why the frame cannot be read."""
    name, level = item
    row: dict[str, Any] = {"frame": name, "level": level}
    try:
        frame = dream_data.load_frame(benchmark.folder, name, bench_robot(benchmark.robot))
        matrix, size = dream_data.load_intrinsics(benchmark.folder)
        if benchmark.extrinsics is None:
            pose, off_px = dream_data.solve_pose(frame, bench_robot(benchmark.robot), matrix, size)
        else:
            pose, off_px = world_to_camera(_pose_fields(benchmark.extrinsics)), None
        camera = dream_data.pinhole(matrix, size, pose)
        image = _goal_image(benchmark, frame, camera)
        goal = ImageGoal(_self_model(benchmark.robot), camera, image)
        goal.checked  # noqa: B018 - it raises for what is no goal
    except (ValueError, FileNotFoundError) as error:
        return {**row, "refused": " ".join(str(error).split())}
    with uninterrupted():
        found = _solve(benchmark, frame, goal, level)
    return {
        **row,
        "fingerprint": frame.fingerprint,
        "reprojection_px": None if off_px is None else round(off_px, 3),
        **found,
    }


def _solve(
    benchmark: DreamBenchmark, frame: Frame, goal: ImageGoal, level: float
) -> dict[str, Any]:
    """Plan to the photograph from a start at a distance from the true joints."""
    robot = bench_robot(benchmark.robot)
    world = bench_world(benchmark.robot, "", benchmark.engine)
    seed = zlib.crc32(f"{benchmark.seed} {level_name(level)} {frame.name}".encode())
    start = draw_start(robot, world, frame.q, level, np.random.default_rng(seed))
    began = time.perf_counter()
    result = planner.plan(
        robot, world, goal, start, key=jax.random.key(seed), config=benchmark.config
    )
    wall_s, times = time.perf_counter() - began, result.timing
    error = pose_error(world, result.target, frame.q)
    return {
        "error_rad": [round(float(value), 5) for value in error],
        "mean_error_rad": round(float(error.mean()), 5),
        "matched": bool(result.loss <= result.match_threshold),
        "status": result.status.name,
        "alternatives": len(result.alternatives),
        "loss_over_threshold": float(f"{result.loss / result.match_threshold:.4g}"),
        "time_s": round(times["search_s"] + times["shortcut_s"] + times["verify_s"], 3),
        "wall_s": round(wall_s, 2),
    }


def draw_start(
    robot: Robot, world: World, q: np.ndarray, level: float, rng: np.random.Generator
) -> np.ndarray:
    """A free configuration (D,) inside the limits, at a distance from another [rad].

    Raises:
        ValueError: there seems to be none.
    """
    steps = rng.normal(size=(MOST_DRAWS, robot.num_joints))
    starts = q + level * steps / np.linalg.norm(steps, axis=1, keepdims=True)
    inside = np.all(robot.is_continuous | ((starts > robot.lower) & (starts < robot.upper)), axis=1)
    for start in starts[inside].astype(np.float32):
        if batch_is_free(world, jnp.asarray(start)[None])[0]:
            return start
    raise ValueError(f"found no free start {level:g} rad away from {np.round(q, 3).tolist()}")


def _goal_image(benchmark: DreamBenchmark, frame: Frame, camera: Camera) -> np.ndarray:
    """The photograph (H, W, 3), or (H, W, 4) with what tells the robot."""
    rgb = read_image(frame.image)[..., :3]
    if benchmark.mask == "plain":
        return rgb
    if benchmark.mask == "background":
        alpha = robot_before_background(rgb, read_image(str(benchmark.background)))
    elif benchmark.mask == "box":
        alpha = robot_in_box(rgb, robot_box(bench_robot(benchmark.robot), frame.q, camera))
    else:
        seen = read_image(str(frame.mask))[..., :3]
        alpha = valid_mask(seen, rgb.shape[0], rgb.shape[1], "the robot's mask")
    return np.concatenate([rgb, alpha[..., None]], axis=-1)


def robot_box(robot: Robot, q: np.ndarray, camera: Camera) -> list[float]:
    """A box x0, y0, x1, y1 [px] around the robot at a configuration (D,), inside the image."""
    # These cover the moving links; those follow the base too.
    both = robot.collision_spheres, robot.self_collision_spheres
    link, offset, radius = (
        np.concatenate([np.asarray(getattr(spheres, name)) for spheres in both])
        for name in ("link", "center", "radius")
    )
    poses = np.asarray(link_poses(robot.chain, jnp.asarray(q)))[link]
    centers = np.einsum("nij,nj->ni", poses[:, :3, :3], offset) + poses[:, :3, 3]
    pixels, depth = (np.asarray(x) for x in project(camera, jnp.asarray(centers)))
    reach = float(camera.focal) * radius / np.maximum(depth - radius, 0.01) + BOX_RIM_PX
    size = [camera.width, camera.height]
    low, high = (pixels - reach[:, None]).min(axis=0), (pixels + reach[:, None]).max(axis=0)
    return [*np.clip(low, 0, size).tolist(), *np.clip(high, 0, size).tolist()]


@functools.cache
def _self_model(robot: str) -> SelfModel:
    return load_self_model(self_model_path(bench_robot(robot)))
