"""A robot as a folder, which ``vrrt fit`` makes and :func:`vrrt_jax.load_robot` reads.

``robot.xml`` is the collision model, as of the packaged robots; ``self_model.npz`` is how the robot
looks. ``robot.json`` says what both were made of. It is written first, with no rounds of training
done, and again after each round.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vrrt_jax.core.data_file import check_file, read_json
from vrrt_jax.core.fields import record_of
from vrrt_jax.core.files import replacing

FORMAT = 1
MODEL, SELF_MODEL, RECORD = "robot.xml", "self_model.npz", "robot.json"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """What ``robot.json`` holds."""

    name: str  # of the robot
    # What it was made of. The same folder is gone on with only from the same.
    made_of: Mapping[str, Any]
    source_sha256: str  # of the file that it was made of
    model_sha256: str  # of robot.xml
    versions: Mapping[str, str]  # of the packages that made it
    rounds: int = 0  # of training that are done
    minutes: float = 0.0  # that these took
    levels: tuple[Mapping[str, Any], ...] = ()  # of the self-model, the close-up last
    format: int = FORMAT


def sha256(file: Path) -> str:
    """A fingerprint of a file's bytes."""
    return hashlib.sha256(check_file(file).read_bytes()).hexdigest()


def write_record(folder: Path, record: Record) -> None:
    """Write ``robot.json``, whole or not at all."""
    with replacing(folder / RECORD, "w") as file:
        file.write(json.dumps(dataclasses.asdict(record), indent=1) + "\n")


def read_record(folder: Path) -> Record:
    """Read and check ``robot.json``, and that ``robot.xml`` is the one that it tells of.

    Raises:
        FileNotFoundError: there is no such folder, or one of the files is missing.
        ValueError: a file is damaged, of another version, or of another robot.
    """
    again = "make another folder with: vrrt fit"
    file = folder / RECORD
    if not file.is_file():
        raise FileNotFoundError(
            f"'{folder}' is no robot's folder: it has no {RECORD}; make one with: vrrt fit"
        )
    try:
        fields = read_json(file)
    except ValueError as error:
        raise ValueError(f"{error}; {again}") from None
    found = fields.get("format") if isinstance(fields, dict) else None
    if found != FORMAT:
        raise ValueError(f"'{file}' has format {found}, expected {FORMAT}; {again}")
    names = [field.name for field in dataclasses.fields(Record)]
    if missing := [name for name in names if name not in fields]:
        raise ValueError(f"'{file}' lacks the field {', '.join(missing)}; {again}")
    record = record_of(Record, fields, f"'{file}', made by another version or by hand ({again}),")
    if record.rounds < 0:
        raise ValueError(f"'{file}': rounds is {record.rounds}; expected 0 or more; {again}")
    if not isinstance(record.made_of.get("source"), str):
        raise ValueError(f"'{file}' does not say what the robot was made of; {again}")
    if not (folder / MODEL).is_file():
        raise FileNotFoundError(f"'{folder}' has no {MODEL}; {again}")
    if sha256(folder / MODEL) != record.model_sha256:
        raise ValueError(
            f"'{folder / MODEL}' is not the one that {RECORD} was written with: it was changed, or "
            f"is of another robot; put it back, or {again}"
        )
    return record


def model_file(folder: Path) -> Path:
    """The collision model of a folder that is finished and whole.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, of another version, or of another robot, or training has
            not come far enough, or the robot's own file has changed since.
    """
    record = read_record(folder)
    source = record.made_of["source"]
    if record.rounds == 0:
        raise ValueError(
            f"'{folder}' has no self-model yet: its training did not get so far; go on with: "
            f"vrrt fit {source} --out {folder}"
        )
    if not (folder / SELF_MODEL).is_file():
        raise FileNotFoundError(
            f"'{folder}' has no {SELF_MODEL}; make another folder with: vrrt fit"
        )
    file = Path(source)
    # The file may be elsewhere by now: then paths are checked with spheres alone.
    if file.is_file() and sha256(file) != record.source_sha256:
        raise ValueError(
            f"'{file}' has changed since '{folder}' was made of it; make another folder with: "
            f"vrrt fit {file} --out FOLDER"
        )
    return folder / MODEL
