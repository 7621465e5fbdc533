"""Archives of arrays: none runs code, fills the memory, or is read half."""

import io
import zipfile

import numpy as np
import pytest

from vrrt_jax.core import arrays_file, memory
from vrrt_jax.core.arrays_file import read_arrays


class Bomb:
    """Unpickled, it would end the process."""

    def __reduce__(self):
        return exit, (17,)


def member(file, name, content, mode="w"):
    with zipfile.ZipFile(file, mode, zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)


def header(shape, descr="<f8"):
    text = io.BytesIO()
    fields = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(text, fields)
    return text.getvalue()


def test_what_numpy_writes_comes_back(tmp_path):
    arrays = {
        "floats": np.arange(6, dtype=np.float16).reshape(2, 3),
        "turned": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        "text": np.array("héader"),
        "nothing": np.zeros((0, 3)),
        "one": np.array(3),
        "swapped": np.arange(3, dtype=">i4"),
        "bools": np.array([True, False]),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        found = read_arrays(tmp_path / "a.npz", *arrays)
        assert [*found] == [*arrays]
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].dtype == array.dtype.newbyteorder("=")
            assert found[name].flags.writeable


def test_objects_are_never_unpickled(tmp_path):
    np.savez(tmp_path / "a.npz", fine=np.zeros(3), bad=np.array([Bomb()], object))
    with pytest.raises(ValueError, match="array 'bad' holds Python objects, which are never read"):
        read_arrays(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_text("a text")
    with pytest.raises(ValueError, match=r"b.npz' is no readable .npz of arrays") as refused:
        read_arrays(tmp_path / "b.npz")
    assert "pickle" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (header((1 << 37,)) + b"x" * 64, "'a' of 64 bytes says that it has shape"),
        (header((-1, -8)) + b"x" * 64, "says that it has shape"),
        (header((1 << 62, 1 << 62)), "says that it has shape"),
        (header((3,)) + b"x" * 8, "says that it has shape"),
        (b"\x93NUMPY\x01\x00\xff\xff", "no readable .npz"),
        (b"\x93NUMPY\x09\x00", "NumPy's format|no readable"),
        (b"", "no readable .npz"),
    ],
)
def test_headers_that_lie_are_refused(tmp_path, content, words):
    member(tmp_path / "a.npz", "a.npy", content)
    with pytest.raises(ValueError, match=words):
        read_arrays(tmp_path / "a.npz")


def test_what_does_not_fit_into_the_memory_is_not_read(tmp_path, monkeypatch):
    member(tmp_path / "a.npz", "a.npy", header((1 << 23,), "|u1") + bytes(1 << 23))
    assert (tmp_path / "a.npz").stat().st_size < 1 << 20
    with pytest.raises(ValueError, match="expected at most 1000"):
        read_arrays(tmp_path / "a.npz", most=1000)
    monkeypatch.setattr(memory, "free_memory", lambda: 1 << 20)
    monkeypatch.setattr(arrays_file, "_SMALL", 0)
    monkeypatch.setattr(arrays_file, "_read_array", None)  # nothing is read
    with pytest.raises(ValueError, match="what is in it needs 0.0 GiB of memory"):
        read_arrays(tmp_path / "a.npz")


def test_what_is_missing_or_there_twice_is_told(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.zeros(1))
    with pytest.raises(ValueError, match="lacks the array two; it has: one"):
        read_arrays(tmp_path / "a.npz", "one", "two")
    with pytest.warns(UserWarning, match="Duplicate"):
        member(tmp_path / "a.npz", "one.npy", header((0,)), mode="a")
    with pytest.raises(ValueError, match="'one' is there twice"):
        read_arrays(tmp_path / "a.npz")
    with pytest.raises(FileNotFoundError, match="it is a folder"):
        read_arrays(tmp_path)
