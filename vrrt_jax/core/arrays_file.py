"""Archives of arrays (``.npz``) from anywhere: none runs code, and none fills the memory."""

import math
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

from vrrt_jax.core.data_file import check_file
from vrrt_jax.core.memory import check_memory

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_TOLD = 8  # names in a message
_SMALL = 1 << 26  # bytes that there always are
MOST_WEIGHTS = 1 << 27  # bytes of what networks and splats have learned
# What NumPy and zipfile raise for what is damaged; RuntimeError is of archives with a password.
_DAMAGE = (OSError, EOFError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)


def read_arrays(path: str | Path, *needed: str, most: int | None = None) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz``, by name.

    Nothing is unpickled. What the file says of sizes is compared with what it holds and with the
    memory that is free, before anything is read.

    Args:
        path: of the file.
        needed: names of arrays that must be there.
        most: bytes of all arrays together; what the memory has room for if None.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is no archive of plain arrays, is damaged or too large, or lacks an array.
    """
    path, arrays = check_file(path), {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if most is not None and size > most:
                raise ValueError(f"what is in it has {size} bytes; expected at most {most}")
            if size > _SMALL:
                check_memory(size, "what is in it", "give a smaller file")
            for member in members:
                name = member.filename.removesuffix(".npy")
                if name in arrays:
                    raise ValueError(f"the array '{name}' is there twice")
                with archive.open(member) as file:
                    arrays[name] = _read_array(file, member.file_size, name)
    except _DAMAGE as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"'{path}' is no readable .npz of arrays ({text}); expected one that numpy.savez wrote"
        ) from None
    if missing := [name for name in needed if name not in arrays]:
        has = [*arrays][:_TOLD] + ["..."] * (len(arrays) > _TOLD)
        raise ValueError(
            f"'{path}' lacks the array {', '.join(missing)}; it has: {', '.join(has) or 'none'}"
        )
    return arrays


def float32_of(array: np.ndarray, name: str) -> np.ndarray:
    """Numbers of an archive in float32.

    Raises:
        ValueError: they are no numbers, not finite, or too large for float32.
    """
    if array.dtype.kind not in "fiu" or not np.all(np.abs(array) < np.finfo(np.float32).max):
        raise ValueError(f"its {name} of type {array.dtype} has values that are no finite numbers")
    return array.astype(np.float32)


def _read_array(file: IO[bytes], size: int, name: str) -> np.ndarray:
    """An array of an archive's member of so many bytes.

    Raises:
        ValueError: it is of another kind, or its header tells of another size.
    """
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"the array '{name}' is of NumPy's format {version}")
    shape, is_fortran, dtype = _HEADERS[version](file)
    if dtype.hasobject:
        raise ValueError(f"the array '{name}' holds Python objects, which are never read")
    told, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if told != there or min(shape, default=0) < 0:
        raise ValueError(f"the array '{name}' of {there} bytes says that it has shape {shape}")
    content = bytearray(file.read(there))
    if len(content) != there:
        raise EOFError(f"the array '{name}' is cut off")
    flat = np.frombuffer(content, dtype, count=math.prod(shape))
    flat = flat.astype(dtype.newbyteorder("="), copy=False)  # JAX knows no other order of bytes
    return flat.reshape(shape, order="F" if is_fortran else "C")
