"""Ctrl-C as a flag, so that work already done survives it."""

import contextlib
import signal
import threading
from collections.abc import Iterator


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
