"""XML files of robots and scenes, looked at before MuJoCo reads them and the files that they name.

MuJoCo opens whatever a file names, and makes as much of it as the file says. So devices and pipes,
which have no end, and numbers that would fill the memory are refused here.
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from vrrt_jax.core.data_file import read_bytes

_FOLDERS = ("meshdir", "texturedir", "assetdir")  # of <compiler>
# What a file may ask for, by element: the product of some numbers is at most so large.
_COUNTS = {
    "hfield": (("nrow", "ncol"), 10**7),
    "texture": (("width", "height"), 10**8),
    "flexcomp": (("count",), 10**5),
    "composite": (("count",), 10**5),
    "size": (("nkey",), 10**5),
}
_SUFFIXES = (".xml", ".urdf")  # of what MuJoCo reads
_LARGEST = 1e30
_COPIES = 10**5  # of what stands in <replicate>, one inside the other


def xml_root(path: str | Path) -> ElementTree.Element | None:
    """The root of an XML file; None for a file that is none.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is too large, or declares entities, of which few lines can make gigabytes.
    """
    content = read_bytes(path, "XML")
    try:
        scanner = expat.ParserCreate()
        scanner.EntityDeclHandler = _refuse_entity
        scanner.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, LookupError, RecursionError):
        return None


def check_mjcf(path: str | Path) -> None:
    """Raise what :func:`xml_root` does, or a ValueError for what MuJoCo should not try to read."""
    path = Path(path)
    root = xml_root(path)
    if path.suffix not in _SUFFIXES:
        raise ValueError(f"its name ends in '{path.suffix}'; expected .xml or .urdf: rename it")
    if root is None:
        return
    parts = list(_parts(root, path, {os.path.realpath(path)}))
    folders = {part.get(name, "") for part in parts for name in _FOLDERS}
    for part in parts:
        for key, text in part.attrib.items():
            if key.startswith("file"):
                for folder in folders:
                    _check_end(path.parent / folder / text, text)
            check_number(part, key, text)
        keys, most = _COUNTS.get(part.tag, ((), 0))
        if keys and (number := math.prod(_whole(part.get(key, "")) for key in keys)) > most:
            raise ValueError(
                f"<{part.tag}> asks for {' * '.join(keys)} = {number}; expected at most {most}"
            )


def _refuse_entity(name: str, *_) -> None:
    raise ValueError(f"it declares the XML entity '{name}'; expected none: write its text out")


def _parts(root: ElementTree.Element, path: Path, seen: set[str]) -> Iterator[ElementTree.Element]:
    """All elements of a file and of those that it includes, each file once."""
    stack = [(root, 1)]
    while stack:
        part, copies = stack.pop()
        if part.tag == "replicate" and (copies := copies * _whole(part.get("count", ""))) > _COPIES:
            raise ValueError(f"<replicate> makes {copies} copies; expected at most {_COPIES}")
        yield part
        stack += [(inner, copies) for inner in part]
        included = path.parent / part.get("file", "") if part.tag == "include" else path
        if os.path.realpath(included) not in seen:
            seen.add(os.path.realpath(included))
            if os.path.isdir(included):
                raise ValueError(f"it includes '{part.get('file')}', which is a folder")
            _check_end(included, part.get("file", ""))
            inner = xml_root(included) if os.path.isfile(included) else None
            stack += [] if inner is None else [(inner, copies)]


def _check_end(place: Path, name: str) -> None:
    # These of os.path hold for names that are too long, too.
    if os.path.exists(place) and not (os.path.isfile(place) or os.path.isdir(place)):
        raise ValueError(f"it names '{name}', which is no plain file; expected one with an end")


def check_number(part: ElementTree.Element, key: str, text: str) -> None:
    """Raise a ValueError for numbers of which one is none, or too large for float32."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return
    # Limits may be infinite: a joint may turn for ever.
    endless = key in ("size", "pos", "fromto") and math.inf in map(abs, numbers)
    if endless or any(math.isnan(x) or _LARGEST < abs(x) < math.inf for x in numbers):
        what = f"{part.tag} '{part.get('name', '')}'"
        raise ValueError(f'{what} has {key}="{text}"; expected numbers up to {_LARGEST:g}')


def _whole(text: str) -> int:
    """The product of whole numbers; 1 for what is none, of which MuJoCo tells."""
    try:
        return math.prod(max(int(word), 1) for word in text[:100].split())
    except ValueError:
        return 1
