"""Results of joint goals as a table, and what was refused."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from vrrt_jax.core.markdown import table

HEADS = (
    "scene",
    "planner",
    "solved",
    "median [ms]",
    "95 % [ms]",
    "search [ms]",
    "shorten [ms]",
    "verify [ms]",
    "raw cost [rad]",
    "cost [rad]",
    "batch [1/s]",
    "refused by the exact check",
)


def to_text(results: Mapping[str, Any]) -> str:
    """A Markdown table with a row for each file and planner, and a line about what was refused."""
    rows, notes = [], []
    for scene, found in results["scenes"].items():
        planned = found["n"] - len(found["refused"])
        own = {results["planner"]: found}
        for planner, summary in (own | found.get("peers", {})).items():
            stages = summary["stages_ms"]
            rows.append(
                [
                    scene,
                    planner if summary is found else f"OMPL {planner}",
                    f"{summary['solved']}/{planned}",
                    *(_number(summary[name]) for name in ("median_ms", "p95_ms")),
                    *(_number(stages.get(name)) for name in ("search", "shortcut", "verify")),
                    *(_number(summary[name], 2) for name in ("raw_cost", "cost")),
                    _number(summary.get("batch_problems_per_s")),
                    _number(summary.get("refused_paths"), 0),
                ]
            )
        notes.append(_note(scene, found))
    return "\n".join([table(HEADS, rows), "", *notes])


def _note(scene: str, found: Mapping[str, Any]) -> str:
    """What a reader must know about the problems of a file."""
    kinds = Counter(refusal["kind"] for refusal in found["refused"])
    told = ", ".join(f"{kind} {count}" for kind, count in kinds.items()) or "none"
    said = [f"refused: {told} of {found['n']}"]
    if found["held_attached"]:
        said.append(f"the hand holds something in {found['held_attached']} of the others")
    if found["recompiled"]:
        said.append(f"{found['recompiled']} compiled again, and were timed after that")
    return f"{scene}: {'; '.join(said)}"


def _number(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"
