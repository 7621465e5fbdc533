"""What the command lines share: exit codes, one-line errors, compiled programs, workers."""

import argparse
import multiprocessing
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

EXIT_SOLVED, EXIT_UNSOLVED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 0, 1, 2, 130


class Parser(argparse.ArgumentParser):
    """A parser, also of sub-commands, whose help tells the defaults that are set."""

    def __init__(self, *args: Any, **settings: Any):
        """See :class:`argparse.ArgumentParser`."""
        settings.setdefault("formatter_class", _Defaults)
        super().__init__(*args, **settings)


class _Defaults(argparse.ArgumentDefaultsHelpFormatter):
    def _get_help_string(self, action: argparse.Action) -> str | None:
        told = action.default not in (None, False) and not action.required
        return super()._get_help_string(action) if told else action.help


def run(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> int:
    """Run what the chosen sub-command has set as ``run``; bad input becomes one line.

    Returns:
        The exit code: 0 solved or done, 1 not solved, 2 bad input, 130 interrupted.
    """
    arguments = parser.parse_args(argv)
    _use_compilation_cache(parser.prog)
    try:
        return arguments.run(arguments)
    except (ValueError, OSError, RuntimeError, ModuleNotFoundError) as error:
        print(f"{parser.prog} {arguments.command}: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(f"{parser.prog} {arguments.command}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def numbers(text: str) -> Any:
    """An argument such as 0,0.3,-1.2 as an array (n,) of float32."""
    import numpy as np

    try:
        return np.array([float(part) for part in text.split(",")], np.float32)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a list such as 0,0.3,-1.2") from None


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


def _use_compilation_cache(name: str) -> None:
    """Keep compiled programs between runs, unless the user has said where or not at all."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    import jax

    jax.config.update("jax_compilation_cache_dir", str(home / f"{name}_jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
