"""Settings: small frozen dataclasses whose fields carry their own ranges."""

import dataclasses
import math
import numbers
from collections.abc import Mapping
from typing import Any

LARGEST = 2**31 - 1  # of whole numbers, which are int32 on the device


def setting(
    default: Any,
    low: float,
    high: float = math.inf,
    *,
    below: bool = False,
    optional: bool = False,
    endless: bool = False,
) -> Any:
    """A dataclass field with a default and a range.

    Args:
        default: the value that measures best.
        low: smallest value.
        high: largest value; of whole numbers at most :data:`LARGEST`.
        below: the value must stay below ``high``.
        optional: None is allowed too.
        endless: infinity is allowed too.
    """
    metadata = {"range": (low, high, below, optional), "endless": endless}
    return dataclasses.field(default=default, metadata=metadata)


def check_settings(settings: Any, prefix: str = "") -> None:
    """Check a dataclass of settings, and those inside it, against the ranges of their fields.

    Raises:
        ValueError: names the setting, its value and its range.
    """
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            check_settings(value, f"{prefix}{field.name}.")
            continue
        if isinstance(field.default, bool) and not isinstance(value, bool):
            raise ValueError(f"{prefix}{field.name}={value!r}; expected True or False")
        if "range" not in field.metadata:
            continue
        low, high, below, optional = field.metadata["range"]
        if value is None and optional:
            continue
        whole = isinstance(field.default, int)
        number = isinstance(value, numbers.Integral if whole else numbers.Real)
        if not number or isinstance(value, bool):
            raise ValueError(
                f"{prefix}{field.name}={value!r}; expected {'a whole' if whole else 'a'} number"
            )
        high = min(high, LARGEST) if whole else high
        endless = value == math.inf and not field.metadata["endless"]
        if not low <= value <= high or (below and value == high) or endless:
            bracket = ")" if below else "]"
            raise ValueError(
                f"{prefix}{field.name}={value} is out of range; expected [{low}, {high}{bracket}"
            )


def changed(settings: Any, changes: Mapping[str, Any], prefix: str = "") -> Any:
    """The same settings but for some of them.

    Args:
        settings: a dataclass of settings.
        changes: new values by name, such as ``{"tree.lanes": 8}``.
        prefix: of these names in messages.

    Raises:
        ValueError: there is no such setting; the message lists those that exist.
    """
    for name, value in changes.items():
        stage, _, rest = name.partition(".")
        names = [field.name for field in dataclasses.fields(settings)]
        if stage not in names:
            known = ", ".join(f"{prefix}{name}" for name in names)
            raise ValueError(f"unknown setting '{prefix}{name}'; have: {known}")
        old = getattr(settings, stage)
        if dataclasses.is_dataclass(old) and not rest and not isinstance(value, type(old)):
            raise ValueError(
                f"{prefix}{name}={value!r}; expected a {type(old).__name__}, or a setting of "
                f"it, such as '{prefix}{name}.{dataclasses.fields(old)[0].name}'"
            )
        if rest and not dataclasses.is_dataclass(old):
            raise ValueError(f"'{prefix}{stage}' is a single setting; there is no '{prefix}{name}'")
        if rest:
            value = changed(old, {rest: value}, f"{prefix}{stage}.")
        settings = dataclasses.replace(settings, **{stage: value})
    return settings
