"""Names for what a file does not name."""

from collections.abc import Collection


def free_name(wanted: str, taken: Collection[str]) -> str:
    """``wanted``, with underscores behind it until nothing else has that name."""
    while wanted in taken:
        wanted += "_"
    return wanted
