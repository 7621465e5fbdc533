"""Files of results that grow while a benchmark runs, and are gone on with later."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
        results = json.loads(file.read_text())
        old = {name: results[name] for name in header}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"'{file}' is no results file of this version ({error!r}); choose another --json"
        ) from None
    for name, value in header.items():
        if old[name] != value:
            raise ValueError(
                f"'{file}' has {name} {old[name]!r}, this run {value!r}: results of different "
                "runs are not mixed; choose another --json"
            )
    return results


def write(file: Path, results: Mapping[str, Any]) -> None:
    """Replace the file at once; if that fails, what it held stays.

    Raises:
        OSError: the file cannot be written.
    """
    try:
        with replacing(file, "w") as handle:
            handle.write(json.dumps(results, indent=1) + "\n")
    except OSError as error:
        raise OSError(
            f"cannot write '{file}': {error.strerror}; what it held is kept, and the same command "
            "goes on from there"
        ) from None


def fingerprint(file: Path) -> str:
    """Of what is in a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def plain(fields: Mapping[str, Any]) -> dict[str, Any]:
    """What JSON gives back unchanged."""
    return json.loads(json.dumps(fields))
