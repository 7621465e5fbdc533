"""Where the scenes that come with the package are."""

from pathlib import Path

from vrrt_jax.robots.robot_folder import model_file


def scenes_dir() -> Path:
    """The folder of robots, worlds and problems.

    Returns:
        ``scenes/`` of a checkout, or its copy inside an installed wheel.

    Raises:
        FileNotFoundError: neither exists.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_scenes", package.parent / "scenes"):
        if (folder / "robots").is_dir():
            return folder
    raise FileNotFoundError(
        f"the packaged scenes were not found beside {package}: reinstall vrrt-jax, or install the "
        "checkout with `pip install -e .`"
    )


def robot_names() -> list[str]:
    """Names that :func:`vrrt_jax.robots.load_robot` knows."""
    return sorted(file.parent.name for file in (scenes_dir() / "robots").glob("*/robot.xml"))


def robot_path(name_or_path: str | Path) -> Path:
    """The MJCF or URDF file of a robot; of a folder, its collision model.

    Args:
        name_or_path: the name of a packaged robot, or a path to a file, or to a folder that
            ``vrrt fit`` made.

    Raises:
        FileNotFoundError: the path leads to no file.
        ValueError: the name is not known, or the folder is not whole.
    """
    text = str(name_or_path)
    if text in robot_names():
        return scenes_dir() / "robots" / text / "robot.xml"
    path = Path(name_or_path).expanduser()
    if path.is_file():
        return path
    if path.is_dir():
        return model_file(path)
    if path.suffix or len(path.parts) > 1:
        raise FileNotFoundError(
            f"robot file '{text}' does not exist; pass the path of an MJCF or URDF file, or of a "
            f"folder from vrrt fit, or one of the packaged robots: {', '.join(robot_names())}"
        )
    raise ValueError(
        f"unknown robot '{text}'; have: {', '.join(robot_names())}; or pass the path of an MJCF "
        "or URDF file, or of a folder from vrrt fit"
    )
