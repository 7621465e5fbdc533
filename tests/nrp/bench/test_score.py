"""The maps that scores are measured on; the command itself is tested with the data sets."""

import numpy as np
import pytest

from nrp_jax import load_robot, samplers
from nrp_jax.bench import score
from nrp_jax.homes.grid import Grid


def test_maps_that_do_not_fit_are_left_out(tmp_path, capsys):
    for name, layers, z in (
        ("a/map", 20, 0.02),
        ("b/map", 20, 0.0),
        ("flat", 1, 0.0),
        ("high", 20, 0.1),
        ("low", 19, 0.0),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        grid = Grid(occupied=np.zeros((9, 9, layers)), origin=(3.0, -2.0, z))
        grid.save(tmp_path / f"{name}.npz")
    tested = {"cvae": samplers.load_sampler("fetch", "cvae")}
    maps = score._load_maps(tmp_path, load_robot("fetch"), tested)
    assert [*maps] == ["a/map.npz", "b/map.npz"]
    assert maps["a/map.npz"].origin == (0.0, 0.0, 0.02)
    told = capsys.readouterr().err.splitlines()
    assert [line.split("'")[1].split("/")[-1] for line in told] == [
        "flat.npz",
        "high.npz",
        "low.npz",
    ]
    assert "samplers have seen 20" in told[2] and "begin at z = 0.1 m" in told[1]
    with pytest.raises(ValueError, match="no maps for fetch in .*; expected .npz"):
        score._load_maps(tmp_path / "none", load_robot("fetch"), tested)
