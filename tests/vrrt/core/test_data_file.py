"""Files as editors, OpenCV and ROS leave them; what is ambiguous is refused."""

import pytest

from vrrt_jax.core.data_file import read_fields, read_yaml

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
