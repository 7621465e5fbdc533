"""The maps in a folder, those that a robot can be put into."""

import sys
from collections.abc import Callable
from pathlib import Path

from nrp_jax.homes.grid import Grid, load_map
from vrrt_jax.core.data_file import of_file

KINDS = (".npz", ".yaml", ".yml", ".xml")


def load_maps(folder: Path, robot: str, fit: Callable[[Grid], Grid]) -> dict[str, Grid]:
    """Load the maps in a folder, by path in it; those that do not fit are named on standard error.

    Args:
        folder: with ``.npz``, ROS ``.yaml`` or MJCF ``.xml`` maps, at any depth; or one such file.
        robot: its name, for the message.
        fit: makes of a map what is wanted of it, or raises ValueError.

    Raises:
        ValueError: no map fits; of one file, why it does not.
    """
    if folder.is_file() and folder.suffix in KINDS:
        with of_file(folder):
            return {folder.name: fit(load_map(folder))}
    grids = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix not in KINDS:
            continue
        try:
            grid = fit(load_map(file))
        except (ValueError, FileNotFoundError) as error:
            print(f"map '{file}' is left out: {error}", file=sys.stderr)
            continue
        grids[file.relative_to(folder).as_posix()] = grid
    if not grids:
        raise ValueError(f"no maps for {robot} in '{folder}'; expected {', '.join(KINDS)}")
    return grids
