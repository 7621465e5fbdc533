"""Settings: small frozen dataclasses whose fields carry their own ranges."""

import dataclasses
import math
from typing import Any


def setting(
    default: Any,
    low: float,
    high: float = math.inf,
    *,
    below: bool = False,
    optional: bool = False,
) -> Any:
    """A dataclass field with a default and a range.

    Args:
        default: the value that measures best.
        low: smallest value.
        high: largest value.
        below: the value must stay below ``high``.
        optional: None is allowed too.
    """
    return dataclasses.field(default=default, metadata={"range": (low, high, below, optional)})


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
        if "range" not in field.metadata:
            continue
        low, high, below, optional = field.metadata["range"]
        if value is None and optional:
            continue
        if value is None or not low <= value <= high or (below and value == high):
            bracket = ")" if below else "]"
            raise ValueError(
                f"{prefix}{field.name}={value} is out of range; expected [{low}, {high}{bracket}"
            )


def changed(settings: Any, changes: dict[str, Any]) -> Any:
    """The same settings but for some of them.

    Args:
        settings: a dataclass of settings.
        changes: new values by name, such as ``{"tree.lanes": 8}``.

    Raises:
        ValueError: there is no such setting; the message lists those that exist.
    """
    for name, value in changes.items():
        stage, _, rest = name.partition(".")
        names = [field.name for field in dataclasses.fields(settings)]
        if stage not in names:
            raise ValueError(f"unknown setting '{name}'; have: {', '.join(names)}")
        if rest:
            value = changed(getattr(settings, stage), {rest: value})
        settings = dataclasses.replace(settings, **{stage: value})
    return settings
