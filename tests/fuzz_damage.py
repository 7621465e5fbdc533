"""What may be wrong with a file: damaged bytes, other things in its place, odd values in it."""

import io
import json
import os
import struct
import zipfile
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import yaml
from PIL import Image

ODD = (
    *(None, True, False, "", " ", "x", "é\u2028\x00", "nan", "../..", "/dev/zero", "9" * 5000),
    *(0, -1, 1, 2, 3.7, 1e-320, 1e308, -1e308, float("nan"), float("inf"), 2**31, 2**63, 10**400),
    *([], {}, [[]], [None], [0, 0], ["a", {}], {"x": 1}, [1e308] * 7, [[1, 0], [0, 1]]),
)
ODD_TEXTS = (
    *("", " ", "x", "nan", "inf", "-1", "0", "1e308", "1e400", "1 2", "0 0 0", "9" * 5000, "a/b"),
    *("../../../etc/passwd", "/dev/zero", "true", "é\u2028", "-0.1 0.1 0.1", "1 nan 0", "0 0 0 0"),
)
BOMB = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(9)
)
ALIASES = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 9)}]\n" for k in range(9)
)


def damage(rng: np.random.Generator, file: Path, others: list[Path]) -> str:
    """Damage a file in place; returns what was done."""
    kinds = [_bytes, _place, _swapped]
    kinds += [_OF_KIND[file.suffix]] * 4 if file.suffix in _OF_KIND else []
    return kinds[rng.integers(len(kinds))](rng, file, others)


def _pick(rng: np.random.Generator, options):
    return options[int(rng.integers(len(options)))]


def _bytes(rng, file, others) -> str:
    data = file.read_bytes()
    at, end = sorted(int(k) for k in rng.integers(0, len(data) + 1, 2))
    flipped = bytearray(data)
    for k in rng.integers(0, max(len(data), 1), 1 + rng.integers(8)):
        if data:
            flipped[k] ^= 1 << int(rng.integers(8))
    made = {
        "cut off": data[:at],
        "flipped": bytes(flipped),
        "a part missing": data[:at] + data[end:],
        "a part twice": data[:end] + data[at:],
        "noise in it": data[:at] + rng.bytes(end - at) + data[end:],
        "empty": b"",
        "zeros": bytes(len(data)),
        "UTF-16": data.decode("latin-1").encode("utf-16"),
        "with a mark": b"\xef\xbb\xbf" + data,
        "Latin-1": data.replace(b"e", b"\xe9"),
        "Windows": data.replace(b"\n", b"\r\n"),
        "NUL at the end": data + bytes(3),
        "noise alone": rng.bytes(1000),
        "deep": b"[" * 100_000,
    }
    name = _pick(rng, list(made))
    file.write_bytes(made[name])
    return name


def _place(rng, file, others) -> str:
    name = _pick(rng, ("missing", "folder", "dangling", "loop", "endless", "pipe", "link"))
    data = file.read_bytes()
    file.unlink()
    if name == "folder":
        file.mkdir()
    elif name == "pipe":
        os.mkfifo(file)
    elif name == "link":  # to the same: nothing is wrong with it
        target = file.with_name("target" + file.suffix + ".real")
        target.write_bytes(data)
        file.symlink_to(target)
    elif name != "missing":
        file.symlink_to({"dangling": "nowhere", "loop": file, "endless": "/dev/zero"}[name])
    return name


def _swapped(rng, file, others) -> str:
    other = _pick(rng, others)
    file.write_bytes(other.read_bytes())
    return f"is {other.name}"


def _values(rng, fields):
    """Change one thing somewhere in nested fields; returns the fields, and what was done."""
    inner = [k for k, v in _items(fields) if isinstance(v, dict | list) and v]
    if inner and rng.random() < 0.75:
        key = _pick(rng, inner)
        fields[key], done = _values(rng, fields[key])
        return fields, f"{key}.{done}"
    kind = rng.random()
    if not isinstance(fields, dict | list) or not fields or kind < 0.1:
        value = _pick(rng, ODD)
        return value, f"= {str(value)[:30]!r}"
    key = _pick(rng, [k for k, _ in _items(fields)])
    if kind < 0.25:
        del fields[key]
        return fields, f"{key} gone"
    if kind < 0.35 and isinstance(fields, dict):
        fields["unknown"] = fields[key]
        return fields, "unknown field"
    if kind < 0.45 and isinstance(fields, list):
        fields.insert(key, fields[key])
        return fields, f"{key} twice"
    fields[key] = _pick(rng, ODD)
    return fields, f"{key} = {str(fields[key])[:30]!r}"


def _items(fields):
    if isinstance(fields, dict):
        return list(fields.items())
    return list(enumerate(fields)) if isinstance(fields, list) else []


def _json(rng, file, others) -> str:
    fields, done = _values(rng, json.loads(file.read_text()))
    file.write_text(json.dumps(fields))
    return done


def _yaml(rng, file, others) -> str:
    text = file.read_text()
    if rng.random() < 0.1:
        file.write_text(ALIASES + text)
        return "aliases"
    opencv = text.startswith("%YAML")
    plain = text.removeprefix("%YAML:1.0\n---\n").replace("!!opencv-matrix", "")
    fields, done = _values(rng, yaml.safe_load(plain))
    try:
        made = yaml.safe_dump(fields, allow_unicode=True)
    except (yaml.YAMLError, ValueError):
        made = str(fields)
    file.write_text(("%YAML:1.0\n---\n" if opencv else "") + made)
    return done


def _xml(rng, file, others) -> str:
    text = file.read_text()
    if rng.random() < 0.06:
        file.write_text(BOMB + "]>" + text.replace("name=", 'data="&j;" name=', 1))
        return "entities"
    root = ElementTree.fromstring(text)
    parts = list(root.iter())
    part, parent = _pick(rng, parts), _pick(rng, parts)
    kind = rng.random()
    if kind < 0.65 and part.attrib:
        key = _pick(rng, list(part.attrib))
        part.set(key, _pick(rng, ODD_TEXTS).replace("\x00", ""))
        done = f"{part.tag} {key} = {part.get(key)[:30]!r}"
    elif kind < 0.75 and part.attrib:
        done = f"{part.tag} without {part.attrib.popitem()[0]}"
    elif kind < 0.85 and len(parent):
        gone = _pick(rng, list(parent))
        parent.remove(gone)
        done = f"without {gone.tag}"
    elif kind < 0.95 and part is not root:
        parent.append(ElementTree.fromstring(ElementTree.tostring(part)))
        done = f"{part.tag} again in {parent.tag}"
    else:
        part.tag, done = "unknown", f"{part.tag} unknown"
    file.write_text(ElementTree.tostring(root, encoding="unicode"))
    return done


def _npz(rng, file, others) -> str:
    with np.load(file) as saved:
        arrays = dict(saved)
    name = _pick(rng, list(arrays))
    array = arrays[name]
    numbers = array.astype(np.float64) if array.dtype.kind in "biuf" else np.zeros(2)
    spoiled = np.atleast_1d(numbers.copy())
    if spoiled.size:
        spoiled.flat[rng.integers(spoiled.size)] = _pick(rng, [np.nan, np.inf, -1e308, -1, 1e9])
    made = {
        "one odd number": spoiled.reshape(numbers.shape),
        "pickled": np.array([{"a": 1}, None], object),
        "text": np.array("text"),
        "json": np.array('{"version": 2, "format": 3, "config": {}, "info": {}, "levels": {}}'),
        "scalar": np.array(3.0),
        "empty": np.zeros((0,) * max(array.ndim, 1)),
        "flat": numbers.ravel(),
        "longer": np.concatenate([np.atleast_1d(numbers)] * 2),
        "one axis more": numbers[None],
        "complex": numbers.astype(complex),
        "whole": np.nan_to_num(numbers).astype(np.int64),
        "dates": np.zeros(numbers.shape, "M8[s]"),
        "big end first": numbers.astype(">f8"),
    }
    done = _pick(rng, [*made, "gone", "unknown", "header", "single", "bomb", "deflated"])
    if done == "gone":
        del arrays[name]
    elif done == "unknown":
        arrays["unknown"] = array
    elif done in made:
        arrays[name] = made[done]
    memory = io.BytesIO()
    np.savez(memory, **arrays)
    if done == "header":  # it says a terabyte
        memory = _with_member(arrays, name, _header((1 << 37,)) + b"x" * 64)
    if done == "bomb":  # gigabytes of zeros in little
        memory = _with_member(arrays, name, _header((1 << 28,)) + bytes(1 << 28))
    data = memory.getvalue()
    if done == "single":
        memory = io.BytesIO()
        np.save(memory, array)
        data = memory.getvalue()
    if done == "deflated":
        data = data.replace(b"PK\x03\x04\x14\x00\x00\x00\x00", b"PK\x03\x04\x14\x00\x00\x00\x63")
    file.write_bytes(data)
    return f"{name} {done}"


def _header(shape: tuple[int, ...]) -> bytes:
    memory = io.BytesIO()
    fields = {"descr": "<f8" if shape[0] > 1 << 30 else "|u1", "fortran_order": False}
    np.lib.format.write_array_header_1_0(memory, {**fields, "shape": shape})
    return memory.getvalue()


def _with_member(arrays: dict[str, np.ndarray], name: str, content: bytes) -> io.BytesIO:
    memory = io.BytesIO()
    np.savez_compressed(memory, **{key: value for key, value in arrays.items() if key != name})
    with zipfile.ZipFile(memory, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.npy", content)
    return memory


def _picture(rng, file, others) -> str:
    with Image.open(file) as image:
        image = image.copy()
    made = {
        "small": image.resize((1, 1)),
        "wide": image.resize((image.width * 2, 3)),
        "half": image.resize((image.width // 2, image.height // 2)),
        "turned": image.transpose(Image.Transpose.ROTATE_90).crop((0, 0, 100, 50)),
        "black": Image.new("RGB", image.size),
        "white": Image.new("L", image.size, 255),
        "palette": image.convert("RGB").convert("P"),
        "one bit": image.convert("1"),
        "16 bits": Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 3),
        "CMYK": image.convert("RGB").convert("CMYK"),
        "float": image.convert("F"),
        "clear": Image.new("RGBA", image.size),
        "grey and alpha": image.convert("LA"),
    }
    done = _pick(rng, [*made, "animated", "bomb", "PNG of nothing"])
    if done == "animated":
        frames = [Image.new("RGB", (9, 9), color) for color in ("red", "blue")]
        frames[0].save(file, "GIF", save_all=True, append_images=frames[1:])
    elif done in made:
        for kind in ("PNG", "TIFF"):
            try:
                made[done].save(file, kind)
                break
            except OSError:
                continue
    else:  # a PNG that says how large it is, and holds little
        side = 60_000 if done == "bomb" else 0
        chunk = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        file.write_bytes(
            b"\x89PNG\r\n\x1a\n"
            + struct.pack(">I", 13)
            + chunk
            + struct.pack(">I", zlib.crc32(chunk))
        )
    return done


_OF_KIND = {
    **dict.fromkeys((".xml", ".urdf"), _xml),
    **dict.fromkeys((".yaml", ".yml"), _yaml),
    **dict.fromkeys((".png", ".jpg", ".pgm"), _picture),
    ".json": _json,
    ".npz": _npz,
}
