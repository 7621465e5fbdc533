"""Fields of JSON files: all must be known, so that none is ignored in silence."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any, get_args, get_origin, get_type_hints

MOST = 2**53  # beyond it numbers of files are not whole any more


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


def check_loaded(value: Any, what: str, loader: str) -> None:
    """Raise a ValueError where a name, a path or None stands for what has to be loaded first.

    Args:
        value: what was given.
        what: its name in the error, such as "the robot".
        loader: what gives one, such as "vrrt_jax.load_robot".
    """
    if value is None or isinstance(value, str | PurePath):
        raise ValueError(f"{what} is {value!r}; expected what {loader} returns")


def record_of(kind: type[Any], fields: Any, what: str) -> Any:
    """A dataclass from the fields of a file, with their types checked.

    Args:
        kind: the dataclass; lists become its tuples, and whole numbers its floats.
        fields: what the file holds.
        what: the object's name in errors.

    Raises:
        ValueError: a field is missing, unknown or of another type.
    """
    own = {field.name: field for field in dataclasses.fields(kind) if field.init}
    check_fields(fields, tuple(own), what)
    values = {}
    for name, expected in get_type_hints(kind).items():
        if name not in own:
            continue
        if name not in fields:
            if own[name].default is dataclasses.MISSING:
                raise ValueError(f"{what} lacks the field {name}")
            continue
        values[name] = value = _as(expected, fields[name])
        if value is _OTHER:
            told = _WORDS.get(get_origin(expected) or expected, expected)
            raise ValueError(f"{what} has {name} {fields[name]!r}; expected {told}")
    return kind(**values)


_WORDS = {
    **{int: "a whole number", float: "a number", bool: "true or false", str: "a text"},
    **{tuple: "a list", Mapping: "an object"},
}
_OTHER = object()  # a value of another type


def _as(expected: Any, value: Any) -> Any:
    """The value as the type has it; ``_OTHER`` if it is of another one."""
    outer, inner = get_origin(expected) or expected, get_args(expected)
    if outer is Any:
        return value
    if outer is tuple:
        parts = [_as(inner[0], part) for part in value] if isinstance(value, list) else [_OTHER]
        return _OTHER if any(part is _OTHER for part in parts) else tuple(parts)
    if outer is float and type(value) in (int, float):
        return float(value) if abs(value) < MOST else _OTHER
    if outer is int and type(value) is int:
        return value if abs(value) < MOST else _OTHER
    if outer in (int, float, bool):
        return value if type(value) is outer else _OTHER
    return value if isinstance(value, outer) else _OTHER
