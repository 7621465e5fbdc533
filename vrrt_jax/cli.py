"""The ``vrrt`` command: plan, view, render, fit, spheres, bench, report, worlds, doctor."""

import argparse
import ast
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vrrt_jax.bench.commands import add_bench, add_robot
from vrrt_jax.core import command
from vrrt_jax.core.command import EXIT_SOLVED, EXIT_UNSOLVED
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.robot_commands import add_robot_commands

LARGEST_SIDE = 8192  # of an image that is drawn [px]
PHOTO = ("extrinsics", "robot_mask", "background", "box")  # what is told of each goal image
RANDOM = "random"  # in place of a goal image: one is drawn


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 solved or done, 1 not solved, 2 bad input."""
    return command.run(_parser(), argv)


def _parser() -> argparse.ArgumentParser:
    parser = command.Parser(
        prog="vrrt", description="From a picture of the goal to a verified, collision-free path."
    )
    commands = parser.add_subparsers(dest="command", required=True)

    plan = commands.add_parser("plan", help="plan a packaged problem, or one of your own")
    plan.set_defaults(run=_plan)
    plan.add_argument("--problem", help="a packaged problem, or a folder with problem.json")
    add_robot(plan, required=False)
    plan.add_argument("--world", help="an MJCF file of obstacles, or a packaged world")
    plan.add_argument("--engine", default="mjx", help="collision checks: mjx, closed_form")
    plan.add_argument(
        "--goal",
        nargs="+",
        help="goal images, RGB with mask or plain background; or the word random: MuJoCo draws a "
        "pose near the start, which may be left out then, and the world too",
    )
    plan.add_argument(
        "--camera", nargs="+", help="a JSON or YAML file for each goal image: OpenCV's, ROS's, ours"
    )
    _add_photo(plan)
    plan.add_argument(
        "--start", type=command.numbers, help="start configuration, as --start=0,0.3,..."
    )
    plan.add_argument("--self-model", help="trained .npz; the one of the robot's folder by default")
    plan.add_argument("--seed", type=command.seed, default=0, help="of all that is random")
    plan.add_argument("--time-limit", type=command.seconds, default=60.0, help="of the search [s]")
    plan.add_argument("--paper", action="store_true", help="the published settings")
    plan.add_argument("--capacity", type=command.whole(8, 1 << 20), help="nodes of the tree")
    plan.add_argument(
        "--set",
        metavar="NAME=VALUE",
        nargs="+",
        type=_setting,
        help="any settings of PlannerConfig, as --set match.scale=1.3 budget.attempts=2",
    )
    plan.add_argument("--out", default="out", help="folder for the results")
    plan.add_argument(
        "--trajectory", help="also write the path with its times: a .npz, .json, .csv or .yaml file"
    )
    plan.add_argument(
        "--limits", help="a JSON file with the robot's velocity, acceleration and jerk limits"
    )
    plan.add_argument("--no-pictures", action="store_true", help="no figure and no animation")

    view = commands.add_parser("view", help="show a plan in the browser")
    view.set_defaults(run=_view)
    view.add_argument("folder", help="what vrrt plan wrote with --out")
    command.add_port(view)

    render = commands.add_parser("render", help="make a goal image with MuJoCo's renderer")
    render.set_defaults(run=_render, out_is_file=True)
    add_robot(render)
    render.add_argument(
        "--q", type=command.numbers, required=True, help="configuration, as --q=0,0.3,..."
    )
    render.add_argument("--camera", required=True, help="a JSON or YAML file")
    render.add_argument("--size", type=_size, default=(480, 480), help="WIDTHxHEIGHT [px]")
    render.add_argument("--out", required=True, help="a .png file")

    add_robot_commands(commands)
    bench = commands.add_parser("bench", help="measure speed, success or settings")
    add_bench(bench.add_subparsers(dest="what", required=True))

    report = commands.add_parser("report", help="tables and figures of benchmark results")
    report.set_defaults(run=_report)
    report.add_argument("files", nargs="+", help="JSON files that vrrt bench wrote")
    report.add_argument("--out", required=True, help="folder for the page and its figures")

    doctor = commands.add_parser("doctor", help="say what this machine has, and what it lacks")
    doctor.set_defaults(run=_doctor)
    return parser


def _add_photo(parser: argparse.ArgumentParser) -> None:
    """Add what else is told of each goal image."""
    parser.add_argument(
        "--extrinsics",
        nargs="+",
        help="a file for each goal image with camera_to_world or world_to_camera, where its "
        "camera's file has none",
    )
    parser.add_argument(
        "--robot-mask", nargs="+", help="a picture for each goal image, white on the robot"
    )
    parser.add_argument(
        "--background", nargs="+", help="what the camera of each goal image sees without the robot"
    )
    parser.add_argument(
        "--box",
        nargs="+",
        type=_box,
        help="around the robot in each goal image, as --box x0,y0,x1,y1 [px]",
    )


def _plan(arguments: argparse.Namespace) -> int:
    import jax
    from tqdm import tqdm

    import vrrt_jax
    from vrrt_jax import report
    from vrrt_jax.config import check_config

    changes: dict[str, Any] = {"budget.time_limit_s": arguments.time_limit}
    if arguments.capacity is not None:
        changes["tree.capacity"] = arguments.capacity
    changes.update(arguments.set or ())
    make = vrrt_jax.PlannerConfig.paper if arguments.paper else vrrt_jax.PlannerConfig
    config = make().changed(changes)
    check_config(config)
    problem, out = _problem(arguments), Path(arguments.out)
    limits = _motion_limits(arguments, problem.robot)
    print(f"{problem.name}: {problem.robot.name}, seed {arguments.seed}; compiling ...", flush=True)
    with tqdm(total=config.budget.max_iterations, unit="it", disable=None, leave=False) as bar:

        def on_progress(state, seconds):
            bar.n = int(state.tree.iteration)
            best, nodes = float(state.tree.score.min()), int(state.tree.size)
            bar.set_postfix_str(f"best loss {best:.2e}, {nodes} nodes")

        with interruptible() as interrupted:
            result = vrrt_jax.plan(
                problem.robot,
                problem.world,
                problem.goal,
                problem.q_start,
                key=jax.random.key(arguments.seed),
                config=config,
                on_progress=on_progress,
            )
    print(result)
    if problem.true_goal is not None:
        print(_off_by(problem, result))
    with command.or_printed(lambda: f"path: {json.dumps(result.path.tolist())}"):
        report.save_result(problem, result, config, arguments.seed, out)
    if interrupted.is_set():
        raise KeyboardInterrupt
    if limits is not None and result.ok:
        timed = vrrt_jax.time_parameterize(problem.robot, result, problem.world, limits=limits)
        vrrt_jax.save_trajectory(timed, arguments.trajectory)
        print(f"wrote {arguments.trajectory}: {timed.duration:.2f} s, {timed.stops} stops")
    if not arguments.no_pictures:
        _pictures(problem, result, out)
    if not result.ok:
        print(f"{result.status.name}: {result.status.value}; {result.advice}", file=sys.stderr)
    elif result.advice:
        print(result.advice)
    return EXIT_SOLVED if result.ok else EXIT_UNSOLVED


def _off_by(problem, result) -> str:
    """How far the target is from the true goal: joints that the image tells, then all others."""
    import numpy as np

    from vrrt_jax.scene.world import pose_error
    from vrrt_jax.visual.finish import UNTOLD

    error = pose_error(problem.world, result.target, problem.true_goal)
    uncertainty = result.joint_uncertainty
    is_told = np.full(len(error), True) if uncertainty is None else uncertainty <= UNTOLD
    names = np.array(problem.robot.joint_names)
    of_told = error[is_told] if is_told.any() else error
    text = f"off from the true goal by {of_told.mean():.3f} on average, at most {of_told.max():.3f}"
    others = [f"{name} by {off:.2f}" for name, off in zip(names, error, strict=True)]
    untold = [words for words, told in zip(others, is_told, strict=True) if not told]
    hidden = f"; without what the image hardly tells: {', '.join(untold)}" if untold else ""
    return f"{text} [rad or m]{hidden}"


def _view(arguments: argparse.Namespace) -> int:
    from vrrt_jax.viewer import view_folder

    view_folder(Path(arguments.folder), port=arguments.port).serve()
    return EXIT_SOLVED


def _doctor(arguments: argparse.Namespace) -> int:
    from vrrt_jax.doctor import findings

    for name, told in findings():
        print(f"{name:18} {told}", flush=True)
    return EXIT_SOLVED


def _motion_limits(arguments: argparse.Namespace, robot):
    """Limits for ``--trajectory``, asked for before the plan; None without it."""
    import vrrt_jax
    from vrrt_jax.core.data_file import of_file, read_json
    from vrrt_jax.motion.export import checked_suffix

    if arguments.trajectory is None:
        if arguments.limits is not None:
            raise ValueError("--limits is for --trajectory, which is not given; give both")
        return None
    checked_suffix(arguments.trajectory)
    if arguments.limits is None:
        return vrrt_jax.motion_limits(robot)
    with of_file(arguments.limits):
        given = vrrt_jax.MotionLimits.from_dict(read_json(arguments.limits))
        return vrrt_jax.motion_limits(robot, given)


def _pictures(problem, result, out: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    from vrrt_jax import viz

    written = ["result.json", "path.npz", "tree.npz"]
    with ThreadPoolExecutor(1) as pool:  # what draws a scene leaves the other core to matplotlib
        animation = pool.submit(viz.save_animation, problem, result, out / "animation.gif")
        try:
            viz.save_figure(problem, result, out / "figure.png")
            written.append("figure.png")
        except ModuleNotFoundError:
            print("no figure: matplotlib is missing; pip install 'vrrt-jax[plot]'", file=sys.stderr)
        animation.result()
    print(f"wrote {', '.join([*written, 'animation.gif'])} to {out}")


def _problem(arguments: argparse.Namespace):
    from vrrt_jax import checks, problems
    from vrrt_jax.robots import load_robot
    from vrrt_jax.splat.model import load_self_model
    from vrrt_jax.splat.photo import load_photo

    parts = ("robot", "world", "goal", "camera", "start")
    given = [name for name in parts if getattr(arguments, name) is not None]
    if arguments.problem is not None:
        others = ("self_model", "freeze", *PHOTO)
        given += [name for name in others if getattr(arguments, name) is not None]
        if given:
            options = ", --".join(given).replace("_", "-")
            raise ValueError(f"give either --problem or --{options}, not both")
        return problems.load_problem(arguments.problem, engine=arguments.engine)
    if arguments.goal == [RANDOM]:
        return _random_problem(arguments)
    missing = [name for name in parts if name not in given]
    if missing:
        raise ValueError(
            f"missing --{', --'.join(missing)}; or give --problem with one of "
            f"{', '.join(problems.problem_names())}"
        )
    goals = len(arguments.goal)
    told: dict[str, list[Any]] = {
        name: getattr(arguments, name) or [None] * goals for name in ("camera", *PHOTO)
    }
    for name, values in told.items():
        if len(values) != goals:
            raise ValueError(
                f"{goals} goal images but {len(values)} of --{name.replace('_', '-')}; give as many"
            )
    robot = load_robot(arguments.robot, freeze=arguments.freeze)
    checks.check_limits(robot, arguments.start, "start")
    photos = [
        load_photo(path, **{name: values[index] for name, values in told.items()})
        for index, path in enumerate(arguments.goal)
    ]
    return problems.Problem(
        name=Path(arguments.goal[0]).stem,
        robot=robot,
        world=problems.load_world(arguments.world, robot, engine=arguments.engine),
        self_model=load_self_model(problems.self_model_path(robot, arguments.self_model)),
        **problems.views_of(photos),
        q_start=arguments.start,
        true_goal=None,
    )


def _random_problem(arguments: argparse.Namespace):
    """A problem whose goal is drawn."""
    from vrrt_jax import problems
    from vrrt_jax.random_problem import random_problem
    from vrrt_jax.robots import load_robot
    from vrrt_jax.scene.world import build_world
    from vrrt_jax.splat.model import load_self_model

    if arguments.robot is None:
        raise ValueError("missing --robot, whose pose --goal random draws")
    for name in ("camera", *PHOTO):
        if getattr(arguments, name) is not None:
            option = name.replace("_", "-")
            raise ValueError(f"--goal random has a camera and a mask of its own; drop --{option}")
    robot = load_robot(arguments.robot, freeze=arguments.freeze)
    if arguments.world is None:
        world = build_world(robot, [], engine=arguments.engine)
    else:
        world = problems.load_world(arguments.world, robot, engine=arguments.engine)
    self_model = load_self_model(problems.self_model_path(robot, arguments.self_model))
    return random_problem(robot, world, self_model, seed=arguments.seed, q_start=arguments.start)


def _render(arguments: argparse.Namespace) -> int:
    import numpy as np

    from vrrt_jax import checks
    from vrrt_jax.core.data_file import of_file, read_fields
    from vrrt_jax.robots import load_robot
    from vrrt_jax.robots.mesh_sources import needed_mesh_spec
    from vrrt_jax.splat.camera_fields import camera_from_dict
    from vrrt_jax.splat.mujoco_images import MeshRenderer
    from vrrt_jax.splat.picture_file import write_image

    robot = load_robot(arguments.robot, freeze=arguments.freeze)
    width, height = arguments.size
    with of_file(arguments.camera):
        camera = camera_from_dict(read_fields(arguments.camera), (height, width))
    q = checks.check_limits(robot, np.array(arguments.q), "configuration")
    picture = MeshRenderer(needed_mesh_spec(robot)).picture(q, camera)
    if not picture.alpha.any():
        raise ValueError("the camera does not see the robot at this configuration; nothing written")
    write_image(arguments.out, picture.rgb, picture.alpha)
    print(f"wrote {arguments.out}")
    return EXIT_SOLVED


def _report(arguments: argparse.Namespace) -> int:
    from vrrt_jax.bench import tables

    page = tables.write_page([Path(file) for file in arguments.files], Path(arguments.out))
    print(f"wrote {page}")
    return EXIT_SOLVED


def _box(text: str) -> list[float]:
    values = command.numbers(text)
    if len(values) != 4:
        raise argparse.ArgumentTypeError(f"'{text}' is not a box such as 80,40,560,470")
    return values.tolist()


def _setting(text: str) -> tuple[str, Any]:
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a setting such as match.scale=1.3 or expand.inherit=False"
        ) from None


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    sides = [int(side) if side.isascii() and side.isdigit() else 0 for side in (width, height)]
    if not all(1 <= side <= LARGEST_SIDE for side in sides):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a size such as 480x480, with sides up to {LARGEST_SIDE}"
        )
    return sides[0], sides[1]


if __name__ == "__main__":
    sys.exit(main())
