"""Results of ``nrp bench curves`` as a Markdown table."""

from collections.abc import Mapping
from typing import Any

from vrrt_jax.core.markdown import table

POINTS_S = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # columns of the table, and the budget


def to_text(results: Mapping[str, Any]) -> str:
    """A row for each planner; shares in percent."""
    times = next(iter(results["planners"].values()))["time_s"]
    shown = [at for at, time in enumerate(times) if time in POINTS_S or at == len(times) - 1]
    heads = (
        "planner",
        "n",
        *(f"solved by {times[at]:g} s [%]" for at in shown),
        "median first path [s]",
        "optimality at the end [%]",
        "after shortening [%]",
        "not verified",
    )
    rows = []
    for name, found in results["planners"].items():
        first = found["median_first_s"]
        rows.append(
            (
                name,
                str(found["n"]),
                *(f"{100 * found['success'][at]:.0f}" for at in shown),
                "" if first is None else f"{first:.2f}",
                f"{100 * found['optimality'][-1]:.0f}",
                f"{100 * found['optimality_shortened']:.0f}",
                str(found["not_verified"]),
            )
        )
    return table(heads, rows)
