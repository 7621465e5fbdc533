"""Errors by joint of the DREAM benchmark: what is told of each level, as a table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vrrt_jax.core.markdown import table


def summarize(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What is told of each level: errors by joint and of all [rad], matches, times."""
    levels = []
    for level in sorted({row["level"] for row in rows}):
        own = [row for row in rows if row["level"] == level]
        read = [row for row in own if "refused" not in row]
        summary: dict[str, Any] = {"level": level, "n": len(read), "refused": len(own) - len(read)}
        if read:
            errors = np.array([row["error_rad"] for row in read])
            times = [row["time_s"] for row in read]
            summary |= {
                "by_joint_rad": np.round(errors.mean(axis=0), 4).tolist(),
                "last_rad": round(float(errors[:, -1].mean()), 4),
                "others_rad": round(float(errors[:, :-1].mean()), 4),
                "mean_rad": round(float(errors.mean()), 4),
                "median_rad": round(float(np.median(errors.mean(axis=1))), 4),
                "matched": sum(row["matched"] for row in read),
                "median_time_s": round(float(np.median(times)), 3),
            }
        levels.append(summary)
    return levels


def to_text(results: Mapping[str, Any]) -> str:
    """A Markdown table with a row for each level, and why frames were refused."""
    filled = [level for level in results["levels"] if level["n"]]
    joints = len(filled[0]["by_joint_rad"]) if filled else 0
    heads = [
        *("start [rad]", "n", "refused", *(f"J{j + 1}" for j in range(joints))),
        *("all but the last", "mean [rad]", "median [rad]", "matched", "median time [s]"),
    ]
    rows = [
        [
            *(f"{level['level']:g}", str(level["n"]), str(level["refused"])),
            *(f"{value:.3f}" for value in level["by_joint_rad"]),
            *(f"{level[name]:.3f}" for name in ("others_rad", "mean_rad", "median_rad")),
            *(str(level["matched"]), f"{level['median_time_s']:.2f}"),
        ]
        for level in filled
    ]
    notes = [f"{r['frame']}: {r['refused']}" for r in results["rows"] if "refused" in r]
    return "\n".join([table(heads, rows), *([""] if notes else []), *notes])
