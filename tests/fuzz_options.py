"""Odd values for the options of both commands: one or two options of a valid command at a time."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

NUMBERS = (
    *("nan", "inf", "-inf", "-1", "0", "-0", "1", "3", "0.5", "1e309", "1e-320", "1e18", "0x10"),
    *("1000000007", "99999999999999999999", "-99999999999999999999", "1_0", "1.5e0", "+2"),
)
LISTS = ("1,2", ",", "1,,2", "0,0,0,0,0,0,0", "nan,nan", "1e300,1e300", "[1, 2]", "1;2", "a=1,b=2")
TEXTS = (
    *("", " ", "a", "None", "true", "ü", "\udcff", "%s", "{}", "-", "a=nan", "a=", "=1", "../x"),
    *("x" * 5000, "two\nlines", "two words", "*", "$HOME", "~", "random", "hard", "side"),
)
PLACES = ("/proc", "/dev/null", "/proc/1/x", ".", "..", "/proc/self/mem", "/dev/full")
# Commands that read no file, in few words.
BARE = {
    "vrrt": (
        ["bench", "kinematics"],
        ["bench", "raster"],
        ["bench", "search"],
        ["bench", "twins"],
        ["bench", "visual", "--robot", "panda"],
        ["bench", "pose", "--robot", "ur5e"],
        ["bench", "ablation", "--robot", "fetch"],
        ["plan", "--problem", "panda_open", "--out", "OUT"],
        ["fit", "--robot", "panda", "--out", "OUT/new"],
        ["doctor"],
    ),
    "nrp": (
        ["homes", "--out", "OUT/homes.png"],
        ["data", "--task", "fetch", "--out", "OUT/data"],
        ["bench", "checks"],
        ["bench", "plan", "--task", "snake", "--methods", "rrt"],
        ["bench", "growth", "--methods", "rrt"],
        ["bench", "curves", "--planners", "rrt", "--nodes", "0"],
        ["plan", "--problem", "home_1", "--out", "OUT"],
    ),
}


def options(parser: argparse.ArgumentParser, words: Sequence[str]) -> list[argparse.Action]:
    """The options of the sub-command that the first words name."""
    for word in words:
        found = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        if not found:
            break
        parser = found[0].choices[word]
    return [a for a in parser._actions if a.option_strings and a.dest != "help"]


def odd(
    rng: np.random.Generator, parser: argparse.ArgumentParser, words: list[str], files: list[Path]
) -> tuple[list[str], str]:
    """The command with one or two odd options more, and what was done."""
    known = options(parser, words)
    added = []
    for action in rng.choice(np.array(known, object), min(len(known), int(rng.integers(1, 3)))):
        name = action.option_strings[-1]
        if action.nargs == 0:
            added.append(name)
            continue
        pool = (NUMBERS, LISTS, TEXTS, PLACES, [str(f) for f in files], list(action.choices or ()))
        values = pool[int(rng.choice(6, p=(0.4, 0.15, 0.2, 0.1, 0.05, 0.1)))] or NUMBERS
        added.append(f"{name}={values[int(rng.integers(len(values)))]}")
    return [*words, *added], " ".join(added)[:200]
