"""What goes wrong in a command is one line: what, where, and what to do."""

import argparse
import errno
import json
import subprocess
import sys
import zipfile

import jax
import mujoco
import pytest
from PIL import Image, UnidentifiedImageError

from vrrt_jax.core import command


def run_with(error, capsys, **places):
    """What a command says that fails with this error."""
    parser = command.Parser(prog="try")
    commands = parser.add_subparsers(dest="command")

    def work(arguments):
        raise error

    child = commands.add_parser("it")
    child.set_defaults(run=work, **places)
    code = command.run(parser, ["it"])
    return code, capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError("Unable to allocate 9. TiB"), ("out of memory", "9. TiB", "smaller")),
        (MemoryError(), ("out of memory", "close other programs")),
        (OSError(errno.ENOSPC, "No space left on device", "/x/y"), ("/x/y", "make room")),
        (PermissionError(errno.EACCES, "Permission denied", "/x/y"), ("/x/y", "permissions")),
        (zipfile.BadZipFile("File is not a zip file"), ("zipfile.BadZipFile", "check the files")),
        (mujoco.FatalError("engine error\n in line 3"), ("engine error in line 3", "check")),
        (Image.DecompressionBombError("too many pixels"), ("too many pixels", "check the files")),
        (UnidentifiedImageError("cannot identify 'x.png'"), ("x.png",)),
        (json.JSONDecodeError("Expecting value", "", 0), ("Expecting value",)),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out\nof memory"), ("RESOURCE_EXH",)),
        (KeyError("mask"), ("KeyError", "mask", "VRRT_TRACEBACK")),
        (RuntimeError("x" * 5000), ("xxx ...",)),
        (AssertionError(), ("AssertionError", "no message")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_errors_of_others_are_one_line(error, words, capsys):
    code, told = run_with(error, capsys)
    assert code == 2 and len(told) == 1 and told[0].startswith("try it: ")
    for word in words:
        assert word in told[0]


def test_where_it_happened_is_told_on_demand(capsys, monkeypatch):
    monkeypatch.setenv("VRRT_TRACEBACK", "1")
    _, told = run_with(KeyError("mask"), capsys)
    assert any("in work" in line for line in told)


def test_places_are_checked_before_work(tmp_path, capsys):
    never = AssertionError("work has begun")
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.json").mkdir()
    for places, words in (
        ({"out": str(tmp_path / "file" / "below")}, ("file", "--out")),
        ({"out": str(tmp_path / "file")}, ("file", "--out")),
        ({"json": str(tmp_path / "folder.json")}, ("is a folder", "--json")),
        ({"json": str(tmp_path / "file" / "x.json")}, ("file", "--json")),
        ({"figure": str(tmp_path / "file" / "x.png")}, ("file", "--figure")),
        ({"out": str(tmp_path), "out_is_file": True}, ("is a folder", "--out")),
        ({"out": "/proc/nowhere/here"}, ("/proc/nowhere", "--out")),
    ):
        code, told = run_with(never, capsys, **places)
        assert code == 2 and len(told) == 1 and "work has begun" not in told[0]
        for word in words:
            assert word in told[0]


def test_a_folder_for_a_file_is_made(tmp_path, capsys):
    _, told = run_with(ValueError("done"), capsys, json=str(tmp_path / "new" / "x.json"))
    assert told == ["try it: done"] and (tmp_path / "new").is_dir()


def test_what_cannot_be_written_is_printed(capsys):
    with pytest.raises(OSError, match="full"), command.or_printed(lambda: "the path"):
        raise OSError("full")
    assert capsys.readouterr().out == "the path\n"


def test_parsers_take_texts_and_numbers_only_in_range():
    assert command.whole(1, 5)("5") == 5 and command.real(0, 1)("0.5") == 0.5
    assert command.numbers("1,-2.5").tolist() == [1.0, -2.5]
    for parse, text in ((command.whole(1, 5), "6"), (command.real(0, 1), "nan")):
        with pytest.raises(argparse.ArgumentTypeError, match="expected"):
            parse(text)


@pytest.mark.parametrize("module", ["vrrt_jax", "nrp_jax", "vrrt_jax.cli", "nrp_jax.cli"])
def test_modules_are_commands(module):
    words = [sys.executable, "-m", module]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "required: command" in done.stderr


def test_nothing_is_said_where_nobody_reads():
    """As of ``vrrt doctor | head -1``."""
    words = [sys.executable, "-m", "vrrt_jax", "doctor"]
    run = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.stdout is not None and run.stderr is not None
    run.stdout.close()
    assert run.stderr.read() == b"" and run.wait(timeout=60) == command.EXIT_UNREAD
