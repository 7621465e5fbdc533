"""From rows of results to curves: success and path optimality over time, expansions and checks.

The relative path optimality of a query is the cost of a reference over the cost of the planner's
best path so far, at most 1; it is 0 while there is no path, and where the exact check refuses the
path of the end (Lu et al. 2024). Letters: ``n`` rows, ``T`` points of a curve.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

REFERENCE = (
    "of each query the shorter of two: the shortest path through a dense roadmap that start and "
    "goal are joined to, where there is one, and the shortest verified path of all planners and "
    "runs in this file"
)
NOTES = (
    "seconds are those of the search, compilation and the exact check excluded",
    "the path that a planner ends with is shortened and judged by the exact check with C MuJoCo: "
    "if it is refused, the query counts as not solved from its beginning",
    "a search ends with its budget of time: over expansions and checks it is not solved from there",
    "an expansion is a lane of an iteration, for a planner of OMPL an edge that was checked",
)
_COLUMNS = {"time_s": 0, "expansions": 1, "checks": 2}  # of a step


def references(
    rows: Sequence[Mapping[str, Any]], roadmaps: Mapping[str, Sequence[float | None]]
) -> dict[str, list[float | None]]:
    """Costs that paths are compared with, by home and query; None where nothing is known.

    Args:
        rows: of planners.
        roadmaps: costs of each home's queries.
    """
    best: dict[str, dict[int, float]] = {}
    for home, costs in roadmaps.items():
        known = {query: cost for query, cost in enumerate(costs) if cost is not None}
        best[home] = known
    for row in rows:
        if row["solved"]:
            known = best.setdefault(row["home"], {})
            known[row["query"]] = min(row["cost"], known.get(row["query"], math.inf))
    most = {row["home"]: 1 + row["query"] for row in sorted(rows, key=lambda row: row["query"])}
    return {home: [best.get(home, {}).get(query) for query in range(n)] for home, n in most.items()}


def curves(
    rows: Sequence[Mapping[str, Any]],
    reference: Mapping[str, Sequence[float | None]],
    grids: Mapping[str, Sequence[float]],
) -> dict[str, Any]:
    """The curves of one planner.

    Args:
        rows: n of this planner, one at least.
        reference: from :func:`references`.
        grids: where curves have points: ``time_s`` [s], ``expansions`` and ``checks``, (T) each.

    Returns:
        ``n``; ``time_s``, ``success`` and ``optimality`` (T) with ``success_deviation`` and
        ``optimality_deviation``: over runs where there are several, otherwise the standard error of
        the mean of all queries. Under ``expansions`` and ``checks`` the same with ``at`` for the
        points. ``median_first_s`` is the median time of a first path, None if less than half have
        one; ``not_verified`` how many paths the exact check refused at the end; ``refused`` how
        many it refused in all; ``optimality_shortened`` that of the path after it was shortened.
    """
    own = [reference[row["home"]][row["query"]] for row in rows]
    runs = np.array([row["run"] for row in rows])
    firsts = [row["steps"][0][0] if row["solved"] else math.inf for row in rows]
    first_s = float(np.median(firsts))
    final = [
        cost / max(row["cost"], cost) if row["solved"] and cost else 0.0
        for row, cost in zip(rows, own, strict=True)
    ]
    found: dict[str, Any] = {"n": len(rows)}
    for name, grid in grids.items():
        pairs, column = zip(rows, own, strict=True), _COLUMNS[name]
        scores = np.array([_scores(row, cost, grid, column) for row, cost in pairs])
        part = {"success": scores[:, 0], "optimality": scores[:, 1]}
        figures = {"time_s" if name == "time_s" else "at": list(grid)}
        for what, values in part.items():
            figures[what] = np.round(values.mean(0), 4).tolist()
            figures[f"{what}_deviation"] = np.round(_deviation(values, runs), 4).tolist()
        found |= figures if name == "time_s" else {name: figures}
    return found | {
        "median_first_s": round(first_s, 4) if math.isfinite(first_s) else None,
        "optimality_shortened": round(float(np.mean(final)), 4),
        "not_verified": sum(row["status"] == "NOT_VERIFIED" for row in rows),
        "refused": sum(row["refused"] for row in rows),
        "causes": {s: sum(r["status"] == s for r in rows) for s in {r["status"] for r in rows}},
    }


def grid_to(last: float, first: float) -> list[float]:
    """1, 2 and 5 times powers of ten, from ``first``, and the last point itself."""
    powers = range(math.floor(math.log10(first)), math.ceil(math.log10(max(last, first))) + 1)
    points = [digit * 10.0**power for power in powers for digit in (1, 2, 5)]
    inside = [float(f"{p:.6g}") for p in points if first * 0.999 <= p < last * 0.999]
    return [*inside, float(f"{last:.6g}")]


def _scores(
    row: Mapping[str, Any], reference: float | None, grid: Sequence[float], column: int
) -> tuple[np.ndarray, np.ndarray]:
    """Success and optimality (T) of a row; at a time, expansions or checks at most."""
    if not row["solved"]:
        return np.zeros(len(grid)), np.zeros(len(grid))
    steps = np.array(row["steps"])
    # How many steps there are by then; the last of them has the best cost so far.
    count = np.searchsorted(steps[:, column], np.array(grid) * (1 + 1e-9), side="right")
    cost = np.append(math.inf, steps[:, 3])[count]
    return (count > 0).astype(float), np.minimum((reference or 0.0) / cost, 1.0)


def _deviation(values: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Of values (n, T): that of the means of runs, or with one run the standard error (T)."""
    numbers = np.unique(runs)
    if len(numbers) == 1:
        return values.std(0) / math.sqrt(len(values))
    return np.std([values[runs == number].mean(0) for number in numbers], axis=0)
