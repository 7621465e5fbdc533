"""Benchmark results as tables and figures, beside the paper's own numbers."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vrrt_jax.bench.methods import CAUSES, METHODS
from vrrt_jax.bench.tasks import ROBOTS
from vrrt_jax.core.data_file import of_results, read_json
from vrrt_jax.core.files import write_text
from vrrt_jax.core.markdown import table

# Average success over the five levels [%]; Visual-RRT (CVPR 2026), on an RTX 4090.
PAPER = {
    "panda": {"dr-robot": 19.3, "prof-robot": 23.6, "dr-robot-rrt-star": 23.8, "vrrt": 75.2},
    "ur5e": {"dr-robot": 25.9, "prof-robot": 28.0, "dr-robot-rrt-star": 28.1, "vrrt": 79.8},
    "fetch": {"dr-robot": 18.7, "prof-robot": 21.9, "dr-robot-rrt-star": 22.4, "vrrt": 73.4},
}
PAPER_NOTE = (
    "The paper's numbers are its own: other worlds, tasks and self-models, 100 tasks a level, on "
    "an NVIDIA RTX 4090; 21.6 s a plan for the Panda."
)
CAUSE_COLORS = ("#4878a8", "#d9903d", "#ecc68f", "#8a8a8a", "#c4c4c4", "#7a5aa6", "#b5433f")
_NONE = "{} is no results file of vrrt bench"
SOLVED_COLOR = "#8fbc8f"


def to_text(results: dict[str, Any]) -> str:
    """A results file as a Markdown table."""
    rows = []
    for name, summary in _variants(results).items():
        for level in summary["levels"]:
            causes = ", ".join(f"{cause} {n}" for cause, n in level["causes"].items())
            rows.append(
                [
                    name,
                    _level(level),
                    str(level["n"]),
                    _percent(level["success"]),
                    _percent(level.get("false_solved")),
                    _percent(level.get("from_tree")),
                    f"{level['median_time_s']:.2f}",
                    f"{level['p95_time_s']:.2f}",
                    "" if level["path_length"] is None else f"{level['path_length']:.2f}",
                    f"{level['path_over_reference']:.2f}"
                    if level.get("path_over_reference")
                    else "",
                    f"{level['mean_error_rad']:.3f}",
                    f"{level['median_psnr_db']:.1f}",
                    "" if level.get("refused_paths") is None else str(level["refused_paths"]),
                    causes,
                ]
            )
        if len(summary["levels"]) > 1:
            average = _percent(summary["average_success"])
            rows.append([name, "average", "", average, *[""] * 10])
    heads = (
        "method",
        "level [rad]",
        "n",
        "success [%]",
        "falsely solved [%]",
        "of the solved, from the tree [%]",
        "median time [s]",
        "95 % [s]",
        "path [rad]",
        "of RRT-Connect's to the true goal",
        "mean error [rad]",
        "PSNR [dB]",
        "paths refused by the exact check",
        "causes of failure",
    )
    return table(heads, rows)


def write_page(files: Sequence[Path], folder: Path) -> Path:
    """Write ``README.md`` and its figures for results of any number of benchmarks.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is no results file.
    """
    found = [_read(file) for file in files]
    with of_results(_NONE.format(" or ".join(f"'{file}'" for file in files))):
        return _written(found, folder)


def _written(found: Sequence[dict[str, Any]], folder: Path) -> Path:
    """The page, of files that are read."""
    parts = ["# Results", "", PAPER_NOTE, "", "## Average success [%]", "", _overview(found), ""]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for results in found:
        groups.setdefault((results["what"], results["robot"]), []).append(results)
    for (what, robot), group in sorted(groups.items()):
        parts += [f"## {what}: {robot}", ""]
        for results in group:
            on = results.get("machine")  # older files do not tell
            where = f", cores a task: {on['cores']} of {on['processor']}" if on else ""
            seen = results.get("self_model")
            seen = f"self-model {seen}" if seen else "an earlier self-model"
            parts += [f"`{_command(results)}`{where}, {seen}", "", to_text(results), ""]
        name = re.sub(r"[^\w.-]", "_", f"{what}_{robot}.png")  # it stays in the folder
        if what == "ablation":
            _ablation_figure(group, folder / name)
            parts += [f"![success and causes of failure by setting]({name})", ""]
        else:
            _figure(group, folder / name)
            parts += [f"![success, causes, times and path lengths]({name})", ""]
    page = folder / "README.md"
    write_text(page, "\n".join(parts))
    return page


def _read(file: Path) -> dict[str, Any]:
    """The results of a file, all of which can be told.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no results file.
    """
    results = read_json(file)
    with of_results(_NONE.format(f"'{file}'")):
        if not isinstance(results["what"] + results["robot"], str):
            raise ValueError("its names are no texts")
        to_text(results)
        _command(results)
    return results


def _variants(results: dict[str, Any]) -> dict[str, Any]:
    if "by_variant" in results:
        return {k: v for k, v in results["by_variant"].items() if v["levels"]}
    return {_label(results): {k: results[k] for k in ("average_success", "levels")}}


def _label(results: dict[str, Any]) -> str:
    method = results["variants"][0]["method"]
    if method == "vrrt":
        method += ", paper's settings" if _is_paper(results) else ", default"
    return ", ".join([method, *_unusual(results["scenery"])])


def _unusual(scenery: dict[str, Any]) -> list[str]:
    """How it differs from the usual one."""
    said = {
        "two views": scenery["views"] == 2,
        "occluded": scenery["occluded"],
        f"light {scenery['light']}": scenery["light"] != 1.0,
        f"azimuth {scenery['azimuth_deg']:g}": scenery["azimuth_deg"] != 0.0,
        # Older files do not say how images were taken.
        f"noise {scenery.get('noise')}": bool(scenery.get("noise")),
        f"JPEG {scenery.get('jpeg')}": scenery.get("jpeg") is not None,
        "estimated mask": scenery.get("mask") == "estimated",
    }
    return [name for name, holds in said.items() if holds]


def _is_paper(results: dict[str, Any]) -> bool:
    config = results["variants"][0]["config"]
    # Older files have flat settings.
    # Older files have other names for what the paper's planner does without.
    for stage, name in (("lineages", "num"), ("seeds", "num")):
        if stage in config:
            return config[stage][name] == 0
    return config["probes"] == 0


def _command(results: dict[str, Any]) -> str:
    words = ["vrrt bench", results["what"], "--robot", results["robot"]]
    if results["what"] == "ablation":
        fields = {variant["name"].partition("=")[0] for variant in results["variants"]}
        words += ["--only", *fields] if len(fields) == 1 else []
    else:
        words += ["--method", results["variants"][0]["method"]]
    words += ["--config", "paper" if _is_paper(results) else "default"]
    # Files from before there were engines are of the fast one.
    words += ["--engine closed_form"] if results.get("engine") != "mjx" else []
    scenery = results["scenery"]
    words += ["--views 2"] if scenery["views"] == 2 else []
    words += ["--occluded"] if scenery["occluded"] else []
    words += [f"--light {scenery['light']}"] if scenery["light"] != 1.0 else []
    words += [f"--noise {scenery['noise']}"] if scenery.get("noise") else []
    words += [f"--jpeg {scenery['jpeg']}"] if scenery.get("jpeg") is not None else []
    words += ["--mask estimated"] if scenery.get("mask") == "estimated" else []
    words += [f"--azimuth {scenery['azimuth_deg']:g}"] if scenery["azimuth_deg"] else []
    if results.get("problems"):
        words += ["--problems DIR"]
    else:
        words += [
            "--levels",
            ",".join(map(_level, next(iter(_variants(results).values()))["levels"])),
        ]
    words += ["--worlds hard"] if results.get("hard") else []
    most = 1 + max((row["index"] for row in results["tasks"]), default=0)
    words += ["--tasks-per-level", str(most), "--seed", str(results["seed"])]
    return " ".join(words)


def _overview(found: Sequence[dict[str, Any]]) -> str:
    """Methods by robots, with the paper's numbers beside ours."""
    rows = []
    for method in METHODS:
        for is_paper in (True, False) if method == "vrrt" else (False,):
            cells = []
            for robot in ROBOTS:
                own = [
                    results
                    for results in found
                    if (results["what"], results["robot"]) == ("visual", robot)
                    and results["variants"][0]["method"] == method
                    and (method != "vrrt" or _is_paper(results) == is_paper)
                    and not _unusual(results["scenery"])
                ]
                ours = _percent(own[0]["average_success"]) if own else "not run"
                n = f" (n = {len(own[0]['tasks'])})" if own else ""
                cells.append(f"{ours}{n} / {PAPER[robot][method]}")
            settings = {True: ", paper's settings", False: ", default"}[is_paper]
            rows.append([method + (settings if method == "vrrt" else ""), *cells])
    return table(("method", *(f"{robot}: ours / paper" for robot in ROBOTS)), rows)


def _figure(group: Sequence[dict[str, Any]], path: Path) -> None:
    """Success by level, causes of failure, times and path lengths."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from cycler import cycler
    from matplotlib.ticker import LogFormatter

    figure, axes = plt.subplots(2, 2, figsize=(12, 8), layout="constrained")
    (by_level, causes), (times, lengths) = axes
    lines = cycler(linestyle=["-", "--", ":"]) * plt.rcParams["axes.prop_cycle"]
    for axis in (by_level, times, lengths):
        axis.set_prop_cycle(lines)
    labels, stacks = [], []
    for results in group:
        for name, summary in _variants(results).items():
            rows = results["tasks"]
            if "by_variant" in results:
                rows = [row for row in rows if row["variant"] == name]
            levels = summary["levels"]
            total = sum(v["n"] for v in levels)
            name = f"{name} (n = {total})"
            distance = [level["distance_rad"] for level in levels]
            by_level.plot(distance, [100 * v["success"] for v in levels], marker="o", label=name)
            lengths.plot(
                distance, [v["path_length"] or float("nan") for v in levels], marker="o", label=name
            )
            labels.append(name)
            stacks.append(_cause_shares(levels))
            spent = sorted(row["time_s"] for row in rows)
            times.step(spent, 100 * np.arange(1, len(spent) + 1) / len(spent), label=name)
    _stack_bars(causes, labels, stacks, CAUSES, CAUSE_COLORS)
    by_level.set(xlabel="distance from start to goal [rad]", ylabel="success [%]", ylim=(0, 102))
    causes.set(xlabel="failed tasks [%]", xlim=(0, 100))
    times.set(
        xlabel="planning time without compilation [s]",
        ylabel="tasks done by then [%]",
        xscale="log",
    )
    times.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
    times.xaxis.set_major_formatter("{x:g}")
    lengths.set(xlabel="distance from start to goal [rad]", ylabel="path length [rad]")
    by_level.legend(fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.17))
    causes.legend(fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.17))
    figure.suptitle(f"{group[0]['what']}: {group[0]['robot']}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _ablation_figure(group: Sequence[dict[str, Any]], path: Path) -> None:
    """What becomes of the tasks with each value of each setting."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    labels, stacks = [], []
    for results in sorted(group, key=_is_paper, reverse=True):
        base = "paper's" if _is_paper(results) else "default"
        for name, summary in _variants(results).items():
            shares = _cause_shares(summary["levels"])
            labels.append(f"{base}, {name} (n = {sum(v['n'] for v in summary['levels'])})")
            stacks.append([100 - sum(shares), *shares])
    figure, axis = plt.subplots(figsize=(10, 1.5 + 0.24 * len(labels)), layout="constrained")
    _stack_bars(axis, labels, stacks, ("solved", *CAUSES), (SOLVED_COLOR, *CAUSE_COLORS))
    axis.set(xlabel="tasks [%]", xlim=(0, 100))
    axis.margins(y=0.01)
    figure.legend(fontsize="small", ncols=4, loc="outside lower center")
    figure.suptitle(f"ablation: {group[0]['robot']}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _cause_shares(levels: Sequence[dict[str, Any]]) -> list[float]:
    """Of all tasks, those that failed for each of :data:`CAUSES` [%]."""
    total = sum(level["n"] for level in levels)
    return [
        100 * sum(level["causes"].get(cause, 0) for level in levels) / total for cause in CAUSES
    ]


def _stack_bars(axis, labels: Sequence[str], stacks: Sequence[Sequence[float]], names, colors):
    """A bar for each label, the first on top, of parts with a name and a color each."""
    left = np.zeros(len(labels))
    for width, name, color in zip(np.transpose(stacks), names, colors, strict=True):
        axis.barh(labels, width, left=left, color=color, label=name)
        left += width
    axis.invert_yaxis()


def _level(level: dict[str, Any]) -> str:
    """A level's distance or name; older files have distances only."""
    name = level.get("level", level["distance_rad"])
    return name if isinstance(name, str) else f"{name:g}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"
