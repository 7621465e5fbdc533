"""Files of fields: JSON, and YAML as OpenCV and ROS write it. Nothing is dropped in silence."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

YAML = (".yaml", ".yml")
_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"


def read_fields(path: str | Path) -> Any:
    """Read a JSON file, or a YAML file by its suffix.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is damaged, or a field is there twice.
    """
    suffix = Path(path).suffix.lower()
    if suffix in YAML:
        return read_yaml(path)
    try:
        return read_json(path)
    except ValueError as error:
        if suffix == ".json":
            raise
        advice = "give JSON, or YAML in a file that is named .yaml or .yml"
        raise ValueError(f"{error}; {advice}") from None


def read_json(path: str | Path) -> Any:
    """Read a JSON file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not JSON, or truncated, or a field is there twice.
    """
    text = _text(path, "JSON")
    try:
        return json.loads(text, object_pairs_hook=_without_duplicates)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"'{path}' is not valid JSON: {error}") from None


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file of one document, with OpenCV's header and matrices too.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not YAML, or of several documents, or a field is there twice.
    """
    text = _text(path, "YAML")
    # OpenCV's header is "%YAML:1.0", which is no directive of YAML, and ROS ends with "---".
    text = re.sub(r"\A%YAML[:\s].*\n", "\n", text)
    text = re.sub(r"\n---\s*\Z", "\n", text)
    # Between values YAML allows tabs, which PyYAML does not; at the start of a line they are wrong.
    text = re.sub(r"(?<=\S)[ \t]*\t[ \t]*", " ", text)
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        advice = "; indent with spaces, not with tabs" if "'\\t'" in str(error) else ""
        raise ValueError(f"'{path}' is not valid YAML: {error}{advice}") from None


class _Loader(yaml.SafeLoader):
    """Plain values alone, of which each field is there once."""


def _object(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    loader.flatten_mapping(node)
    pairs = [
        (loader.construct_object(name, deep=True), loader.construct_object(value, deep=True))
        for name, value in node.value
    ]
    return _without_duplicates(pairs)


_Loader.add_constructor("tag:yaml.org,2002:map", _object)
_Loader.add_constructor(_OPENCV_MATRIX, _object)


def _text(path: str | Path, kind: str) -> str:
    """What a text file holds, without the mark that some editors put first."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"'{path}' is not valid {kind}: {error}; save it as UTF-8") from None
    except OSError as error:
        raise FileNotFoundError(f"cannot read '{path}': {error.strerror}") from None


def _without_duplicates(pairs: Sequence[tuple[Any, Any]]) -> dict[Any, Any]:
    """The fields of an object, or a ValueError: the last of two would be taken silently."""
    names = [str(name) for name, _ in pairs]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"the field {', '.join(map(repr, twice))} is there twice")
    return dict(pairs)
