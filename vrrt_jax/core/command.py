"""What the command lines share: exit codes, one-line errors, compiled programs, workers."""

import argparse
import contextlib
import math
import multiprocessing.util
import os
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from vrrt_jax.core.files import NO_ROOM
from vrrt_jax.core.interrupt import EXIT_INTERRUPTED, ending_soon, is_command

EXIT_SOLVED, EXIT_UNSOLVED, EXIT_BAD_INPUT = 0, 1, 2
EXIT_UNREAD = 141  # as a shell says of what a closed pipe ends
LARGEST = 1e9  # of numbers in lists
_LONGEST = 600  # characters of a message
# Those whose messages are for users. Others are named, with what to do.
KNOWN_ERRORS = (ValueError, OSError, RuntimeError, ModuleNotFoundError)


class Parser(argparse.ArgumentParser):
    """A parser, also of sub-commands, whose help tells the defaults that are set.

    What is wrong with an argument is told in one line. Texts must not be empty.
    """

    def __init__(self, *args: Any, **settings: Any):
        """See :class:`argparse.ArgumentParser`."""
        settings.setdefault("formatter_class", _Defaults)
        super().__init__(*args, **settings)

    def add_argument(self, *names: str, **settings: Any) -> argparse.Action:
        """See :class:`argparse.ArgumentParser`; an argument without a type is :func:`words`."""
        if names and "action" not in settings:
            settings.setdefault("type", words)
        return super().add_argument(*names, **settings)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """See :class:`argparse.ArgumentParser`, which takes ``--seed=--`` for no value at all."""
        found = super().parse_args(args, namespace)
        for name, value in vars(found).items():
            if isinstance(value, list) and not value:
                self.error(f"argument --{name.replace('_', '-')}: expected a value")
        return found

    def error(self, message: str) -> NoReturn:
        """End with the exit code 2 and one line."""
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: {_on_one_line(message)}; see {self.prog} --help\n")


class _Defaults(argparse.ArgumentDefaultsHelpFormatter):
    def _get_help_string(self, action: argparse.Action) -> str | None:
        told = action.default not in (None, False) and not action.required
        return super()._get_help_string(action) if told else action.help


def run(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> int:
    """Run what the chosen sub-command has set as ``run``; what goes wrong becomes one line.

    After Ctrl-C a command ends within two seconds.

    ``VRRT_TRACEBACK=1`` shows where it happened too.

    Returns:
        The exit code: 0 solved or done, 1 not solved, 2 bad input, 130 interrupted, 141 if nobody
        reads what is printed.
    """
    try:
        arguments = parser.parse_args(argv)
    except SystemExit as ended:  # of --help, or of an option that makes no sense
        return int(ended.code or 0)
    name = f"{parser.prog} {arguments.command}"
    try:
        with ending_soon(name):
            _check_outputs(arguments)
            _set_up_jax(parser.prog)
            code = arguments.run(arguments)
            sys.stdout.flush()
            return code
    except BrokenPipeError:  # of what reads along, such as head
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        return EXIT_UNREAD
    except Exception as error:
        print(f"{name}: {in_one_line(error)}", file=sys.stderr)
        if os.environ.get("VRRT_TRACEBACK"):
            traceback.print_exc()
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        if is_command():
            # It has been told. Threads that still compile would crash where Python takes itself
            # apart; all that has to be put away is what processes share.
            sys.stdout.flush()
            multiprocessing.util._exit_function()
            os._exit(EXIT_INTERRUPTED)
        print(f"{name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def in_one_line(error: Exception) -> str:
    """What went wrong, where, and what to do."""
    text = _on_one_line(str(error))
    if isinstance(error, MemoryError):
        return (
            f"out of memory ({text or 'no more is to be had'}); close other programs, or ask for "
            "less: smaller files, fewer nodes, images or processes"
        )
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        return f"{text}; make room on that disk, or choose another place"
    if isinstance(error, OSError) and error.errno is not None:
        return f"{text}; check that path and its permissions"
    if isinstance(error, KNOWN_ERRORS):
        return text or type(error).__name__
    kind = type(error)
    return (
        f"{kind.__module__}.{kind.__qualname__}: {text or 'no message'}; check the files that were "
        "given, or see where it happened with VRRT_TRACEBACK=1"
    )


def _on_one_line(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Check, before any work, that what a command writes can be written.

    ``--json``, ``--figure`` and ``--trajectory`` name files. ``--out`` does where the parser says
    ``out_is_file``.

    Raises:
        OSError: names the place that cannot be written.
    """
    files = ["json", "figure", "trajectory"] + ["out"] * getattr(arguments, "out_is_file", False)
    for name in ("out", "json", "figure", "trajectory"):
        place, option = getattr(arguments, name, None), f"--{name}"
        if place is None:
            continue
        if name not in files:
            writable_folder(place, option)
            continue
        file = Path(place)
        writable_folder(file.parent, option)
        if file.is_dir():
            raise OSError(f"'{file}' is a folder; expected a file with {option}")
        if file.exists() and not os.access(file, os.W_OK):
            raise OSError(f"cannot write '{file}': it is read-only; choose another with {option}")


@contextlib.contextmanager
def or_printed(text: Callable[[], str]) -> Iterator[None]:
    """If what the block writes cannot be written, its text is printed before the error is told."""
    try:
        yield
    except OSError:
        print(text(), flush=True)
        raise


def writable_folder(folder: str | Path, option: str = "--out") -> Path:
    """The folder, made if need be; an error before any work if it cannot be written to.

    Raises:
        OSError: names the folder, and the option to choose another with.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"0" * 4096)
            file.flush()
    except OSError as error:
        raise OSError(
            f"cannot write to the folder '{folder}': {error.strerror}; choose another with {option}"
        ) from None
    return folder


def add_port(parser: argparse.ArgumentParser) -> None:
    """Add ``--port`` of a page in the browser."""
    parser.add_argument(
        "--port", type=whole(1, 65535), help="of 127.0.0.1; a free one if it is not given"
    )


def words(text: str) -> str:
    """An argument that is not empty, and is UTF-8."""
    if not text.strip() or "\0" in text:
        raise argparse.ArgumentTypeError("the text is empty; expected a word or a path")
    if any("\ud800" <= letter <= "\udfff" for letter in text):
        raise argparse.ArgumentTypeError(f"{text!r} is not UTF-8, so it cannot be written down")
    return text


def whole(low: int, high: int) -> Callable[[str], int]:
    """The type of an argument that is a whole number between two others."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f"'{_short(text)}'; expected a whole number from {low} to {high}"
            )
        return value

    return parse


seed = whole(0, 2**31 - 1)


def real(low: float, high: float) -> Callable[[str], float]:
    """The type of an argument that is a number between two others."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f"'{_short(text)}'; expected a number from {low:g} to {high:g}"
            )
        return value

    return parse


seconds = real(0.0, 1e9)


def numbers(text: str) -> Any:
    """An argument such as 0,0.3,-1.2 as an array (n,) of float32."""
    import numpy as np

    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(abs(value) <= LARGEST for value in values):
        raise argparse.ArgumentTypeError(
            f"'{_short(text)}' is not a list of numbers such as 0,0.3,-1.2"
        )
    return np.array(values, np.float32)


def _short(text: str) -> str:
    return text if len(text) < 60 else f"{text[:60]}..."


def usable_cores() -> int:
    """The number of cores that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable else os.cpu_count() or 1


def end_with_parent() -> None:
    """Call this in a worker process: it ends when the one that started it is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "this is no worker"

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _set_up_jax(name: str) -> None:
    """Single precision; and compiled programs that are kept between runs.

    The user may have said where they are kept, or that they are not.
    """
    import jax

    from vrrt_jax.core.compiling import keep_programs

    os.environ["JAX_ENABLE_X64"] = "0"  # also of worker processes
    jax.config.update("jax_enable_x64", False)
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    keep_programs(str(home / f"{name}_jax"))
