"""Every option of every command: what makes no sense is one line and the exit code 2."""

import argparse
import subprocess
import sys

import pytest

import nrp_jax.cli
import vrrt_jax.cli
from vrrt_jax.core import command

CLIS = {"vrrt": vrrt_jax.cli, "nrp": nrp_jax.cli}
PARSERS = {name: cli._parser() for name, cli in CLIS.items()}
NO_NUMBERS = ("nan", "inf", "-inf", "1e400", "9" * 400, "ten", "", " ", "0x10", "1,2")
NO_LISTS = ("", ",", "0,,1", "nan,0", "0,inf", "1e300", "a,b", "0;1", " ")


def leaves(parser, words=()):
    """Every command with its words and its options."""
    groups = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if not groups:
        yield words, parser
    for group in groups:
        for name, child in group.choices.items():
            yield from leaves(child, (*words, name))


COMMANDS = [
    (name, words, parser) for name, cli in CLIS.items() for words, parser in leaves(cli._parser())
]
OPTIONS = [
    (name, words, action)
    for name, words, parser in COMMANDS
    for action in parser._actions
    if action.nargs != 0
]


def ends_with(parse, words, capsys):
    """The exit code of a command, and the lines that it tells."""
    try:
        code = parse(list(words))
    except SystemExit as ended:
        code = ended.code
    return code, capsys.readouterr().err.splitlines()


def kind_of(action):
    """A number, a list of numbers or a text."""
    parse = action.type
    if parse is command.words:
        return "text"
    try:
        value = parse("1")
    except argparse.ArgumentTypeError:
        return "list"
    return "number" if isinstance(value, int | float) else "list"


@pytest.mark.parametrize(
    ("name", "words", "action"),
    OPTIONS,
    ids=[" ".join([n, *w, a.dest]) for n, w, a in OPTIONS],
)
def test_what_makes_no_sense_is_one_line(name, words, action, capsys):
    assert action.type not in (None, int, float, str), "an option that nobody checks"
    bad = {"text": ("", "   ", "a\0b"), "number": NO_NUMBERS, "list": NO_LISTS}[kind_of(action)]
    for value in bad:
        given = [f"{action.option_strings[-1]}={value}"] if action.option_strings else [value]
        code, told = ends_with(PARSERS[name].parse_args, [*words, *given], capsys)
        assert code == 2 and len(told) == 1, (value, told)
        assert "required" not in told[0]


@pytest.mark.parametrize(
    ("name", "words", "action"),
    [option for option in OPTIONS if kind_of(option[2]) == "number"],
    ids=[" ".join([n, *w, a.dest]) for n, w, a in OPTIONS if kind_of(a) == "number"],
)
def test_numbers_have_a_range(name, words, action, capsys):
    for value in ("-1000000", "1e12", "99999999999"):
        code, told = ends_with(
            PARSERS[name].parse_args, [*words, f"{action.option_strings[-1]}={value}"], capsys
        )
        assert code == 2 and len(told) == 1 and "expected" in told[0], told


def test_two_dashes_are_no_value(capsys):
    code, told = ends_with(vrrt_jax.cli.main, ["plan", "--seed=--"], capsys)
    assert code == 2 and told == ["vrrt: argument --seed: expected a value; see vrrt --help"]


def test_bad_options_are_told_before_anything_is_loaded():
    """The parser alone answers: no robot, no compilation."""
    wrong = ["plan", "--problem", "panda_posts", "--seed", "-1"]
    done = subprocess.run(
        [sys.executable, "-m", "vrrt_jax.cli", *wrong], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "--seed" in done.stderr and "expected a whole number from 0" in done.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["vrrt", "bench", "arm", "--problems=x", "--robot=panda", "--base=1,2,3"], "x,y,z,yaw"),
        (["vrrt", "render", "--robot=panda", "--q=1", "--camera=c", "--size=0x5"], "480x480"),
        (["vrrt", "render", "--robot=panda", "--q=1", "--camera=c", "--size=9x99999"], "8192"),
        (["vrrt", "worlds", "--out=x", "--robot=panda", "--freeze=a=nan"], "finger=0.04"),
        (["vrrt", "worlds", "--out=x", "--robot=panda", "--freeze=a=1,a=2"], "once"),
        (["nrp", "plan", "--map=x", "--start=1,2", "--goal=1,2"], "the start has shape (2,)"),
        (
            ["nrp", "plan", "--map=x", "--start=" + "1," * 7 + "1", "--goal=1"],
            "the goal has shape (1,)",
        ),
    ],
)
def test_lengths_and_names(words, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, lines = ends_with(CLIS[words[0]].main, words[1:], capsys)
    assert code == 2 and len(lines) == 1 and told in lines[0]
