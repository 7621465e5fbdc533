"""Files that are there whole or not at all."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # on a disk
UNFINISHED = ".part"  # how the names of files end while they are written


@contextlib.contextmanager
def replacing(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a file that takes the place of ``path`` when the block ends, unless it raises.

    Args:
        path: a reader sees what it held, or what the block wrote, never a part of that.
        mode: "w" for text, "wb" for bytes.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}{UNFINISHED}")
    try:
        with open(part, mode, newline=None if "b" in mode else "") as file:
            yield file
        part.replace(path)
    except OSError as error:
        # What runs out of room while it writes does not say where.
        if error.errno in NO_ROOM and error.filename is None:
            error.filename = str(path)
        raise
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, see :func:`replacing`."""
    with replacing(path, "w") as file:
        file.write(text)
