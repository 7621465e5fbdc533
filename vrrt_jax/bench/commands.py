"""The command ``vrrt bench``: its arguments, and what it runs."""

import argparse
import json
from pathlib import Path
from typing import Any

from vrrt_jax.core import command, workers
from vrrt_jax.core.command import EXIT_SOLVED
from vrrt_jax.core.files import write_text


def add_bench(kinds: Any) -> None:
    """Add a parser for each kind of benchmark.

    Args:
        kinds: the sub-parsers of ``vrrt bench``.
    """
    for what in ("kinematics", "raster", "search"):
        speed = kinds.add_parser(what, help="how fast this machine is")
        speed.set_defaults(run=_speed)
        speed.add_argument("--json", help="write the figures here")
        if what == "search":
            _add_engine(speed)
    twins = kinds.add_parser("twins", help="how alike a robot looks after half a turn of its wrist")
    twins.set_defaults(run=_twins)
    twins.add_argument(
        "--tasks-per-level",
        type=command.whole(1, 100_000),
        default=20,
        help="tasks at each distance",
    )
    twins.add_argument("--json", help="write the figures here")
    twins.add_argument("--figure", help="draw a goal of each robot and its twin into this .png")
    for what, words in (
        ("visual", "the paper's tasks, among obstacles"),
        ("pose", "recover the goal alone, without obstacles"),
        ("ablation", "the settings, varied one by one"),
    ):
        _add_protocol(kinds.add_parser(what, help=words), what)
    _add_arm(kinds.add_parser("arm", help="joint goals, on files of problems from elsewhere"))
    _add_dream(kinds.add_parser("dream", help="joint angles from photographs in DREAM's format"))


def add_robot(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add the arguments that say which robot."""
    parser.add_argument(
        "--robot",
        required=required,
        help="a packaged robot, a folder of vrrt fit, or an MJCF or URDF file",
    )
    parser.add_argument(
        "--freeze", type=_joint_values, default=None, help="joints to fix, as name=0.04,name=0.04"
    )


def _add_protocol(parser: argparse.ArgumentParser, what: str) -> None:
    parser.set_defaults(run=_protocol)
    parser.add_argument(
        "--robot", required=True, help="panda, ur5e or fetch, or a folder of vrrt fit"
    )
    levels = "0.5,1.0,1.5,2.0,2.5"
    parser.add_argument(
        "--levels", type=_levels, default=levels, help="distances [rad], or random: any pairs"
    )
    parser.add_argument(
        "--tasks-per-level",
        type=command.whole(1, 100_000),
        default=20,
        help="tasks at each distance",
    )
    parser.add_argument("--seed", type=command.seed, default=0, help="of tasks and plans")
    if what == "ablation":
        parser.add_argument("--only", help="one setting, such as eta; all by default")
        parser.add_argument("--config", default="paper", help="whose settings: paper or default")
    else:
        parser.add_argument(
            "--method", default="vrrt", help="vrrt, dr-robot, dr-robot-rrt-star or prof-robot"
        )
        parser.add_argument("--config", default="default", help="default or paper")
    if what != "pose":
        parser.add_argument(
            "--worlds", default="standard", help="standard, or hard: all straight lines are blocked"
        )
        parser.add_argument(
            "--problems", help="a folder of joint-goal problems: their scenes and goals instead"
        )
    parser.add_argument(
        "--views", type=command.whole(1, 2), default=1, choices=(1, 2), help="cameras"
    )
    parser.add_argument(
        "--azimuth", type=command.real(-360.0, 360.0), default=0.0, help="turn the cameras [degree]"
    )
    parser.add_argument(
        "--light", type=_light, default=1.0, help="brightness of the lamp, or side for one there"
    )
    parser.add_argument(
        "--noise", type=command.real(0.0, 1.0), default=0.0, help="of goal images, of 1 for white"
    )
    parser.add_argument("--jpeg", type=command.whole(1, 95), help="quality of goal images")
    parser.add_argument(
        "--mask", default="true", choices=("true", "estimated"), help="of goal images"
    )
    parser.add_argument("--occluded", action="store_true", help="obstacles hide the robot")
    _add_engine(parser)
    parser.add_argument(
        "--time-limit", type=command.seconds, default=60.0, help="of one search [s]"
    )
    workers.add_arguments(parser)
    parser.add_argument("--json", help="write results here; go on from what it holds")


def _add_engine(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--engine", default="mjx", help="collision checks: mjx, closed_form")


def _add_arm(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_arm)
    parser.add_argument(
        "--problems", required=True, help="a folder of .npz files, or one that holds ROBOT/*.npz"
    )
    add_robot(parser)
    parser.add_argument(
        "--base",
        type=_base,
        help="where the robot's base link stands in the files, as --base=x,y,z,yaw [m, rad]",
    )
    parser.add_argument(
        "--planner",
        default="rrt-connect",
        help="rrt-connect, rrt or rrt-star; or pose: to where the last link is at the goal",
    )
    _add_engine(parser)
    parser.add_argument(
        "--limit", type=command.whole(1, 1_000_000), help="problems of each file, evenly taken"
    )
    parser.add_argument(
        "--batch", type=command.whole(1, 100_000), help="measure the rate of batches of so many too"
    )
    parser.add_argument("--peers", action="store_true", help="OMPL's planners too")
    parser.add_argument("--seed", type=command.seed, default=0, help="of all plans")
    parser.add_argument(
        "--time-limit", type=command.seconds, default=60.0, help="of one search [s]"
    )
    parser.add_argument("--json", help="write results here; go on from what it holds")


def _add_dream(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_dream)
    parser.add_argument("folder", help="with NNNNNN.rgb.jpg, NNNNNN.json and _camera_settings.json")
    parser.add_argument("--robot", default="panda", help="panda, ur5e or fetch")
    parser.add_argument(
        "--levels",
        type=command.numbers,
        default="1.0",
        help="distances of starts from the true joints [rad]",
    )
    parser.add_argument(
        "--limit", type=command.whole(1, 1_000_000), help="frames, evenly taken; all by default"
    )
    parser.add_argument(
        "--mask",
        default="file",
        choices=("file", "background", "box", "plain"),
        help="what tells the robot: NNNNNN.mask.png, a picture without it, GrabCut in a box around "
        "the true pose, or a plain background",
    )
    parser.add_argument("--background", help="the picture without the robot")
    parser.add_argument(
        "--extrinsics", help="a file with the camera's pose; by PnP from keypoints without it"
    )
    _add_engine(parser)
    parser.add_argument("--seed", type=command.seed, default=0, help="of starts and plans")
    parser.add_argument(
        "--time-limit", type=command.seconds, default=60.0, help="of one search [s]"
    )
    workers.add_arguments(parser)
    parser.add_argument("--json", help="write results here; go on from what it holds")


def _light(text: str) -> float | str:
    return text if text == "side" else command.real(0.01, 100.0)(text)


def _base(text: str) -> Any:
    values = command.numbers(text)
    if len(values) != 4:
        raise argparse.ArgumentTypeError(f"'{text}' has {len(values)} numbers; expected x,y,z,yaw")
    return values


def _speed(arguments: argparse.Namespace) -> int:
    import importlib

    chosen = {"engine": arguments.engine} if arguments.what == "search" else {}
    bench = importlib.import_module(f"vrrt_jax.bench.{arguments.what}")
    return _figures(bench.run(**chosen), arguments)


def _twins(arguments: argparse.Namespace) -> int:
    from vrrt_jax.bench import pose_ambiguity

    if arguments.figure:
        pose_ambiguity.draw(arguments.figure)
    return _figures(pose_ambiguity.run(arguments.tasks_per_level), arguments)


def _figures(figures: dict[str, Any], arguments: argparse.Namespace) -> int:
    text = json.dumps(figures, indent=2)
    print(text)
    if arguments.json:
        write_text(Path(arguments.json), text + "\n")
    return EXIT_SOLVED


def _protocol(arguments: argparse.Namespace) -> int:
    from vrrt_jax.bench import protocol, runner, tables
    from vrrt_jax.bench.tasks import Scenery

    choices = ("method", "config", "only", "engine", "worlds", "problems")
    chosen = {name: getattr(arguments, name) for name in choices if hasattr(arguments, name)}
    benchmark = protocol.benchmark(
        arguments.what,
        arguments.robot,
        levels=arguments.levels,
        tasks_per_level=arguments.tasks_per_level,
        seed=arguments.seed,
        time_limit_s=arguments.time_limit,
        scenery=Scenery(
            views=arguments.views,
            azimuth_deg=arguments.azimuth,
            **{name: getattr(arguments, name) for name in ("light", "noise", "jpeg", "mask")},
            occluded=arguments.occluded,
        ),
        **chosen,
    )
    where = {name: getattr(arguments, name) for name in ("jobs", "cluster")}
    print(tables.to_text(runner.run(benchmark, arguments.json, **where)))
    return EXIT_SOLVED


def _arm(arguments: argparse.Namespace) -> int:
    from vrrt_jax.bench import arm, arm_table
    from vrrt_jax.bench.arm_problems import problem_files
    from vrrt_jax.config import PlannerConfig
    from vrrt_jax.robots import load_robot

    robot = load_robot(arguments.robot, freeze=arguments.freeze)
    files = problem_files(arguments.problems, robot.name)
    benchmark = arm.ArmBenchmark(
        robot=robot,
        config=PlannerConfig().changed({"budget.time_limit_s": arguments.time_limit}),
        base=None if arguments.base is None else tuple(round(float(x), 6) for x in arguments.base),
        **{name: getattr(arguments, name) for name in ("planner", "engine", "limit", "batch")},
        **{name: getattr(arguments, name) for name in ("peers", "seed")},
    )
    print(arm_table.to_text(arm.run(benchmark, files, arguments.json)))
    return EXIT_SOLVED


def _dream(arguments: argparse.Namespace) -> int:
    from vrrt_jax.bench import dream, dream_table
    from vrrt_jax.config import PlannerConfig

    names = ("folder", "robot", "limit", "mask", "background", "extrinsics", "engine", "seed")
    benchmark = dream.DreamBenchmark(
        levels=tuple(round(float(level), 6) for level in arguments.levels),
        config=PlannerConfig().changed({"budget.time_limit_s": arguments.time_limit}),
        **{name: getattr(arguments, name) for name in names},
    )
    where = {name: getattr(arguments, name) for name in ("jobs", "cluster")}
    print(dream_table.to_text(dream.run(benchmark, arguments.json, **where)))
    return EXIT_SOLVED


def _levels(text: str) -> list[float | str]:
    """Distances, and the word random for any pairs."""
    words = [word.strip() for word in text.split(",")]
    distances = [word for word in words if word != "random"]
    if len(distances) == len(words):
        return command.numbers(text).tolist()
    return [*(command.numbers(",".join(distances)).tolist() if distances else []), "random"]


def _joint_values(text: str) -> dict[str, float]:
    pairs = [part.split("=") for part in text.split(",")]
    try:
        values = {name: float(value) for name, value in pairs}
    except ValueError:
        values = {"": 0.0}
    known = all(name.strip() and abs(value) <= command.LARGEST for name, value in values.items())
    if not known or len(values) < len(pairs):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a list such as finger=0.04, each joint once"
        )
    return values
