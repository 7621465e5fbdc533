"""Files of fields: JSON, and YAML as OpenCV and ROS write it. Nothing is dropped in silence."""

import contextlib
import io
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

YAML = (".yaml", ".yml")
MOST_BYTES = 1 << 28  # of a text file
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
    text = read_text(path, "JSON")
    try:
        return json.loads(text, object_pairs_hook=_without_duplicates, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"'{path}' is not valid JSON: {error}") from None


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file of one document, with OpenCV's header and matrices too.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not YAML, or of several documents, or a field is there twice.
    """
    text = read_text(path, "YAML")
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
    """Plain values alone, of which each field is there once, and none stands for another."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """See :class:`yaml.SafeLoader`; few aliases of aliases would be billions of values."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(
                None, None, "aliases (*) are not read: write the values out", mark
            )
        return super().compose_node(parent, index)


def _object(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    loader.flatten_mapping(node)
    pairs = [
        (loader.construct_object(name, deep=True), loader.construct_object(value, deep=True))
        for name, value in node.value
    ]
    return _without_duplicates(pairs)


def _whole(text: str) -> int:
    """A whole number that fits into 64 bits: others overflow wherever they are used."""
    return _fitting(int(text))


def _fitting(number: int) -> int:
    if abs(number) >= 1 << 63:
        raise ValueError(f"a number of {len(str(number))} digits is too large; expected 64 bits")
    return number


def _whole_of_yaml(loader: _Loader, node: yaml.ScalarNode) -> int:
    return _fitting(loader.construct_yaml_int(node))


_Loader.add_constructor("tag:yaml.org,2002:int", _whole_of_yaml)
_Loader.add_constructor("tag:yaml.org,2002:map", _object)
_Loader.add_constructor(_OPENCV_MATRIX, _object)


@contextlib.contextmanager
def of_file(path: str | Path) -> Iterator[None]:
    """What is wrong inside, as a ValueError, names the file that it is about."""
    try:
        yield
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"'{path}': {error}") from None


@contextlib.contextmanager
def of_results(what: str) -> Iterator[None]:
    """What is missing in results that are told inside, or of another kind, is a ValueError.

    Args:
        what: the file, and what it should be, as "'a.json' is no results file".
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{what}: {error!r}") from None


def check_file(path: str | Path) -> Path:
    """The path, if it leads to a file that can be read; devices and pipes might have no end.

    Raises:
        FileNotFoundError: there is none.
    """
    path = Path(path)
    try:
        if path.is_file():
            path.open("rb").close()
            return path
        why = "it is a folder" if path.is_dir() else "it is no plain file" * path.exists()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
    if path.is_symlink() and not path.exists():
        why = "it is a link that leads nowhere"
    raise FileNotFoundError(f"cannot read '{path}': {why or 'there is no such file'}")


def read_text(path: str | Path, kind: str = "text") -> str:
    """What a text file holds, without the mark that some editors put first.

    Args:
        path: of the file.
        kind: of its content, for errors.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is no UTF-8, or larger than any such file.
    """
    content = read_bytes(path, kind)
    try:
        return io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig").read()
    except UnicodeDecodeError as error:
        told = f"{error.reason} at byte {error.start}"
        raise ValueError(f"'{path}' is not valid {kind}: {told}; save it as UTF-8") from None


def read_bytes(path: str | Path, kind: str) -> bytes:
    """What a file holds that is read as a whole; arguments and errors of :func:`read_text`."""
    path = check_file(path)
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ValueError(f"'{path}' has {size} bytes; expected {kind} of at most {MOST_BYTES}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileNotFoundError(f"cannot read '{path}': {error.strerror}") from None


def _without_duplicates(pairs: Sequence[tuple[Any, Any]]) -> dict[Any, Any]:
    """The fields of an object, or a ValueError: the last of two would be taken silently."""
    names = [str(name) for name, _ in pairs]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"the field {', '.join(map(repr, twice))} is there twice")
    return dict(pairs)
