"""Files of results that grow while a benchmark runs, and are gone on with later."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vrrt_jax.core.data_file import check_file, read_json, read_text
from vrrt_jax.core.files import replacing


def resume(file: Path, header: Mapping[str, Any], fresh: dict[str, Any]) -> dict[str, Any]:
    """What the file holds; without a file, ``fresh``, which is written at once.

    Args:
        file: JSON.
        header: what the file must agree on.
        fresh: the results of a run that has just begun; they hold the header.

    Raises:
        ValueError: the file holds another benchmark, version or seed.
        OSError: the file cannot be written.
    """
    if not file.exists():
        write(file, fresh)  # a bad path is told before hours of work
        return fresh
    try:
        results = read_json(file)
        old = {name: results[name] for name in header}
        own = [name for name in fresh if name not in header]
        missing = [name for name in own if type(results.get(name)) is not type(fresh[name])]
        if missing:
            raise ValueError(f"it lacks {', '.join(missing)} as a run writes it")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"'{file}' is no results file of this version ({error!r}); choose another --json"
        ) from None
    _check_alike(file, old, header)
    return results


def resume_rows(file: Path, header: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows that a run has left in a file that grows, to go on with; a new file begins here.

    The first line is the header, each other one a row. A last line that was cut off while it was
    written is taken away.

    Args:
        file: JSON lines, see :func:`append_row`.
        header: what the file must agree on.

    Raises:
        ValueError: the file is none of this kind, or of another benchmark, version or seed.
        OSError: the file cannot be written.
    """
    text = read_text(file, "JSON lines") if file.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        with replacing(file, "w") as handle:
            handle.write(whole)
    if not whole:
        append_row(file, header)
        return []
    try:
        old, *rows = [json.loads(line) for line in whole.splitlines()]
        old = {name: old[name] for name in header}
        if not all(isinstance(row, dict) for row in rows):
            raise ValueError("a row is no object")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(
            f"'{file}' holds no rows of this version ({error!r}); choose another --json"
        ) from None
    _check_alike(file, old, header)
    return rows


def append_row(file: Path, row: Mapping[str, Any]) -> None:
    """Write one more line, which is on the disk when this returns.

    Raises:
        OSError: the file cannot be written.
    """
    with open(file, "a") as handle:
        handle.write(json.dumps(row) + "\n")
        handle.flush()
        os.fsync(handle.fileno())


def _check_alike(file: Path, old: Mapping[str, Any], header: Mapping[str, Any]) -> None:
    for name, value in header.items():
        if old[name] != value:
            raise ValueError(
                f"'{file}' has {name} {old[name]!r}, this run {value!r}: results of different "
                "runs are not mixed; choose another --json"
            )


def write(file: Path, results: Mapping[str, Any]) -> None:
    """Replace the file at once; if that fails, what it held stays.

    Raises:
        OSError: the file cannot be written.
    """
    try:
        with replacing(file, "w") as handle:
            handle.write(json.dumps(results, indent=1) + "\n")
    except OSError as error:
        kept = "what it held is kept, and the same command goes on from there"
        raise OSError(error.errno, f"{error.strerror}; {kept}", str(file)) from None


def fingerprint(file: Path) -> str:
    """Of what is in a file.

    Raises:
        FileNotFoundError: there is none.
    """
    return hashlib.sha256(check_file(file).read_bytes()).hexdigest()[:12]


def plain(fields: Mapping[str, Any]) -> dict[str, Any]:
    """What JSON gives back unchanged."""
    return json.loads(json.dumps(fields))
