"""Numbers of the Neural Randomized Planner's authors, beside which curves are drawn.

They are of other homes (scans of Gibson), other queries, planners in Python and another machine.
The paper prints its curves as figures only. Those of the snake are from results of a development
run in the code that came with the paper: 250 queries, a single run, older networks. Of CVAE-IRRT*
there are none.
"""

from collections.abc import Mapping
from typing import Any

SOURCES = {
    "snake": "authors' code, development run (Python, Gibson homes, 250 queries)",
    "fetch": "paper, its real home (Python, 10 queries x 10 runs)",
}
# Success: of each task, over the quantity and by planner, the points (T) and the shares (T).
SUCCESS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "snake": {
        "time_s": {
            "at": (1.0, 2.0, 3.0),
            "rrt": (0.26, 0.29, 0.31),
            "rrt-is": (0.59, 0.67, 0.70),
            "cvae-rrt": (0.35, 0.41, 0.45),
            "nrp-d": (0.74, 0.78, 0.84),
            "nrp-g": (0.76, 0.82, 0.84),
            "irrt-star": (0.22, 0.26, 0.28),
            "bit-star": (0.63, 0.70, 0.75),
            "nrp-star-d": (0.68, 0.76, 0.78),
            "nrp-star-g": (0.71, 0.80, 0.82),
        },
        "expansions": {
            "at": (25, 100, 300),
            "rrt": (0.03, 0.08, 0.16),
            "rrt-is": (0.18, 0.32, 0.47),
            "cvae-rrt": (0.13, 0.19, 0.31),
            "nrp-d": (0.44, 0.66, 0.78),
            "nrp-g": (0.38, 0.66, 0.77),
            "irrt-star": (0.03, 0.06, 0.11),
            "bit-star": (0.25, 0.44, 0.58),
            "nrp-star-d": (0.37, 0.60, 0.76),
            "nrp-star-g": (0.31, 0.58, 0.74),
        },
    },
    "fetch": {"time_s": {"at": (7.0,), "nrp-d": (0.90,), "rrt-is": (0.40,)}},
}
# What the paper says of path optimality, in words only.
OPTIMALITY = {
    "snake": "In words, the paper's NRP* has paths 30 % better than NEXT's and 7 % than BIT*'s.",
    "fetch": "In words, the paper's NRP* has paths 50 % better than FIRE*'s and 25 % than BIT*'s.",
}
# Table I, of the snake: what a unit of visibility and a meter nearer to the goal take, in
# milliseconds and in expansions. How dense the configurations are that may be seen is not told, so
# that only ratios compare.
GROWTH: Mapping[str, tuple[float, float, float, float]] = {
    "rrt": (1.70, 266.0, 1.742, 208.9),
    "nrp-d": (0.70, 123.0, 0.227, 35.5),
    "nrp-g": (0.86, 111.0, 0.308, 31.0),
}
