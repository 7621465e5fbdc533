"""Ctrl-C as a flag, so that work already done survives it; and commands that end soon after it."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

EXIT_INTERRUPTED = 130
GRACE = 0.8  # [s] that a command may take to end by itself after Ctrl-C
LAST = 0.4  # [s] after that
_COMMANDS = ("vrrt", "nrp")
_telling = threading.Lock()  # taken by the one that tells


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Raise KeyboardInterrupt at the end after a Ctrl-C, for what is no result if it ends early."""
    with interruptible() as interrupted:
        yield
    if interrupted.is_set():
        raise KeyboardInterrupt


_interrupted: list[threading.Event] = []  # of the outermost block that runs


@contextlib.contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Turn Ctrl-C into a flag, so that the best path so far survives it; a second one is fatal.

    Blocks inside each other share the flag, and so do those of threads that run meanwhile.
    """
    if _interrupted:
        yield _interrupted[0]
        return
    if threading.current_thread() is not threading.main_thread():
        yield threading.Event()
        return
    event = threading.Event()

    def on_interrupt(signum, frame):
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    previous = signal.signal(signal.SIGINT, on_interrupt)
    _interrupted.append(event)
    try:
        yield event
    finally:
        _interrupted.clear()
        signal.signal(signal.SIGINT, previous)


def is_command() -> bool:
    """Whether this process is one of the commands, not a program that calls them."""
    name = Path(sys.argv[0]).name if sys.argv else ""
    return name in _COMMANDS and threading.current_thread() is threading.main_thread()


def end_at_once_while_starting() -> None:
    """While a command imports its modules, Ctrl-C ends it, with one line.

    An exception in the middle of that may be lost, as others look for errors of their own there.
    """
    if is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: end_interrupted(Path(sys.argv[0]).name))


def end_interrupted(name: str) -> None:
    """Tell the only line that a command has to say after Ctrl-C, and end without waiting."""
    _tell(name)
    os._exit(EXIT_INTERRUPTED)


def _tell(name: str) -> None:
    if _telling.acquire(blocking=False):
        print(f"{name}: interrupted", file=sys.stderr, flush=True)
        sys.stdout.flush()
    for worker in multiprocessing.active_children():
        worker.kill()


@contextlib.contextmanager
def ending_soon(name: str) -> Iterator[None]:
    """A command that gets Ctrl-C has ``GRACE`` to end; then it ends wherever it is.

    A compiler or a simulator may run for long before Python hears of a signal, and an exception
    may be lost. Files are whole at any time, see :mod:`vrrt_jax.core.files`, so that what was done
    is kept.

    Args:
        name: of the command.
    """
    if not is_command():
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.unraisablehook = _without_interrupts
    heard, told = os.pipe()
    os.set_blocking(told, False)
    signal.set_wakeup_fd(told, warn_on_full_buffer=False)

    def watch() -> None:
        while os.read(heard, 1)[0] != signal.SIGINT:
            pass
        time.sleep(GRACE)
        _tell(name)
        time.sleep(LAST)  # what waited for workers, which are gone now, may clean up
        end_interrupted(name)

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    except KeyboardInterrupt:
        _tell(name)  # and clean up, while the watch goes on
        raise


def _without_interrupts(unraisable: "sys.UnraisableHookArgs") -> None:
    """Of an interrupt in the middle of cleaning up, which nobody can catch, nothing is told."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)


@contextlib.contextmanager
def of_parent_alone() -> Iterator[None]:
    """Processes that are begun meanwhile hear no Ctrl-C: their parent does, and ends them."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
