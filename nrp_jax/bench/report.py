"""The ``nrp report`` command: curves as figures and tables, beside the authors' numbers."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nrp_jax.bench import paper
from nrp_jax.bench.curve_table import to_text
from vrrt_jax.core import command
from vrrt_jax.core.data_file import of_results, read_json
from vrrt_jax.core.files import write_text
from vrrt_jax.core.markdown import table

# What is drawn over what, and how the axes are called.
_PANELS = (
    ("time_s", "success", "search [s]", "solved"),
    ("expansions", "success", "expansions", "solved"),
    ("time_s", "optimality", "search [s]", "relative path optimality"),
)


def write_page(files: Sequence[Path], folder: Path) -> Path:
    """Write ``README.md`` with a table and a figure for each file of ``nrp bench curves``.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is no results file.
        ModuleNotFoundError: matplotlib is missing.
    """
    found = {file: _read(file) for file in files}
    parts = ["# Success and path optimality in homes", ""]
    for number, (file, results) in enumerate(found.items()):
        with of_results(f"'{file}' is no results file of nrp bench curves"):
            parts += _part(file, results, f"curves_{number}_{file.stem}.png", folder)
    page = folder / "README.md"
    write_text(page, "\n".join(parts))
    return page


def _part(file: Path, results: Mapping[str, Any], name: str, folder: Path) -> list[str]:
    """The lines of one file, whose figure gets a name."""
    task, here = results["task"], results["machine"]
    _figure(results, folder / name)
    return [
        f"## {task}: {file.name}",
        "",
        f"`{results['command']}`, cores a plan: {here['cores']} of {here['processor']}, "
        f"homes: {len(results['homes'])}, runs: {results['runs']}",
        "",
        to_text(results),
        "",
        f"Reference of path optimality: {results['reference']['what']}.",
        "",
        *(f"* {note}" for note in results["notes"]),
        "",
        f"![success over time and expansions, path optimality over time]({name})",
        "",
        f"### {paper.SOURCES[task]}",
        "",
        _papers_table(task),
        "",
        paper.OPTIMALITY[task],
        "",
    ]


def _read(file: Path) -> dict[str, Any]:
    """The results of a file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is of another kind.
    """
    results = read_json(file)
    with of_results(f"'{file}' is no results file of nrp bench curves"):
        if results["what"] != "curves":
            raise ValueError(f"it is of '{results['what']}'")
    return results


def _papers_table(task: str) -> str:
    """The authors' success, a row for each planner [%]."""
    known = paper.SUCCESS[task]
    units = {"time_s": "s", "expansions": "expansions"}
    heads = [
        "planner",
        *(f"by {x:g} {units[over]} [%]" for over in known for x in known[over]["at"]),
    ]
    names = [name for name in known["time_s"] if name != "at"]
    rows = [[n, *(f"{100 * v:.0f}" for over in known for v in known[over][n])] for n in names]
    return table(heads, rows)


def _figure(results: Mapping[str, Any], path: Path) -> None:
    """Curves of all planners with their deviation; the authors' numbers as hollow marks."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(14, 5), layout="constrained")
    colors = {name: plt.get_cmap("tab10")(k % 10) for k, name in enumerate(results["planners"])}
    known = paper.SUCCESS[results["task"]]
    for axis, (over, what, label, title) in zip(axes, _PANELS, strict=True):
        for number, (name, found) in enumerate(results["planners"].items()):
            part = found if over == "time_s" else found[over]
            x, y, off = (
                part["time_s" if over == "time_s" else "at"],
                part[what],
                f"{what}_deviation",
            )
            style = "-" if number < 10 else "--"
            axis.plot(x, y, style, color=colors[name], label=name, marker=".")
            low, high = ([v + s * d for v, d in zip(y, part[off], strict=True)] for s in (-1, 1))
            axis.fill_between(x, low, high, color=colors[name], alpha=0.12, linewidth=0)
        for name, color in colors.items():
            points = known.get(over, {}) if what == "success" else {}
            if name in points:
                axis.plot(
                    points["at"], points[name], "D", color=color, markerfacecolor="none", zorder=4
                )
        axis.set(xscale="log", xlabel=label, ylabel=title, ylim=(-0.02, 1.02))
        axis.grid(alpha=0.3)
    axes[0].plot(
        [], [], "D", color="gray", markerfacecolor="none", label=paper.SOURCES[results["task"]]
    )
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=5, loc="outside lower center")
    numbers = {found["n"] for found in results["planners"].values()}
    figure.suptitle(f"{results['task']}, homes: {len(results['homes'])}, n = {max(numbers)}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def add_arguments(subparsers: Any) -> None:
    """Add the ``report`` command to a command line."""
    parser = subparsers.add_parser("report", help="figures and tables of nrp bench curves")
    parser.set_defaults(run=_run_command)
    parser.add_argument("files", nargs="+", help="JSON files that nrp bench curves wrote")
    parser.add_argument("--out", required=True, help="folder for the page and its figures")


def _run_command(arguments: argparse.Namespace) -> int:
    folder = command.writable_folder(arguments.out)
    page = write_page([Path(file) for file in arguments.files], folder)
    print(f"wrote {page}")
    return command.EXIT_SOLVED
