"""Problems as folders: what is in problem.json is used, or refused by name."""

import json

import pytest

import vrrt_jax
from vrrt_jax.robots import scenes_dir

FOLDER = scenes_dir() / "problems" / "panda_posts"
FIELDS = json.loads((FOLDER / "problem.json").read_text())
VIEW = FIELDS["views"][0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal_config": [0.0]}, "unknown fields: goal_config; known ones: robot, world"),
        ({"Start": [0.0]}, "unknown fields: Start"),
        ({"views": [VIEW | {"masks": "mask.png"}]}, "view 0 .* unknown fields: masks; .* image"),
        ({"views": [VIEW | {"camera": VIEW["camera"] | {"roll": 3}}]}, "unknown fields: roll"),
        ({"views": []}, r"views of .* is \[\]"),
        ({"views": VIEW}, "expected a list of images and cameras"),
        ({"views": [VIEW | {"image": 3}]}, "image is 3; expected a name or a path"),
        ({"robot": None}, "robot is None; expected a name or a path"),
        ({"world": {"name": "posts"}}, "world is .*; expected a name or a path"),
        ({"true_goal": [0.0, 1.0]}, r"true_goal has shape \(2,\)"),
        ({"true_goal": [9.0] * 7}, "true_goal is outside the limits"),
        ({"views": ["goal.png"]}, "view 0 .* is a str; expected an object"),
    ],
)
def test_unknown_fields_are_named(tmp_path, changes, message):
    (tmp_path / "goal.png").write_bytes((FOLDER / "goal.png").read_bytes())
    fields = FIELDS | {"world": str(scenes_dir() / "worlds" / "posts.xml")} | changes
    (tmp_path / "problem.json").write_text(json.dumps(fields))
    with pytest.raises(ValueError, match=message):
        vrrt_jax.load_problem(tmp_path, engine="closed_form")


def test_a_list_is_no_problem(tmp_path):
    (tmp_path / "problem.json").write_text("[]")
    with pytest.raises(ValueError, match="is a list; expected an object"):
        vrrt_jax.load_problem(tmp_path)
