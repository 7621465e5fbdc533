"""The commands that make a robot and what is around it: ``vrrt fit``, ``spheres``, ``worlds``."""

import argparse
from pathlib import Path
from typing import Any

from vrrt_jax.bench.commands import add_robot
from vrrt_jax.core import command
from vrrt_jax.core.command import EXIT_SOLVED
from vrrt_jax.core.files import write_text


def add_robot_commands(commands: Any) -> None:
    """Add a parser for each of the commands.

    Args:
        commands: the sub-parsers of ``vrrt``.
    """
    fit = commands.add_parser("fit", help="make a robot's folder, with its self-model")
    fit.set_defaults(run=_fit)
    fit.add_argument("file", nargs="?", help="an MJCF or URDF file")
    add_robot(fit, required=False)
    fit.add_argument("--out", required=True, help="a new folder, or one to train further")
    fit.add_argument(
        "--minutes",
        type=command.real(0.0, 1e5),
        default=3.0,
        help="how long to train; the first round is finished in any case",
    )
    fit.add_argument("--seed", type=command.seed, default=0, help="of poses, cameras and splats")
    fit.add_argument(
        "--detail",
        type=command.real(0.1, 100.0),
        default=1.0,
        help="times the usual number of splats",
    )

    spheres = commands.add_parser("spheres", help="fit collision spheres to a robot's meshes")
    spheres.set_defaults(run=_spheres, out_is_file=True)
    add_robot(spheres)
    spheres.add_argument("--out", help="the MJCF file to write; only measured without it")
    spheres.add_argument(
        "--into",
        help="an MJCF file that the command wrote: its joints and home stay, spheres are replaced",
    )
    spheres.add_argument(
        "--self-collision",
        choices=("new", "radii", "kept"),
        default="new",
        help="spheres checked against each other: fit new ones, or the radii of those of the robot "
        "alone, or keep them",
    )
    spheres.add_argument("--seed", type=command.seed, default=0, help="of fit and measurement")
    spheres.add_argument(
        "--spheres",
        type=command.whole(1, 200),
        default=64,
        help="collision spheres to fit, on all moving links together",
    )
    spheres.add_argument(
        "--num",
        type=command.whole(1, 10_000_000),
        default=10_000,
        help="configurations to measure on",
    )
    spheres.add_argument(
        "--worlds", nargs="+", help="MJCF files to measure among; else random scenes"
    )

    worlds = commands.add_parser("worlds", help="make random worlds around a robot")
    worlds.set_defaults(run=_worlds)
    add_robot(worlds)
    worlds.add_argument("--num", type=command.whole(1, 100_000), default=6, help="worlds")
    worlds.add_argument("--seed", type=command.seed, default=0, help="before the first world's")
    worlds.add_argument("--out", required=True, help="folder for ROBOT_1.xml and so on")


def _fit(arguments: argparse.Namespace) -> int:
    from vrrt_jax.splat.fit_robot import PICTURE, fit_robot

    sources = [source for source in (arguments.file, arguments.robot) if source is not None]
    if len(sources) != 1:
        raise ValueError(
            "expected one robot: an MJCF or URDF file, as in vrrt fit arm.xml --out arm, or --robot"
        )
    out = arguments.out
    fit_robot(
        sources[0],
        out,
        minutes=arguments.minutes,
        freeze=arguments.freeze,
        seed=arguments.seed,
        detail=arguments.detail,
    )
    print(
        f"wrote {out}; {Path(out) / PICTURE} shows MuJoCo's images above the self-model's. Plan "
        f"with: vrrt plan --robot {out} --goal random; train on with the same command again"
    )
    return EXIT_SOLVED


def _spheres(arguments: argparse.Namespace) -> int:
    from vrrt_jax.core.data_file import of_file, read_text
    from vrrt_jax.robots import load_robot
    from vrrt_jax.robots.mjcf_writer import check_written, replace_spheres
    from vrrt_jax.robots.robot_fit import fit_spheres
    from vrrt_jax.scene.obstacles import load_obstacles
    from vrrt_jax.scene.sphere_errors import measure_spheres

    robot = load_robot(arguments.robot, freeze=arguments.freeze)
    if arguments.into is not None:
        with of_file(arguments.into):
            check_written(arguments.into)
    scenes = [load_obstacles(path) for path in arguments.worlds or ()]
    if arguments.out is not None:
        text = fit_spheres(
            robot,
            num_spheres=arguments.spheres,
            self_collision=arguments.self_collision,
            seed=arguments.seed,
            progress=print,
        )
        if arguments.into is not None:
            text = replace_spheres(read_text(arguments.into, "XML"), text)
        write_text(Path(arguments.out), text)
        print(f"wrote {arguments.out}")
        robot = load_robot(arguments.out)
    covering, thin = robot.collision_spheres.radius, robot.self_collision_spheres.radius
    print(
        f"{len(covering)} covering and {len(thin)} thin spheres, {len(robot.polytopes)} polytopes"
    )
    for polytopes in (False, True) if robot.polytopes else (False,):
        measured = measure_spheres(
            robot, arguments.num, arguments.seed, scenes, polytopes=polytopes
        )
        print("spheres and polytopes:" if polytopes else "spheres alone:")
        for name, counts in (
            ("against obstacles", measured.obstacles),
            ("against itself", measured.self_collision),
            ("in one count", measured.either),
        ):
            print(
                f"  {name}: {counts.misses} of {counts.colliding} collisions missed, "
                f"{counts.false_alarms} false alarms in {counts.free} free configurations "
                f"({100 * counts.false_alarm_rate:.2f} %)"
            )
    return EXIT_SOLVED


def _worlds(arguments: argparse.Namespace) -> int:
    from vrrt_jax.bench.worlds import random_world
    from vrrt_jax.robots import load_robot
    from vrrt_jax.scene.obstacles import write_obstacles

    robot, out = (
        load_robot(arguments.robot, freeze=arguments.freeze),
        Path(arguments.out),
    )
    for k in range(1, arguments.num + 1):
        seed = arguments.seed + k
        comment = f"Written by the command `vrrt worlds --robot {robot.name}`, seed {seed}."
        write_obstacles(random_world(robot, seed), out / f"{robot.name}_{k}.xml", comment)
    print(f"wrote {arguments.num} worlds to {out}")
    return EXIT_SOLVED
