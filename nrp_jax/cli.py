"""The ``nrp`` command: homes, data, train, score, plan, bench, report."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from vrrt_jax.core import command
from vrrt_jax.core.command import EXIT_SOLVED, EXIT_UNSOLVED
from vrrt_jax.core.files import replacing
from vrrt_jax.core.interrupt import interruptible
from vrrt_jax.core.tree_file import nodes_of, save_nodes


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 solved or done, 1 not solved, 2 bad input."""
    return command.run(_parser(), argv)


def _parser() -> argparse.ArgumentParser:
    from nrp_jax import online
    from nrp_jax.bench import checks, curves, execution, growth, planning, report, score
    from nrp_jax.homes import figure
    from nrp_jax.learning import data, train

    parser = command.Parser(
        prog="nrp", description="Motion planning in homes, with learned samplers."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for module in (figure, data, train, online, score, report):
        module.add_arguments(commands)
    _add_plan(commands)
    view = commands.add_parser("view", help="show a plan in the browser")
    view.set_defaults(run=_view)
    view.add_argument("folder", help="what nrp plan wrote with --out")
    command.add_port(view)
    bench = commands.add_parser("bench", help="measure speed and success")
    benches = bench.add_subparsers(dest="what", required=True)
    for module in (checks, planning, growth, curves, execution):
        module.add_arguments(benches)
    return parser


def _add_plan(commands) -> None:
    plan = commands.add_parser("plan", help="plan between two configurations in a home")
    plan.set_defaults(run=_plan)
    plan.add_argument(
        "--problem", help="home_1, home_fetch, or a folder; instead of robot, map, start and goal"
    )
    plan.add_argument("--map", help=".npz, ROS .yaml or MJCF .xml")
    plan.add_argument("--robot", help="snake or fetch; snake by default")
    plan.add_argument("--start", type=command.numbers, help="as --start=1,2.5,0,...")
    plan.add_argument("--goal", type=command.numbers, help="as --goal=...")
    plan.add_argument(
        "--method",
        help="nrp-connect (default), rrt, rrt-is, rrt-connect, cvae-rrt, nrp-d, nrp-g, "
        "nrp-d-floor, nrp-g-floor or, of the fetch, fire; or, to shorten the path until the budget "
        "ends, bit-star, rrt-star, irrt-star, cvae-irrt-star, next, nrp-star-d, nrp-star-g, "
        "nrp-star-d-floor, nrp-star-g-floor, nrp-star-connect or, of the fetch, fire-star, "
        "decomposed or, to take it least time, nrp-star-quick",
    )
    plan.add_argument("--model", help="what nrp train wrote; packaged weights by default")
    plan.add_argument("--crop", type=command.numbers, help="plan in x0,y0,x1,y1 of the map [m]")
    plan.add_argument(
        "--resolution", type=command.real(1e-4, 10.0), help="of collision checks [m] and [rad]"
    )
    plan.add_argument(
        "--max-expansions", type=command.whole(1, 2**31 - 1), default=32_000, help="lanes tried"
    )
    plan.add_argument(
        "--capacity", type=command.whole(3, 1 << 20), default=8192, help="nodes of the tree"
    )
    plan.add_argument("--time-limit", type=command.seconds, default=60.0, help="of the search [s]")
    plan.add_argument("--seed", type=command.seed, default=0, help="of all that is random")
    plan.add_argument("--out", default="out", help="folder for path.json, map, tree and plan.png")
    plan.add_argument("--no-pictures", action="store_true", help="no plan.png")


def _plan(arguments: argparse.Namespace) -> int:
    import jax

    from nrp_jax.planner import plan
    from nrp_jax.planners.by_name import CONNECT, KINDS
    from nrp_jax.planners.nrp_connect import UNCHECKED, default_planner
    from nrp_jax.samplers import load_sampler, weights_of
    from nrp_jax.scene.world import build_world

    problem = _problem(arguments)
    robot, grid = problem.robot, problem.grid
    world = build_world(robot, grid, resolution=arguments.resolution)
    method = arguments.method or default_planner(robot, world)
    sampler = None
    if arguments.model is not None:
        if method not in KINDS:
            raise ValueError(
                f"method '{method}' uses no model; drop --model, or choose a method of "
                f"{', '.join(KINDS)}"
            )
        settings = UNCHECKED if method in CONNECT else {}
        sampler = load_sampler(robot.name, KINDS[method], arguments.model, **settings)
    own = [] if arguments.model is None else [arguments.model]
    with interruptible() as interrupted, weights_of(*own):
        result = plan(
            robot,
            grid,
            problem.q_start,
            problem.q_goal,
            key=jax.random.key(arguments.seed),
            planner=method,
            sampler=sampler,
            world=world,
            max_expansions=arguments.max_expansions,
            capacity=arguments.capacity,
            time_limit_s=arguments.time_limit,
        )
    print(result)
    out, record = Path(arguments.out), _record(problem, method, arguments.seed, result)
    with command.or_printed(lambda: json.dumps(record)), replacing(out / "path.json", "w") as file:
        file.write(json.dumps(record, indent=1))
        # What nrp view shows beside it.
        problem.grid.save(out / "map.npz")
        save_nodes(nodes_of(result.tree), out / "tree.npz")
    if interrupted.is_set():
        raise KeyboardInterrupt
    if not arguments.no_pictures:
        from nrp_jax.viz import save_plan

        try:
            save_plan(out / "plan.png", robot, grid, world, result, problem.q_goal)
        except ModuleNotFoundError:
            print("no figure: matplotlib is missing; pip install 'vrrt-jax[plot]'", file=sys.stderr)
    if not result.ok:
        problem = result.verification.contact if result.verification else None
        print(
            f"{result.status.value}; {result.advice}{f' ({problem})' if problem else ''}",
            file=sys.stderr,
        )
    return EXIT_SOLVED if result.ok else EXIT_UNSOLVED


def _view(arguments: argparse.Namespace) -> int:
    from nrp_jax.viewer import view_folder

    view_folder(Path(arguments.folder), port=arguments.port).serve()
    return EXIT_SOLVED


def _problem(arguments: argparse.Namespace):
    """The problem that is asked for: a packaged one, a folder, or put together of options.

    Raises:
        ValueError: an option is missing, or two say the same.
    """
    from nrp_jax.homes.grid import load_map
    from nrp_jax.problems import Problem, load_problem, problem_names
    from nrp_jax.scene.configurations import check_shape
    from nrp_jax.scene.robots import load_robot

    own = ("map", "robot", "start", "goal", "crop")
    if arguments.problem is not None:
        if given := [name for name in own if getattr(arguments, name) is not None]:
            raise ValueError(f"got both --problem and --{given[0]}; expected one of them")
        return load_problem(arguments.problem)
    for name in ("map", "start", "goal"):
        if getattr(arguments, name) is None:
            raise ValueError(
                f"--{name} is missing; expected --map, --start and --goal, or --problem with one "
                f"of {', '.join(problem_names())}"
            )
    robot = load_robot(arguments.robot or "snake")
    q_start, q_goal = (check_shape(robot, getattr(arguments, n), n) for n in ("start", "goal"))
    if arguments.crop is not None and len(arguments.crop) != 4:
        raise ValueError(f"--crop has {len(arguments.crop)} numbers; expected x0,y0,x1,y1")
    return Problem(
        name=Path(arguments.map).stem,
        robot=robot,
        grid=load_map(arguments.map, crop=arguments.crop),
        map_file=Path(arguments.map),
        q_start=q_start,
        q_goal=q_goal,
    )


def _record(problem, method: str, seed: int, result) -> dict:
    """What ``path.json`` holds."""
    from nrp_jax.viewer import outcome

    return {
        "robot": problem.robot.name,
        "map": str(problem.map_file),
        "method": method,
        "seed": seed,
        **outcome(result),
        "path": [[round(float(v), 7) for v in q] for q in result.path],
        "trajectory": [[round(float(v), 7) for v in q] for q in result.trajectory],
    }


if __name__ == "__main__":
    sys.exit(main())
