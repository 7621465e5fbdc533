"""OMPL, whose planners benchmarks compare with; an optional extra."""

import functools
import importlib.util
from importlib import metadata
from typing import Any


def ompl_version() -> str:
    """The version that is installed.

    Raises:
        ModuleNotFoundError: none is; the message says how to install it.
    """
    if importlib.util.find_spec("ompl") is None:
        raise ModuleNotFoundError("the peers need OMPL: pip install 'vrrt-jax[peers]'")
    return metadata.version("ompl")


@functools.cache
def load_ompl(seed: int) -> Any:
    """The package, silent and seeded; only the first seed of a process counts."""
    import ompl.base  # pyright: ignore[reportMissingImports]
    import ompl.geometric  # pyright: ignore[reportMissingImports]
    import ompl.util  # pyright: ignore[reportMissingImports]

    ompl.util.RNG.setSeed(seed + 1)  # zero would be a random one
    ompl.util.setLogLevel(ompl.util.LogLevel.LOG_NONE)
    return ompl
