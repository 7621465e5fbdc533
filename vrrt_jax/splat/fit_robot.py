"""Make a robot's folder from its MJCF or URDF file: collision model, self-model and a picture.

Training goes on in rounds. The first is short and leaves a usable self-model; each one after it
trains the splats on with new images. See :mod:`vrrt_jax.robots.robot_folder` for the folder.
"""

import dataclasses
import hashlib
import math
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from vrrt_jax.core.files import UNFINISHED, replacing
from vrrt_jax.core.timing import versions
from vrrt_jax.robots import mjcf_writer
from vrrt_jax.robots.kinematics import body_links
from vrrt_jax.robots.mesh_sources import needed_mesh_spec
from vrrt_jax.robots.packaged import robot_names, robot_path
from vrrt_jax.robots.robot import Robot, load_robot
from vrrt_jax.robots.robot_folder import (
    MODEL,
    RECORD,
    SELF_MODEL,
    Record,
    read_record,
    sha256,
    write_record,
)
from vrrt_jax.splat.fit import fit_self_model
from vrrt_jax.splat.fit_config import FIRST_ROUND, FitConfig
from vrrt_jax.splat.fit_level import OutOfTime
from vrrt_jax.splat.fit_picture import save_fit_picture
from vrrt_jax.splat.model import SelfModel, load_self_model
from vrrt_jax.splat.mujoco_images import VISUAL_GROUPS

PICTURE = "self_model.png"
WORTH = 0.5  # of the last round's time: with less left, no other round is begun
SEEDS = 1000  # between the seeds of two rounds


def fit_robot(
    source: str | Path,
    folder: str | Path,
    *,
    minutes: float = 3.0,
    freeze: Mapping[str, float] | None = None,
    seed: int = 0,
    detail: float = 1.0,
    rounds: tuple[FitConfig, FitConfig] = (FIRST_ROUND, FitConfig()),
    progress: Callable[[str], None] = print,
) -> Record:
    """Make a robot's folder, or train the self-model of one further.

    The first round is finished however long it takes. An interrupted call is gone on with by the
    same call.

    Args:
        source: an MJCF or URDF file, or the name of a packaged robot.
        folder: new, or empty, or from an earlier call with the same arguments.
        minutes: how long to train on [min].
        freeze: joints to fix, and where [rad] or [m]; see :func:`vrrt_jax.load_robot`.
        seed: of poses, cameras and training.
        detail: times the usual number of splats; large robots need more.
        rounds: how the first round trains, and all others.
        progress: called with a line of text now and then.

    Returns:
        What the folder's ``robot.json`` says.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: the folder cannot be written to; what was done is kept.
        RuntimeError: OpenGL is not available.
        ValueError: the file is no robot that can be planned for or seen, or the folder holds
            other things, or what another robot or other arguments made.
    """
    deadline, folder = time.monotonic() + 60.0 * minutes, Path(folder)
    path = _source_file(source)
    made_of = {
        "source": str(source) if str(source) in robot_names() else str(path.resolve()),
        "freeze": {name: float(value) for name, value in (freeze or {}).items()},
        "seed": seed,
        "detail": detail,
    }
    if (folder / RECORD).is_file():
        record = _earlier_record(folder, made_of, sha256(path))
        if not record.rounds and not (folder / MODEL).is_file():  # killed between the two
            record = _begin(source, path, folder, made_of)
    else:
        _check_empty(folder)
        record = _begin(source, path, folder, made_of)
    robot = load_robot(folder / MODEL)
    spec = _visible(robot)

    def train(record: Record, until: float) -> Record:
        config = dataclasses.replace(rounds[min(record.rounds, 1)], detail=detail)
        number, started = seed + SEEDS * record.rounds, time.monotonic()
        earlier = load_self_model(folder / SELF_MODEL) if record.rounds else None
        file = folder / SELF_MODEL
        model = fit_self_model(
            robot, spec, file, seed=number, config=config, earlier=earlier, deadline=until
        )
        save_fit_picture(robot, spec, model, folder / PICTURE, seed=number + 3, config=config)
        took = (time.monotonic() - started) / 60.0
        record = dataclasses.replace(
            record,
            rounds=record.rounds + 1,
            minutes=round(record.minutes + took, 2),
            levels=_levels(model),
            versions=versions(),
        )
        write_record(folder, record)
        progress(f"round {record.rounds}, {took:.1f} min: {_told(record)}")
        return record

    took = 0.0
    while record.rounds == 0 or deadline - time.monotonic() > WORTH * took:
        started = time.monotonic()
        try:
            record = train(record, deadline if record.rounds else math.inf)
        except OutOfTime:
            progress("the time is up amid a round, which the same command goes on with")
            break
        except OSError as error:
            kept = "what was done is kept, and the same command goes on with it"
            raise OSError(error.errno, f"{error.strerror}; {kept}", str(folder)) from None
        took = time.monotonic() - started
    return record


def _source_file(source: str | Path) -> Path:
    if Path(source).expanduser().is_dir() and str(source) not in robot_names():
        raise ValueError(
            f"'{source}' is a folder; expected an MJCF or URDF file, or one of the packaged "
            f"robots: {', '.join(robot_names())}"
        )
    return robot_path(source)


def _check_empty(folder: Path) -> None:
    """Make the folder, and see that it holds nothing, and can bear the robot's name."""
    name = folder.resolve().name
    if name in robot_names():
        raise ValueError(
            f"'{name}' is the name of a packaged robot, which would be taken for the folder; "
            "choose another name"
        )
    if folder.suffix == ".npz":
        raise ValueError(f"'{folder}' names a file; expected a folder, such as '{folder.stem}'")
    folder.mkdir(parents=True, exist_ok=True)
    others = sorted(file.name for file in folder.iterdir() if file.suffix != UNFINISHED)
    if others:
        some = ", ".join(others[:3]) + (" and more" if len(others) > 3 else "")
        raise ValueError(
            f"'{folder}' holds other things ({some}) and no {RECORD}; give a new or empty folder"
        )


def _earlier_record(folder: Path, made_of: Mapping[str, object], source: str) -> Record:
    record = read_record(folder)
    for name, value in made_of.items():
        if record.made_of.get(name) != value:
            raise ValueError(
                f"'{folder}' was made with {name} {record.made_of.get(name)!r}, not {value!r}; "
                "give the same again to train on, or choose another folder"
            )
    if source != record.source_sha256:
        raise ValueError(
            f"'{made_of['source']}' has changed since '{folder}' was made of it; choose another "
            "folder"
        )
    return record


def _begin(source: str | Path, path: Path, folder: Path, made_of: Mapping[str, object]) -> Record:
    """Write the collision model, and the record that no round is done yet."""
    robot = load_robot(source, freeze=made_of["freeze"] or None)  # type: ignore[arg-type] - a dict
    name = folder.resolve().name
    text = mjcf_writer.renamed(robot.xml, name)
    _visible(robot)  # what cannot be trained leaves no folder to go on with
    record = Record(
        name=name,
        made_of=made_of,
        source_sha256=sha256(path),
        model_sha256=hashlib.sha256(text.encode()).hexdigest(),
        versions=versions(),
    )
    write_record(folder, record)
    with replacing(folder / MODEL, "w") as file:
        file.write(text)
    return record


def _visible(robot: Robot) -> mujoco.MjSpec:
    """The robot with its visual meshes, of which MuJoCo draws some.

    Raises:
        ValueError: they are not on this machine, or nothing that moves is drawn.
    """
    spec = needed_mesh_spec(robot)
    model = spec.compile()
    is_drawn = np.isin(model.geom_group, VISUAL_GROUPS)
    links = set(np.asarray(body_links(model))[model.geom_bodyid[is_drawn]].tolist())
    if not links - {0}:
        raise ValueError(
            f"nothing of '{robot.name}' that moves is drawn: no geom of a moving body is in groups "
            f"{', '.join(map(str, VISUAL_GROUPS))}; put what is to be seen there"
        )
    seen = set()  # links that are drawn, or carry what is
    for link in links:
        while link:
            seen.add(link)
            link = robot.chain.parents[link - 1]
    hidden = [name for j, name in enumerate(robot.joint_names) if j + 1 not in seen]
    if hidden:
        warnings.warn(
            f"joints {', '.join(hidden)} move nothing that is drawn, so that no image tells them; "
            "fix them with --freeze, or give their links something to see",
            stacklevel=3,
        )
    ends = sorted(links - set(robot.chain.parents) - {0})
    if len(ends) > 1:
        names = ", ".join(robot.link_names[link] for link in ends)
        warnings.warn(
            f"the robot ends in several links ({names}); the close-up shows the last one alone: "
            "fix the joints of the others with --freeze if they do not matter",
            stacklevel=3,
        )
    return spec


def _levels(model: SelfModel) -> tuple[Mapping[str, object], ...]:
    return tuple(
        {
            "size_px": level.size_px,
            "num_splats": level.splats.num_splats,
            "psnr_db": level.psnr_db,
            "match_threshold": level.match_threshold,
        }
        for level in (*model.levels, model.close_up)
    )


def _told(record: Record) -> str:
    *levels, close_up = record.levels
    whole = ", ".join(f"{level['psnr_db']:.1f} at {level['size_px']} px" for level in levels)
    return f"{whole}, {close_up['psnr_db']:.1f} on close-ups [dB, unseen poses and cameras]"
