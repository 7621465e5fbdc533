"""The ``nrp`` command: homes, data, train, score, plan, bench."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from vrrt_jax.core import command
from vrrt_jax.core.command import EXIT_SOLVED, EXIT_UNSOLVED
from vrrt_jax.core.files import replacing


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 solved or done, 1 not solved, 2 bad input."""
    return command.run(_parser(), argv)


def _parser() -> argparse.ArgumentParser:
    from nrp_jax.bench import checks, planning, score
    from nrp_jax.homes import figure
    from nrp_jax.learning import data, train

    parser = command.Parser(
        prog="nrp", description="Motion planning in homes, with learned samplers."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for module in (figure, data, train, score):
        module.add_arguments(commands)
    _add_plan(commands)
    bench = commands.add_parser("bench", help="measure speed and success")
    benches = bench.add_subparsers(dest="what", required=True)
    for module in (checks, planning):
        module.add_arguments(benches)
    return parser


def _add_plan(commands) -> None:
    plan = commands.add_parser("plan", help="plan between two configurations in a home")
    plan.set_defaults(run=_plan)
    plan.add_argument("--map", required=True, help=".npz, ROS .yaml or MJCF .xml")
    plan.add_argument("--robot", default="snake", help="snake or fetch")
    plan.add_argument("--start", type=command.numbers, required=True, help="as --start=1,2.5,0,...")
    plan.add_argument("--goal", type=command.numbers, required=True, help="as --goal=...")
    plan.add_argument(
        "--method",
        default="rrt-connect",
        help="rrt, rrt-is, rrt-connect, nrp-d or nrp-g; or, to shorten the path until the budget "
        "ends, rrt-star, irrt-star, bit-star, nrp-star-d or nrp-star-g",
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
    plan.add_argument("--out", default="out", help="folder for path.json and plan.png")
    plan.add_argument("--no-pictures", action="store_true", help="no plan.png")


def _plan(arguments: argparse.Namespace) -> int:
    import jax

    from nrp_jax.homes.grid import load_map
    from nrp_jax.planner import KINDS, plan
    from nrp_jax.samplers import load_sampler
    from nrp_jax.scene.configurations import check_shape
    from nrp_jax.scene.robots import load_robot
    from nrp_jax.scene.world import build_world

    robot = load_robot(arguments.robot)
    for name in ("start", "goal"):
        check_shape(robot, getattr(arguments, name), name)
    if arguments.crop is not None and len(arguments.crop) != 4:
        raise ValueError(f"--crop has {len(arguments.crop)} numbers; expected x0,y0,x1,y1")
    grid = load_map(arguments.map, crop=arguments.crop)
    sampler = None
    if arguments.model is not None:
        if arguments.method not in KINDS:
            raise ValueError(
                f"method '{arguments.method}' uses no model; drop --model, or choose a method of "
                f"{', '.join(KINDS)}"
            )
        sampler = load_sampler(robot.name, KINDS[arguments.method], arguments.model)
    world = build_world(robot, grid, resolution=arguments.resolution)
    result = plan(
        robot,
        grid,
        arguments.start,
        arguments.goal,
        key=jax.random.key(arguments.seed),
        planner=arguments.method,
        sampler=sampler,
        world=world,
        max_expansions=arguments.max_expansions,
        capacity=arguments.capacity,
        time_limit_s=arguments.time_limit,
    )
    print(result)
    out, record = Path(arguments.out), _record(robot.name, arguments, result)
    with command.or_printed(lambda: json.dumps(record)), replacing(out / "path.json", "w") as file:
        file.write(json.dumps(record, indent=1))
    if not arguments.no_pictures:
        from nrp_jax.viz import save_plan

        try:
            save_plan(out / "plan.png", robot, grid, world, result, arguments.goal)
        except ModuleNotFoundError:
            print("no figure: matplotlib is missing; pip install 'vrrt-jax[plot]'", file=sys.stderr)
    if not result.ok:
        problem = result.verification.contact if result.verification else None
        print(
            f"{result.status.value}; {result.advice}{f' ({problem})' if problem else ''}",
            file=sys.stderr,
        )
    return EXIT_SOLVED if result.ok else EXIT_UNSOLVED


def _record(robot: str, arguments: argparse.Namespace, result) -> dict:
    """What ``path.json`` holds."""
    return {
        "robot": robot,
        "map": str(arguments.map),
        "method": arguments.method,
        "seed": arguments.seed,
        "status": result.status.name,
        "refused": result.refused,
        "verified": bool(result.verification and result.verification.ok),
        "cost": round(result.cost, 4),
        "expansions": result.expansions,
        "nodes": int(result.tree.size),
        "timing": {k: round(v, 4) for k, v in result.timing.items()},
        "path": [[round(float(v), 7) for v in q] for q in result.path],
        "trajectory": [[round(float(v), 7) for v in q] for q in result.trajectory],
    }
