"""Files as editors, OpenCV and ROS leave them; what is ambiguous is refused."""

import itertools
import os

import pytest
from PIL import Image, UnidentifiedImageError

from vrrt_jax.core.arrays_file import read_arrays
from vrrt_jax.core.data_file import check_file, read_fields, read_yaml
from vrrt_jax.core.pictures import FORMATS, open_picture

OPENCV = """%YAML:1.0
---
image_width: 640
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.0e+02, 0., 320., 0., 600., 240., 0.,\t0., 1. ]
"""


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_opencv_s_header_matrices_and_tabs_between_values(tmp_path, mark, ending):
    file = tmp_path / "camera.YML"
    file.write_bytes(mark + OPENCV.replace("\n", ending).encode())
    fields = read_fields(file)
    assert fields["image_width"] == 640
    assert fields["camera_matrix"]["data"] == [600, 0, 320, 0, 600, 240, 0, 0, 1]


def test_a_message_of_ros_ends_with_a_line(tmp_path):
    (tmp_path / "info.yaml").write_text("header:\n  frame_id: camera\nd:\n- 0.1\n- 1.0\n---\n")
    assert read_yaml(tmp_path / "info.yaml") == {"header": {"frame_id": "camera"}, "d": [0.1, 1.0]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb:\n\tc: 2\n", "(?s)not valid YAML: .*; indent with spaces, not with tabs"),
        ("a: 1\na: 2\n", "the field 'a' is there twice"),
        ("a: 1\n---\na: 2\n", "not valid YAML"),
        ("a: [1, 2\n", "not valid YAML"),
        ("a: !!python/object/apply:os.getcwd []\n", "could not determine a constructor"),
        (b"a: \xff\xfe", "save it as UTF-8"),
        ("a: " + "9" * 400, "a number of 400 digits is too large"),
    ],
)
def test_other_files_are_explained(tmp_path, text, message):
    file = tmp_path / "camera.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message):
        read_fields(file)


def test_what_is_neither_json_nor_yaml_is_told_what_to_be(tmp_path):
    (tmp_path / "camera.xml").write_text("<opencv_storage/>")
    with pytest.raises(ValueError, match="not valid JSON: .*; give JSON, or YAML in a file"):
        read_fields(tmp_path / "camera.xml")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="cannot read"):
        read_fields(tmp_path / "none.yaml")


def test_aliases_of_aliases_are_no_billions_of_values(tmp_path):
    file = tmp_path / "camera.yaml"
    lines = ["a: &a [ha, ha, ha]"]
    lines += [f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in itertools.pairwise("abcdefgh")]
    file.write_text("\n".join(lines))
    with pytest.raises(ValueError, match="aliases .* are not read: write the values out"):
        read_fields(file)


@pytest.mark.parametrize("kind", ["folder", "pipe", "dangling", "loop", "endless"])
def test_what_is_no_file_is_not_read(tmp_path, kind):
    file = tmp_path / "camera.json"
    if kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to({"dangling": "none", "loop": file, "endless": "/dev/zero"}[kind])
    for read in (read_fields, check_file, open_picture, read_arrays):
        with pytest.raises(FileNotFoundError, match="cannot read '.*camera.json': ..."):
            read(file)


def test_pictures_run_no_program(tmp_path):
    """Pillow hands PostScript to Ghostscript."""
    Image.new("RGB", (4, 4)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / "a.png")
    with pytest.raises(UnidentifiedImageError):
        open_picture(tmp_path / "a.png")
    Image.init()
    assert {*FORMATS} <= {*Image.OPEN} and "EPS" not in FORMATS
