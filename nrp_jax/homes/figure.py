"""The ``nrp homes`` command: figures of random homes."""

import argparse
from pathlib import Path

import numpy as np

from nrp_jax.homes.furniture import HEIGHT
from nrp_jax.homes.houses import CELLS, House, generate_house
from vrrt_jax.core import command

_MAX_PIXELS = 20_000  # along the longer side of a figure


def save_figure(houses: list[House], path: str | Path) -> None:
    """Draw homes side by side: walls dark, furniture browner with its height, overhangs bluish."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = min(5, len(houses))
    rows = -(-len(houses) // columns)
    dpi = min(110, _MAX_PIXELS / (3.3 * rows))
    figure, axes = pyplot.subplots(rows, columns, figsize=(3.2 * columns, 3.3 * rows), dpi=dpi)
    axes = np.ravel(axes)
    for axis in axes:
        axis.axis("off")
    for axis, house in zip(axes, houses, strict=False):
        _draw(axis, house)
    figure.tight_layout(pad=0.4)
    figure.savefig(path)
    pyplot.close(figure)


def _draw(axis, house: House) -> None:
    """Draw one home."""
    from matplotlib import colormaps

    occupied = house.grid.occupied
    # Browner the higher the top of a column is, bluish where the column is free at the floor.
    top = HEIGHT - occupied[:, :, ::-1].argmax(2)
    image = np.ones((*house.walls.shape, 3))
    standing = occupied.any(2)
    image[standing] = colormaps["YlOrBr"](0.25 + 0.6 * top / HEIGHT)[..., :3][standing]
    over = standing & ~occupied[:, :, 0]
    image[over] = 0.45 * image[over] + 0.55 * np.array([0.55, 0.75, 0.95])
    image[house.walls] = 0.2
    size = 0.1 * occupied.shape[0]
    axis.imshow(image.swapaxes(0, 1), origin="lower", extent=(0, size, 0, size))
    for room in house.rooms:
        axis.text(
            0.05 * (room.x0 + room.x1), 0.05 * (room.y0 + room.y1), room.kind,
            fontsize=6, color="tab:blue", ha="center", va="center",
        )  # fmt: skip
    axis.set_title(f"seed {house.seed}", fontsize=7, pad=2)


def add_arguments(subparsers) -> None:
    """Add the ``homes`` command to a command line."""
    parser = subparsers.add_parser("homes", help="draw random homes")
    parser.set_defaults(run=_run, out_is_file=True)
    parser.add_argument("--num", type=command.whole(1, 1000), default=20, help="homes")
    parser.add_argument(
        "--seed", type=command.seed, default=0, help="of the first; the others follow"
    )
    parser.add_argument("--task", default="snake", choices=tuple(CELLS), help="whose homes")
    parser.add_argument("--out", required=True, help="a .png file")


def _run(arguments: argparse.Namespace) -> int:
    seeds = range(arguments.seed, arguments.seed + arguments.num)
    houses = [generate_house(seed, arguments.task) for seed in seeds]
    save_figure(houses, arguments.out)
    print(f"wrote {arguments.out}")
    return 0
