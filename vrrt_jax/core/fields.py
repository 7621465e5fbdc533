"""Fields of JSON files: all must be known, so that none is ignored in silence."""

from collections.abc import Mapping, Sequence
from typing import Any


def check_fields(
    fields: Any, known: Sequence[str], what: str, advice: Mapping[str, str] | None = None
) -> None:
    """Raise a ValueError for what is no object, or has a field that is not known.

    Args:
        fields: what the file holds.
        known: names of the fields that are read.
        what: the object's name in errors, such as "the camera".
        advice: what to do about some of the unknown ones, by name in lower case.
    """
    if not isinstance(fields, Mapping):
        raise ValueError(f"{what} is a {type(fields).__name__}; expected an object with fields")
    unknown = [name for name in fields if name not in known]
    if not unknown:
        return
    told = dict.fromkeys((advice or {}).get(str(name).lower(), "") for name in unknown)
    raise ValueError(
        f"{what} has unknown fields: {', '.join(map(str, unknown))}; known ones: {', '.join(known)}"
        + "".join(f"; {text}" for text in told if text)
    )
