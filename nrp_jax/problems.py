"""Problems in homes as folders: ``problem.json`` and the map beside it."""

import dataclasses
from pathlib import Path

import numpy as np

from nrp_jax.homes.grid import Grid, load_map
from nrp_jax.scene.configurations import check_shape
from nrp_jax.scene.robots import MobileRobot, load_robot
from vrrt_jax.core.data_file import of_file, read_json
from vrrt_jax.core.fields import check_fields

FIELDS = ("robot", "map", "start", "goal")  # of problem.json
PACKAGED = Path(__file__).parent / "packaged_problems"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Problem:
    """A robot in a home, where it is, and where it should go."""

    name: str
    robot: MobileRobot
    grid: Grid
    map_file: Path
    q_start: np.ndarray  # (D,)
    q_goal: np.ndarray  # (D,)


def problem_names() -> list[str]:
    """The packaged problems."""
    return sorted(path.parent.name for path in PACKAGED.glob("*/problem.json"))


def load_problem(name_or_path: str | Path) -> Problem:
    """Load a packaged problem by name, or any by its folder.

    Args:
        name_or_path: a packaged problem, or a folder with a ``problem.json``. It holds "robot",
            "map" (a file beside it, see :func:`nrp_jax.load_map`), "start" and "goal" (lists of D
            numbers, [m] and [rad]).

    Raises:
        FileNotFoundError: there is no such problem, or its map is missing.
        ValueError: a field is missing, unknown, or makes no sense.
    """
    folder = Path(name_or_path)
    if not (folder / "problem.json").is_file() and str(name_or_path) in problem_names():
        folder = PACKAGED / str(name_or_path)
    file = folder / "problem.json"
    if not file.is_file():
        raise FileNotFoundError(
            f"no problem at '{name_or_path}'; packaged ones: {', '.join(problem_names())}, or give "
            "a folder with a problem.json"
        )
    fields = read_json(file)
    check_fields(fields, FIELDS, f"'{file}'")
    if missing := [name for name in FIELDS if name not in fields]:
        raise ValueError(
            f"'{file}' lacks the field '{missing[0]}'; expected {', '.join(FIELDS)}: see the "
            "packaged problems"
        )
    with of_file(file):
        for name in ("robot", "map"):
            if not isinstance(fields[name], str):
                raise ValueError(f"its {name} is {fields[name]!r}; expected a text")
        robot = load_robot(fields["robot"])
        q_start, q_goal = (check_shape(robot, fields[name], name) for name in ("start", "goal"))
    return Problem(
        name=folder.resolve().name,
        robot=robot,
        grid=load_map(folder / fields["map"]),
        map_file=folder / fields["map"],
        q_start=q_start,
        q_goal=q_goal,
    )
