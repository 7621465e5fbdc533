"""A plan in a home in the browser."""

import numpy as np
import pytest

from nrp_jax.cli import main
from nrp_jax.homes.grid import Grid
from nrp_jax.viewer import map_mesh, view_folder


def test_solid_cells_are_closed_boxes_seen_from_outside():
    occupied = np.zeros((3, 2, 2), bool)
    occupied[1:, 0, 0] = occupied[0, 1, 1] = True
    vertices, faces = map_mesh(Grid(occupied=occupied, resolution=0.5, origin=(1.0, 0.0, 0.0)))
    corners = vertices[faces].astype(float)  # (M, 3, 3)
    assert vertices.min(axis=0).tolist() == [1.0, 0.0, 0.0]
    assert vertices.max(axis=0).tolist() == [2.5, 1.0, 1.0]
    # The divergence theorem: positive where faces look outward.
    volume = np.einsum("mi,mi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    np.testing.assert_allclose(volume, 3 * 0.5**3)
    planar = Grid(occupied=occupied[:, :, 0], resolution=0.5)
    assert 0 < map_mesh(planar)[0][:, 2].max() < 0.5


def test_a_folder_shows_home_robot_and_tree(tmp_path):
    out = ["--out", str(tmp_path), "--no-pictures"]
    assert main(["plan", "--problem", "home_1", "--method", "rrt-connect", *out]) == 0
    page = view_folder(tmp_path)
    try:
        assert page.slider.max > 1 and len(page.moving) == 7
        assert page.url.startswith("http://127.0.0.1:")
    finally:
        page.close()
    (tmp_path / "path.json").write_text('{"robot": "snake"}')
    with pytest.raises(ValueError, match="no readable plan"):
        view_folder(tmp_path)
    (tmp_path / "path.json").unlink()
    with pytest.raises(FileNotFoundError, match="has no path.json"):
        view_folder(tmp_path)
